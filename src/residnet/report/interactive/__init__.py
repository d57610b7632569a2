"""Figures of a page that can be zoomed, read off and switched, drawn by Bokeh."""

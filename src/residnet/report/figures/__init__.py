"""Figures, one file per topic, drawn from a run folder."""

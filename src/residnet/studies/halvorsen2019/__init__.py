"""Halvorsen 2019: symbolic regression and the USV Odin."""

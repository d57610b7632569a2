"""Vessel files of this package; each is found by its name."""

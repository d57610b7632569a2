"""Guidance laws: from way-points or a planned course to a desired heading."""

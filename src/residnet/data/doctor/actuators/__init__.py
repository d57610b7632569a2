"""Findings about propellers and rudders that the vessel's motion contradicts."""

"""Genetic programming of equations."""

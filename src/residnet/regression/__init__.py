"""Estimators from arrays to coefficients, independent of vessels."""

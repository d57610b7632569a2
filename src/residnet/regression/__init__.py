"""Estimators from arrays to coefficients; nothing here knows of vessels."""

"""Bands of free runs: how far a model may be off, calibrated on logs that it was not fitted on."""

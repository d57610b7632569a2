"""Data compatibility analysis: instrument errors, clocks and frames from the kinematics alone.

`reconstruct` estimates states and instrument errors of one log, `compare` ranks contradictory
meanings of its channels, `estimate_clock_from_rate` aligns two recorders.
"""

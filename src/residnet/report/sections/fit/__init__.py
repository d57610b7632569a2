"""The parts of the report of a fit, one file each."""

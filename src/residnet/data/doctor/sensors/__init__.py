"""Findings about receivers and compasses that show what they did not measure."""

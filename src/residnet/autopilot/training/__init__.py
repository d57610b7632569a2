"""The training of heading policies through their closed loop."""

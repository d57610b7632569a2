"""Section 7.5 of document 000: the standard model of Odin, phase by phase."""

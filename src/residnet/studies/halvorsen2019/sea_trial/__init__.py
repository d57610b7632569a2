"""Task `sea_trial`: models of Odin by phase (document 000, section 7.5)."""

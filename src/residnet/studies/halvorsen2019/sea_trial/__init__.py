"""Task `sea_trial`: models of Odin by phase (Halvorsen 2019, section 7.5)."""

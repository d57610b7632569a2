"""Document 004 (Gouletas 2020): a neural heading autopilot for two vessels."""

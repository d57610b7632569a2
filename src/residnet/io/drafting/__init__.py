"""Drafting of channel maps from names in several languages, units, values and physics."""

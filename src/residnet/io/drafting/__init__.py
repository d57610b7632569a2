"""A first channel map from files alone: names in several languages, units, values and physics."""

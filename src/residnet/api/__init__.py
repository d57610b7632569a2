"""Public interface of residnet in plain Python values; names are loaded when first used."""

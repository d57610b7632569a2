"""Bands of the models of a fit, over logs that the models were fitted without."""

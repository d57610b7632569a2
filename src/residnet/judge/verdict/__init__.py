"""Which model is chosen, whether it is sound, and how far it can be trusted."""

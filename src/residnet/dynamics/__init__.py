"""Models in discrete time: interface, hybrid models, ensembles, plants and their storage."""

"""A complete config of a fit, drafted from logs: `residnet new`."""

"""Task `sweep`: keys of any config varied over a search space, trial by trial."""

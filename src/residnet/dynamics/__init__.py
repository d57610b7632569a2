"""Models in discrete time, and the one time loop that runs them all."""

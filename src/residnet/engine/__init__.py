"""Results of one trace of the step: compiled rollouts, adjoints and Jacobians."""

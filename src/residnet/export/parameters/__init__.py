"""The format `parameters`: a baseline's coefficients in the forms of other simulators."""

"""Kernel ridge regression: kernels, fits with every penalty, and the estimator."""

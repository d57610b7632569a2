"""Fits without parts of the logs: strengths of priors, and errors over all logs."""

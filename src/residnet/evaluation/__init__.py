"""Free-run evaluation: protocols, the evaluator and metrics."""

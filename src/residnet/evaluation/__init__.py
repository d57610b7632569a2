"""Free-run evaluation: protocols, the evaluator, metrics, figures and the report."""

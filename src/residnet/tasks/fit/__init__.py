"""Task `fit`: from logs to baselines, heads, a comparison in free run, report and exports."""

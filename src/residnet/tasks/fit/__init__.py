"""Task `fit`: from logs to baselines, heads (residual models), comparison, report and exports."""

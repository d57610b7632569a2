"""Motion control in three degrees of freedom: reference filter, PID and feed-forward."""

"""Tasks of the autopilot wing: training and comparison of autopilots, and courses past buoys."""

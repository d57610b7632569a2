"""Report pages of the autopilot wing."""

"""The task `autopilot`."""

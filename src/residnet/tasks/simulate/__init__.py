"""The task `simulate`."""

"""The task `course`."""

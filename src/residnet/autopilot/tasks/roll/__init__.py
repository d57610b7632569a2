"""The task `roll`."""

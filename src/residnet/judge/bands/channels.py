"""The channels that have bands."""

CHANNELS = ("u", "v", "r", "heading", "position")
"""What has a band; the position's is the radius about the predicted one."""

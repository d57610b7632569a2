"""Finished runs side by side: `residnet compare`."""

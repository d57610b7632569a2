"""Prepare logs for a fit: grid, masks, derivatives, missing velocities and windows."""

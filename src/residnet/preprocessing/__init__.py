"""From a log to samples: grid, masks, derivatives, missing velocities and windows."""

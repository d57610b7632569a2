"""From files to windows: readers, masks, grid, derivatives, splits and the data doctor."""

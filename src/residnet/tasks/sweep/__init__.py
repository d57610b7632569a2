"""Task `sweep`: search over keys of any config by grid, random or TPE search."""

"""Arrays of many samples: kept in files, and summed up piece by piece."""

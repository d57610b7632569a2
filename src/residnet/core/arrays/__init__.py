"""Arrays of many samples, stored in memory-mapped files."""

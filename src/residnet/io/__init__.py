"""Files of measured logs: readers, the map of their channels, drafted configs and splits."""

"""Input of measured logs: readers, channel maps, drafted configs and splits of the data."""

"""The sections of a report, by task."""

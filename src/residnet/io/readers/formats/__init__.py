"""Formats of recordings, one file each: a config that says how it is known and loads it."""

"""What everything else stands on: errors, names and units, frames, the canonical log,
configuration.
"""

"""What all packages build on: errors, names and units, frames, the canonical log, configs."""

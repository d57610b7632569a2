"""Foundation of all packages: errors, names and units, frames, the canonical log, configs."""

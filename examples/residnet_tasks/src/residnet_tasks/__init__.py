"""Tasks of a package of its own: identification of actuators, and conversion of recordings."""

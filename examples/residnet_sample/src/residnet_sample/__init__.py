"""An example of a package that adds parts of its own to residnet."""

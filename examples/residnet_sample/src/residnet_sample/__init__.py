"""An example of a package that adds parts to residnet."""

"""Free runs as what a fit minimises: their cost, and what logs leave out do to its minimum."""

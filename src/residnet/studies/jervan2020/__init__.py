"""Jervan 2020: force residuals of the ferry milliAmpere."""

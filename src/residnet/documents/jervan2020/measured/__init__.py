"""Chapter 5 of document 002: force residuals of measured logs."""

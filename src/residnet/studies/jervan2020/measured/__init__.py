"""Task `force_residual`: residual models of measured forces (document 002, chapter 5)."""

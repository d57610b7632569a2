"""Task `force_residual`: residual models of measured forces (Jervan 2020, chapter 5)."""

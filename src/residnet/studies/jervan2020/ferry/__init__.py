"""Task `ferry_study`: residual models of a ferry in closed loop (document 002, chapter 4)."""

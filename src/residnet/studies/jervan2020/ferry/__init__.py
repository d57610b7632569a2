"""Task `ferry_study`: residual models of a ferry in closed loop (Jervan 2020, chapter 4)."""

"""Task `course`: heading policies along a course past buoys."""

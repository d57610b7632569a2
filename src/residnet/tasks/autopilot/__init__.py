"""Task `autopilot`: heading policies and their classical peers."""

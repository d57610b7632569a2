"""Chapter 4 of document 002: the ferry identified and flown in closed loop."""

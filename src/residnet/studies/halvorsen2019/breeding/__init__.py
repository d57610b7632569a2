"""Task `breeding`: genetic programming on a mass-spring-damper (Halvorsen 2019, chapter 5)."""

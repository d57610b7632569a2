"""Task `breeding`: genetic programming on a mass-spring-damper (document 000, chapter 5)."""

"""Chapter 5 of document 000: genetic programming on a mass-spring-damper."""

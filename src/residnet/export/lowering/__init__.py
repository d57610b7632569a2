"""A module's step as a short program over single numbers, from which source code is made."""

"""Expressions in normal form, how they are written and evaluated."""

"""Stated conditions: flights under them, what they cost, and tuning by that cost."""

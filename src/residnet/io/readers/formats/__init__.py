"""Readers of recording formats, one module per format."""

"""Kinds of message that map themselves to channels."""

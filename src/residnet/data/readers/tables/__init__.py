"""Readers of tables: foreign ones through a channel map, and canonical logs."""

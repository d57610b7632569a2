"""Identification of models from prepared logs, change detection, and design of trials."""

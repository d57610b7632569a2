"""Identification: from logs and settings to fitted and judged models, without a run folder."""

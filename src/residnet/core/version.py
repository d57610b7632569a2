"""The version of residnet, read by packaging, model files and reports."""

from __future__ import annotations

__version__ = "0.2.0"

"""The version of residnet, written down once; packaging, model files and reports read it here."""

from __future__ import annotations

__version__ = "0.2.0"

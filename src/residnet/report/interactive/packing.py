"""Curves as text: 16-bit numbers with offset and step, for a page and for the file of a picture."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from typing import Any

import numpy as np

_LEVELS = 65_000
"""Steps into which the range of a curve is divided: finer than any screen."""
_GAP = 65_535


def packed(columns: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return columns as 16-bit numbers with offset and step; equal columns are stored once."""
    out: dict[str, Any] = {}
    stored: dict[bytes, str] = {}
    for name, values in columns.items():
        key = values.tobytes()
        if key in stored:
            out[name] = stored[key]
            continue
        stored[key] = name
        finite = np.isfinite(values)
        low = float(values[finite].min()) if finite.any() else 0.0
        span = float(values[finite].max()) - low if finite.any() else 0.0
        step = span / _LEVELS if span > 0 else 1.0
        levels = np.full(len(values), _GAP, dtype="<u2")
        levels[finite] = np.round((values[finite] - low) / step)
        out[name] = [low, step, base64.b64encode(levels.tobytes()).decode("ascii")]
    return out


def unpacked(columns: Mapping[str, Any], name: str) -> np.ndarray:
    """Return one of the columns that `packed` gave, as numbers [T].

    Raises:
        KeyError: where there is no such column.
    """
    stored = columns[name]
    if isinstance(stored, str):
        return unpacked(columns, stored)
    low, step, text = stored
    levels = np.frombuffer(base64.b64decode(text), dtype="<u2")
    values: np.ndarray = np.where(levels == _GAP, np.nan, low + step * levels)
    return values

"""Cells of text tables: numbers, dates, times of day, and numbers with a unit."""

from __future__ import annotations

import re

from residnet.core.units import is_unit

NUMBER = re.compile(
    r"[-+]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][-+]?\d+)?|[-+]?(?:nan|inf)", re.IGNORECASE
)
TIME = re.compile(r"\d{1,4}\s*[-./:年時h]\s*\d")
"""Start of a date or of a time of day."""
UNIT = r"(?:[^\W\d_]|[°%µ])\S*"
_WITH_UNIT = re.compile(rf"(?P<number>[-+]?[\d.,'’ \u00a0\u202f]*\d)\s*(?P<unit>{UNIT})")
"""A number followed by its unit, as in `1450 rpm`."""
_HEMISPHERES = frozenset("NSEW")
"""Letters that behind a number mean a hemisphere rather than newtons or seconds."""


def is_value(cell: str) -> bool:
    """Return whether a cell is a number, with or without a unit, a date or a time of day."""
    return bool(NUMBER.fullmatch(cell) or TIME.match(cell) or parse_trailing_unit(cell))


def parse_trailing_unit(cell: str) -> str:
    """Return the text of the unit behind a number, or an empty string."""
    match = _WITH_UNIT.fullmatch(cell)
    if match is None or match["unit"] in _HEMISPHERES or not is_unit(match["unit"]):
        return ""
    return match["unit"]

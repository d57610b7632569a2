"""Tables that hold latitude and longitude in place of a position in metres."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from residnet.data.drafting.physics import Raw
from residnet.data.drafting.questions import Marks
from residnet.data.readers.frames import tangent_plane

_FIXES = {"x": "latitude", "y": "longitude"}
_WHERE = ("data", "reader", "channels")


def from_fixes(
    names: Mapping[str, str], logs: Sequence[Raw], marks: Marks
) -> tuple[dict[str, str], list[Raw], float]:
    """Return channel -> column, the logs, and how many degrees one count of x and y is, or 0.

    Where they are latitude and longitude, x, y of the logs are metres north and east of the first
    fix of each.

    Raises:
        UsageError: where pyproj is not installed.
    """
    fixes = set(_FIXES.values())
    if not fixes <= set(names) or set(_FIXES) & set(names):
        return dict(names), list(logs), 0.0
    rest = {name: column for name, column in names.items() if name not in fixes}
    whole = [raw for raw in logs if fixes <= set(raw.columns)]
    largest = max((_largest(raw, "latitude") for raw in whole), default=0.0)
    # autopilots count ten millionths of a degree in whole numbers
    count = 1e-7 if 1e6 < largest <= 90e7 and all(_is_whole(raw) for raw in whole) else 1.0
    if not whole or largest * count > 90.0:
        columns = ", ".join(names[name] for name in _FIXES.values())
        marks.note(_WHERE, f"{columns} are no degrees with decimals; left out")
        return rest, list(logs), 0.0
    if count < 1.0:
        for name in _FIXES.values():
            text = "whole numbers of this size are ten millionths of a degree"
            marks.guess((*_WHERE, name), text)
    placed = [_placed(raw, count) if fixes <= set(raw.columns) else raw for raw in logs]
    return {**{name: names[fix] for name, fix in _FIXES.items()}, **rest}, placed, count


def as_fixes(entries: Mapping[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return the entries of a channel map with those of x, y as latitude and longitude."""
    return {_FIXES.get(name, name): entry for name, entry in entries.items()}


def _largest(raw: Raw, name: str) -> float:
    values = raw.columns[name]
    return float(np.nanmax(np.abs(values))) if np.isfinite(values).any() else 0.0


def _is_whole(raw: Raw) -> bool:
    values = np.concatenate([raw.columns[name] for name in _FIXES.values()])
    known = values[np.isfinite(values)]
    return bool((known == np.round(known)).all())


def _placed(raw: Raw, count: float) -> Raw:
    latitude, longitude = (np.radians(count * raw.columns[name]) for name in _FIXES.values())
    known = np.isfinite(latitude) & np.isfinite(longitude) & ~((latitude == 0) & (longitude == 0))
    if not known.any():
        return raw
    first = int(np.argmax(known))
    north, east = tangent_plane(
        np.where(known, latitude, np.nan),
        np.where(known, longitude, np.nan),
        float(latitude[first]),
        float(longitude[first]),
    )
    return Raw(raw.t, {**raw.columns, "x": north, "y": east})

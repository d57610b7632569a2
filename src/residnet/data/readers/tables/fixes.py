"""Positions of tables that hold latitude and longitude."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from residnet.core.errors import DataError
from residnet.data.readers.composing.geodesy import tangent_plane
from residnet.data.readers.recording import remark

LATITUDE, LONGITUDE = "latitude", "longitude"


def with_positions(
    path: Path, channels: Mapping[str, np.ndarray], units: Mapping[str, str]
) -> tuple[dict[str, np.ndarray], dict[str, str], list[dict[str, Any]]]:
    """Return channels, units and remarks of a log, with x, y in place of latitude and longitude.

    A log without the two, or with x or y of its own, is returned as it is. The origin is the first
    fix. A receiver without a fix often writes latitude 0, longitude 0, which counts as missing.

    Args:
        path: of the file, for messages.
        channels: values [T] in SI.
        units: in SI.

    Raises:
        DataError: where a latitude is none, or no fix is left.
        UsageError: where pyproj is not installed.
    """
    if not {LATITUDE, LONGITUDE} <= set(channels) or {"x", "y"} & set(channels):
        return dict(channels), dict(units), []
    latitude, longitude = channels[LATITUDE], channels[LONGITUDE]
    none = (latitude == 0.0) & (longitude == 0.0)
    known = np.isfinite(latitude) & np.isfinite(longitude) & ~none
    if not known.any():
        raise DataError(f"{path}: latitude and longitude hold no fix")
    most = float(np.abs(latitude[known]).max())
    if units[LATITUDE] != "rad" or most > np.pi / 2:
        raise DataError(
            f"{path}: latitude reaches {np.degrees(most):.4g} deg, which none does; give the unit"
            " of its column (deg), and `form: ddmm` for degrees and minutes in one number"
        )
    first = int(np.argmax(known))
    origin = float(latitude[first]), float(longitude[first])
    north, east = tangent_plane(
        np.where(known, latitude, np.nan), np.where(known, longitude, np.nan), *origin
    )
    rest = {name: values for name, values in channels.items() if name not in (LATITUDE, LONGITUDE)}
    remarks = [
        remark(
            "note",
            "origin",
            f"x, y are north and east of the first fix, latitude {np.degrees(origin[0]):.6f} deg,"
            f" longitude {np.degrees(origin[1]):.6f} deg",
            latitude=origin[0],
            longitude=origin[1],
        )
    ]
    if none.any():
        text = f"{int(none.sum())} fixes at latitude 0, longitude 0 are no fixes; left empty"
        remarks.append(remark("note", "no_fix", text, count=float(none.sum())))
    metres = {name: unit for name, unit in units.items() if name in rest}
    return {"x": north, "y": east, **rest}, {"x": "m", "y": "m", **metres}, remarks

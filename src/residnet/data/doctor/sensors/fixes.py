"""Whether positions in metres agree with latitude and longitude of the same log."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from residnet.core.log import Log
from residnet.data.doctor.findings import Finding
from residnet.data.doctor.following import slip_in_words

_LATITUDE = ("latitude", "lat", "gps_lat", "gnss_lat", "latitude_deg", "lat_deg")
_LONGITUDE = ("longitude", "lon", "lng", "long", "gps_lon", "gnss_lon", "longitude_deg", "lon_deg")
# mean radii of curvature are within .4 % of this
_RADIUS = 6_371_000.0
_LEAST_SCALE = 0.02
_LEAST_TURN = math.radians(3.0)


def fix_findings(log: Log) -> Iterator[Finding]:
    """Return a scale or turn of x, y against latitude and longitude."""
    by_name = {name.lower(): name for name in log.channels}
    latitude = next((by_name[name] for name in _LATITUDE if name in by_name), "")
    longitude = next((by_name[name] for name in _LONGITUDE if name in by_name), "")
    if not latitude or not longitude or "x" not in log.channels or "y" not in log.channels:
        return
    north, east = (
        log[name] if log.units[name] == "rad" else np.radians(log[name])
        for name in (latitude, longitude)
    )
    fix = _RADIUS * ((north - np.nanmean(north)) + 1j * np.cos(north) * (east - np.nanmean(east)))
    place = log["x"] + 1j * log["y"]
    good = np.isfinite(fix) & np.isfinite(place)
    if good.sum() < 50:
        return
    fix, place = fix[good] - fix[good].mean(), place[good] - place[good].mean()
    if float(np.abs(fix).max()) < 1.0:
        return
    overlap = complex(np.vdot(fix, place)) / float(np.vdot(fix, fix).real)
    size = max(float(np.linalg.norm(place)), 1e-12)
    rest = float(np.linalg.norm(place - overlap * fix)) / size
    scale, turn = abs(overlap), float(np.angle(overlap))
    if rest < 0.2 and abs(scale - 1.0) < _LEAST_SCALE and abs(turn) < _LEAST_TURN:
        return
    text = (
        f"x, y are {scale:.3f} times as far as {latitude}, {longitude} say, turned by"
        f" {math.degrees(turn):+.1f} deg{slip_in_words(scale)}"
    )
    if rest >= 0.2:
        text = f"x, y do not follow {latitude}, {longitude}: {100.0 * rest:.0f} % is left"
    yield Finding(
        "will mislead",
        "positions_scaled",
        text,
        {"scale": scale, "turn": turn, "rest": rest},
        "compute x, y from latitude and longitude, or correct their unit",
    )

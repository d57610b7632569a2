"""Manoeuvring indices in words."""

from __future__ import annotations

_TITLES = {
    "time_90": "time to 90 deg",
    "time_180": "time to 180 deg",
    "steady_speed_ratio": "steady speed over approach speed",
    "pull_out_yaw_rate": "yaw rate after pull-out",
}
"""Names of indices that are not their key with spaces."""


def index_title(name: str) -> str:
    """Return a manoeuvring index in words."""
    return _TITLES.get(name, name.replace("_", " "))

"""Headings of tables that hold the attitude as a quaternion."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from residnet.core.errors import DataError
from residnet.data.readers.base import unwrap
from residnet.data.readers.composing.orientation import unit_quaternion, yaw_of
from residnet.data.readers.tables.channel_map import QUATERNION, ChannelMap


def with_heading(
    path: Path,
    channels: Mapping[str, np.ndarray],
    units: Mapping[str, str],
    maps: Mapping[str, ChannelMap],
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Return channels and units of a log, with psi in place of qx, qy, qz, qw.

    A log without them, or with a heading of its own, is returned as it is. Both signs of a
    quaternion are one attitude. Where qw has the frame `enu`, the heading counts anticlockwise
    from east.

    Args:
        path: of the file, for messages.
        channels: values [T] in SI.
        units: in SI.
        maps: entries of the channel map.

    Raises:
        DataError: where all quaternions are empty.
    """
    if not set(QUATERNION) <= set(channels) or "psi" in channels:
        return dict(channels), dict(units)
    parts = unit_quaternion(*(np.asarray(channels[name]) for name in QUATERNION))
    yaw = yaw_of(*parts)
    if not np.isfinite(yaw).any():
        columns = ", ".join(maps[name].column for name in QUATERNION)
        raise DataError(f"{path}: {columns} hold no attitude, all quaternions are empty")
    psi = unwrap(np.pi / 2.0 - yaw if maps["qw"].frame == "enu" else yaw)
    rest = {name: values for name, values in channels.items() if name not in QUATERNION}
    kept = {name: unit for name, unit in units.items() if name not in QUATERNION}
    return {**rest, "psi": psi}, {**kept, "psi": "rad"}

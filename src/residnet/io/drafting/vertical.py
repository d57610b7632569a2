"""Velocities of underwater vessels that roll and pitch, on the horizontal plane."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from residnet.core.units import to_si
from residnet.io.drafting.motion_regression import RawTable
from residnet.io.header_vocabulary import infer_unit, parse_header_unit

_MIN_TILT = 0.1
"""Angle in rad between the vertical and the vertical axis of a vessel, exceeded in 5 % of the
samples, above which velocities along its axes differ from horizontal ones (by at least 0.5 %)."""
_MIN_PITCH_COSINE = 0.1
"""Smallest cosine of a pitch angle in the rate of the heading, which is singular at 90 deg."""


def project_on_horizontal(log: RawTable, names: Mapping[str, str]) -> RawTable:
    """Return a log whose u, v and r are horizontal, along and across the heading.

    Velocities along the axes of a vessel that rolls and pitches are not horizontal, and tests of
    frames are. They are projected by the attitude, in the frame of the file: with
    R = R_z(yaw) R(tilt), the result is R(tilt) (u, v, w). Missing velocities count as zero.

    Args:
        log: mapped columns of a table.
        names: channel -> column.

    Returns:
        The log, unchanged where the vessel is upright or the velocities are not along its axes.
    """
    if not {"z", "phi", "theta"} <= log.columns.keys() & names.keys():
        return log
    roll = _convert_angle("phi", log, names)
    pitch = _convert_angle("theta", log, names)
    cosine = np.cos(roll) * np.cos(pitch)
    if float(np.nanquantile(cosine, 0.05)) > np.cos(_MIN_TILT):
        return log
    zeros = np.zeros(log.t.size)
    u, v, w, q, r = (log.columns.get(name, zeros) for name in ("u", "v", "w", "q", "r"))
    # rate of the heading, Fossen 2021, equation (2.40)
    yaw_rate = (q * np.sin(roll) + r * np.cos(roll)) / np.maximum(np.cos(pitch), _MIN_PITCH_COSINE)
    # R_y(pitch) R_x(roll) (u, v, w), Fossen 2021, equation (2.31) without the yaw
    cross_flow = v * np.sin(roll) + w * np.cos(roll)
    velocities = {
        "u": u * np.cos(pitch) + cross_flow * np.sin(pitch),
        "v": v * np.cos(roll) - w * np.sin(roll),
    }
    depth_rate = np.gradient(log.columns["z"], log.t)
    body_error = np.nanmean((depth_rate - cross_flow * np.cos(pitch) + u * np.sin(pitch)) ** 2)
    if "w" in log.columns and np.nanmean((depth_rate - w) ** 2) <= body_error:
        # a velocity of the world frame is the rate of z itself
        velocities = {}
    velocities["r"] = yaw_rate
    horizontal = {name: values for name, values in velocities.items() if name in log.columns}
    return RawTable(log.t, {**log.columns, **horizontal})


def _convert_angle(name: str, log: RawTable, names: Mapping[str, str]) -> np.ndarray:
    """Return roll or pitch [T] in rad; without a unit it has the unit of the heading.

    Small angles in deg have the size of angles in rad, whereas a heading has a large range.
    """
    reference = name
    if parse_header_unit(names[name], "rad") is None and {"psi"} <= names.keys() & log.columns:
        reference = "psi"
    unit = infer_unit(reference, names[reference], log.columns[reference]).settings["unit"]
    return np.asarray(log.columns[name] * to_si(unit, "rad"))

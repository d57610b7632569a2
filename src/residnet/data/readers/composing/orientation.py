"""Headings of a recording: quaternions to heading and roll, and where a heading starts."""

from __future__ import annotations

import numpy as np

from residnet.core.errors import DataError
from residnet.data.readers.composing.quantities import Quaternion
from residnet.data.readers.recording import Recording, Remark, Series, remark


def field_values(recording: Recording, series: Series, path: str) -> np.ndarray:
    """Return the numbers [T] of a field.

    Raises:
        DataError: where the field holds no number.
    """
    values = series[path]
    if not np.isfinite(values).any():
        raise DataError(
            f"{recording.path}: topic {series.name}: field '{path}' holds no number in any of"
            f" {values.size} rows; take it out of the map"
        )
    return values


def unit_quaternion(
    x: np.ndarray, y: np.ndarray, z: np.ndarray, w: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Return quaternions [T] of length one, x, y, z, w; NaN where they are empty."""
    norm = np.sqrt(x * x + y * y + z * z + w * w)
    known = np.isfinite(norm) & (norm > 0.5)
    length = np.where(known, norm, 1.0)
    return tuple(np.where(known, part / length, np.nan) for part in (x, y, z, w))


def yaw_of(x: np.ndarray, y: np.ndarray, z: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Return the rotation [T] about the vertical axis in rad of quaternions of length one."""
    yaw: np.ndarray = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return yaw


def from_quaternion(
    recording: Recording, series: Series, config: Quaternion
) -> tuple[np.ndarray, dict[str, np.ndarray], tuple[Remark, ...]]:
    """Return heading, roll where it is wanted, and remarks from the quaternions of a topic."""
    x, y, z, w = (field_values(recording, series, f"{config.field}.{axis}") for axis in "xyzw")
    x, y, z, w = unit_quaternion(x, y, z, w)
    known = np.isfinite(w)
    if not known.any():
        raise DataError(
            f"{recording.path}: topic {series.name}: '{config.field}' holds no orientation, all"
            " quaternions are empty"
        )
    yaw = yaw_of(x, y, z, w)
    remarks = []
    flips = int(((x[1:] * x[:-1] + y[1:] * y[:-1] + z[1:] * z[:-1] + w[1:] * w[:-1]) < 0.0).sum())
    if flips:
        text = (
            f"topic {series.name}: the quaternion changes sign {flips} times (both signs are one"
            " attitude); the heading is taken through"
        )
        remarks.append(remark("note", "quaternion_flips", text, flips=flips))
    if not known.all():
        text = f"topic {series.name}: {int((~known).sum())} quaternions are empty; no heading there"
        remarks.append(remark("note", "empty_quaternions", text, rows=int((~known).sum())))
    # roll about the forward axis has one sign in both frames
    roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    return yaw, {"phi": roll} if config.roll else {}, tuple(remarks)


def from_first_circle(psi: np.ndarray) -> np.ndarray:
    """Return a heading [T] whose first value lies in [0, 2 pi)."""
    known = np.flatnonzero(np.isfinite(psi))
    if not known.size:
        return psi
    # a heading of zero with rounding stays zero
    turns = np.floor((psi[known[0]] + 1e-6) / (2.0 * np.pi))
    unwound: np.ndarray = psi - 2.0 * np.pi * turns
    return unwound

"""What position, heading and rates say about each other: units, signs, frames, the rudder's side.

A vessel moves where it points, more or less, and turns as its heading changes. From that follow the
factor and the sign between a column and the quantity that it stands for, whatever its header says.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from residnet.core.units import si_unit, to_si, units
from residnet.data.derivatives import local_polynomials
from residnet.data.motion import without_pauses

_WINDOW = 1.0
"""Shortest time in s over which positions are differentiated."""
_FITS = 1.35
"""Largest ratio between a measured factor and that of the unit that it stands for."""
_TELLING = 0.6
"""Least correlation that says anything."""


class Frame(NamedTuple):
    """How columns called x, y, psi become north, east and a heading clockwise from north.

    Attributes:
        swapped: x is the east and y the north.
        from_east: psi counts counter-clockwise from east.
    """

    swapped: bool
    from_east: bool


FRAMES = (Frame(False, False), Frame(True, False), Frame(False, True))
"""Frames that can be told apart; both changes together are a mirror image that fits as well."""
POSE_FRAMES = (Frame(True, True), Frame(True, False))
"""Frames of a pose of ROS, by REP 103 first: x east, y north, headings from east."""


@dataclass(frozen=True)
class Raw:
    """Columns of one log as they stand in its file.

    Attributes:
        t: times [T] in s.
        columns: channel -> values [T] in whatever unit.
    """

    t: np.ndarray
    columns: Mapping[str, np.ndarray]


class Fit(NamedTuple):
    """How a column follows the quantity that it may stand for.

    Attributes:
        factor: that brings the column to SI; negative where it points the other way.
        correlation: between both, without sign.
    """

    factor: float
    correlation: float

    @property
    def telling(self) -> bool:
        """Whether both follow each other."""
        return self.correlation >= _TELLING and np.isfinite(self.factor) and self.factor != 0.0

    def unit(self, expected: str) -> str | None:
        """Return the unit whose factor this is; None where no unit comes near."""
        odd = ("rad/min", "m/min", "cm/s")
        known = [n for n in units() if si_unit(n) == expected and n not in odd]
        best = min(known, key=lambda name: abs(np.log(abs(self.factor) / to_si(name))))
        ratio = abs(self.factor) / to_si(best)
        return best if 1.0 / _FITS < ratio < _FITS else None


class Motion(NamedTuple):
    """The motion of one log by its positions and headings, on a uniform grid.

    Attributes:
        t: times [T].
        forward: speed along the heading [T].
        sideways: speed to starboard [T].
        turning: rate of the heading [T].
    """

    t: np.ndarray
    forward: np.ndarray
    sideways: np.ndarray
    turning: np.ndarray


def heading_of(raw: Raw, unit: str, frame: Frame) -> np.ndarray:
    """Return the heading [T] in rad, unwrapped over its known samples."""
    psi = raw.columns["psi"] * to_si(unit, "rad")
    psi = np.pi / 2 - psi if frame.from_east else psi
    out = np.full(psi.size, np.nan)
    known = np.isfinite(psi)
    out[known] = np.unwrap(psi[known])
    return out


def motion_of(raw: Raw, unit: str, frame: Frame) -> Motion | None:
    """Return the motion by position and heading; None where there are too few of either.

    Args:
        raw: with the columns x, y, psi.
        unit: of the heading.
        frame: that is tried.
    """
    psi = heading_of(raw, unit, frame)
    north, east = ("y", "x") if frame.swapped else ("x", "y")
    known = np.isfinite(raw.columns[north]) & np.isfinite(raw.columns[east]) & np.isfinite(raw.t)
    turns = np.isfinite(psi) & np.isfinite(raw.t)
    if min(int(known.sum()), int(turns.sum())) < 30:
        return None
    at = raw.t[known]
    step = float(np.median(np.diff(at)))
    if step <= 0.0 or (at[-1] - at[0]) / step > 1e6:
        return None
    grid = np.arange(at[0], at[-1], step)
    window = max(5, 2 * round(0.5 * _WINDOW / step) + 1)
    if grid.size < 3 * window:
        return None

    def rate(t: np.ndarray, values: np.ndarray) -> np.ndarray:
        return local_polynomials(np.interp(grid, t, values)[:, None], window, 2, step)[1][:, 0]

    speed_north = rate(at, raw.columns[north][known])
    speed_east = rate(at, raw.columns[east][known])
    heading = np.interp(grid, raw.t[turns], psi[turns])
    c, s = np.cos(heading), np.sin(heading)
    return Motion(
        grid,
        c * speed_north + s * speed_east,
        c * speed_east - s * speed_north,
        rate(raw.t[turns], psi[turns]),
    )


def along(motions: Sequence[Motion | None]) -> float:
    """Return how far vessels moved where they pointed, from -1 (astern) over 0 (anywhere) to 1."""
    there = [motion for motion in motions if motion is not None]
    ahead = sum(float((m.forward * np.hypot(m.forward, m.sideways)).sum()) for m in there)
    whole = sum(float((m.forward**2 + m.sideways**2).sum()) for m in there)
    return ahead / whole if whole > 0.0 else 0.0


def follows(logs: Sequence[Raw], motions: Sequence[Motion | None], channel: str) -> Fit:
    """Return how a column follows the motion, over all logs that hold it.

    Args:
        logs: with the column.
        motions: of the same logs.
        channel: `u`, `v` or `r`.
    """
    which = {"u": 1, "v": 2, "r": 3}[channel]
    both = column = motion = 0.0
    for raw, moved in zip(logs, motions, strict=True):
        values = raw.columns.get(channel)
        if moved is None or values is None:
            continue
        known = np.isfinite(values) & np.isfinite(raw.t)
        if known.sum() < 30:
            continue
        seen = np.interp(moved.t, raw.t[known], values[known])
        told = moved[which]
        # positions and headings jump at times, which is no motion
        calm = np.abs(told) <= 5.0 * float(np.quantile(np.abs(told), 0.95)) + 1e-12
        # about their means: a bias is no factor, and a steady speed tells one all the same
        mean = 0.0 if channel == "u" else float(seen[calm].mean())
        other = 0.0 if channel == "u" else float(told[calm].mean())
        a, b = seen[calm] - mean, told[calm] - other
        both += float(a @ b)
        column += float(a @ a)
        motion += float(b @ b)
    if min(column, motion) <= 0.0:
        return Fit(0.0, 0.0)
    # of two noisy quantities neither explains the other: the factor lies between both regressions
    correlation = both / np.sqrt(column * motion)
    return Fit(float(np.sign(both) * np.sqrt(motion / column)), abs(float(correlation)))


def turns_to(
    logs: Sequence[Raw], channel: str, rate: Mapping[int, np.ndarray], angle: str | None = None
) -> tuple[float, float]:
    """Return how a rudder's angle turns the vessel, and the standard error of that.

    The growth of the yaw rate over two seconds is explained by the rudder's mean angle over them
    and by the yaw rate itself. Of planes it is the pitch rate, which weight and buoyancy change by
    the pitch, too.

    Args:
        logs: with the column.
        channel: of the rudder or the planes.
        rate: yaw or pitch rate [T] of each log by its number, rad/s.
        angle: column of the angle that the vessel is righted by; None for none.
    """
    rows, grown = [], []
    for number, raw in enumerate(logs):
        values, r = raw.columns.get(channel), rate.get(number)
        if values is None or r is None:
            continue
        held = np.zeros(raw.t.size) if angle is None else raw.columns[angle]
        known = np.isfinite(values) & np.isfinite(r) & np.isfinite(raw.t) & np.isfinite(held)
        if known.sum() < 50:
            continue
        t, v, w = without_pauses(raw.t[known]), values[known], r[known]
        span = max(2.0, 3.0 * float(np.median(np.diff(t))))
        grid = np.arange(t[0], t[-1] - span, span / 4)
        if grid.size < 10:
            continue
        first, last = np.interp(grid, t, w), np.interp(grid + span, t, w)
        mean = np.mean(
            [np.interp(grid + share * span, t, v) for share in (0.0, 0.25, 0.5, 0.75)], 0
        )
        tilt = np.interp(grid, t, held[known])
        rows.append(np.stack((mean, first, np.ones(grid.size), tilt), axis=1))
        grown.append(last - first)
    if not rows:
        return 0.0, 1.0
    a, b = np.concatenate(rows), np.concatenate(grown)
    scale = np.maximum(np.abs(a).max(axis=0), 1e-12)
    solution, *_ = np.linalg.lstsq(a / scale, b, rcond=1e-9)
    left = b - (a / scale) @ solution
    # neighbouring rows overlap: a quarter of them counts
    variance = 4.0 * float(left @ left) / max(b.size - 3, 1)
    spread = float(np.sqrt(variance * np.linalg.pinv((a / scale).T @ (a / scale))[0, 0]))
    return float(solution[0]), spread

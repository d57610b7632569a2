"""Tables of a vessel's turns from straight ahead to straight ahead, by how long the rudder is held.

Positions are complex numbers, north + i east in m.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, final

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from residnet.control.courses.turns import Array, Turn, TurnMaker
from residnet.control.heading.turning import Turning

POINTS = 28
"""Points of a turn beside its beginning."""
_MOST = math.radians(500.0)
"""The largest angle of a turn in a table."""
_HOLDS = 56
"""Angles of turns in a table, nine degrees apart."""
_NOTHING = 2e-3
"""Below it what a turn leaves does not count: shares of speed and radius, and rad."""
_SETTLED = 4.0
"""Time constants after which the vessel runs straight behind a turn."""


class Part(NamedTuple):
    """Turns, or the legs behind them: points [n, K] complex, last headings [n], and times [n].

    Also their derivatives.
    """

    points: np.ndarray
    headings: Array
    times: Array


@final
class TurnTable:
    """Turns to starboard at one rudder angle, as smooth functions of the time it is held.

    Args:
        holds: [K] in s, from 0 on.
        points: [K, POINTS] complex positions in m in the frame of the beginning; the last one is
            where the straight leg behind the turn begins.
        headings: [K, POINTS] of the vessel in rad; the last one is the direction of that leg.
        times: [K] that the turns take, in s.
        rudder: the angle that is held, in rad.
        leg: north, east and heading of the leg behind by its length, in the frame of its beginning;
            None for a straight one.
    """

    def __init__(
        self,
        holds: Array,
        points: np.ndarray,
        headings: Array,
        times: Array,
        rudder: float,
        leg: CubicSpline | None = None,
    ) -> None:
        rows = np.concatenate((points.real, points.imag, headings, times[:, None]), axis=1)
        self.rudder, self.longest = rudder, float(holds[-1])
        self.leg, self.bent = leg, None if leg is None else leg.derivative()
        self.spline = CubicSpline(holds, rows)
        self.slope = self.spline.derivative()
        self.angles, self.holds, self.ends = headings[:, -1], holds, points[:, -1]

    def __call__(self, hold: float) -> tuple[np.ndarray, Array, float]:
        """Return the points [POINTS], headings [POINTS] and the time of a turn."""
        row = self.spline(hold)
        return row[:POINTS] + 1j * row[POINTS : 2 * POINTS], row[2 * POINTS : -1], float(row[-1])

    def along(self, lengths: Array) -> tuple[Part, Part]:
        """Return the leg behind at lengths [..., K] in m, and what it changes by with each."""
        none = np.zeros(lengths.shape[:-1])
        if self.leg is None or self.bent is None:
            straight = lengths.astype(complex)
            return Part(straight, none, none), Part(np.ones_like(straight), none, none)
        known = np.minimum(lengths, self.leg.x[-1])
        rows, bent = self.leg(known), self.bent(known)
        onward = np.exp(1j * rows[..., 2])
        inside = lengths <= self.leg.x[-1]
        places = rows[..., 0] + 1j * rows[..., 1] + (lengths - known) * onward
        moved = np.where(inside, bent[..., 0] + 1j * bent[..., 1], onward)
        turned = np.where(inside, bent[..., 2], 0.0)
        return Part(places, rows[..., -1, 2], none), Part(moved, turned[..., -1], none)

    def hold(self, angle: float) -> float:
        """Return the time in s that a turn of an angle in rad is held for."""
        return float(np.interp(angle, self.angles, self.holds))

    @cached_property
    def fitted(self) -> tuple[float, float, float]:
        """The radius of an arc, and the straight parts in m before and behind it.

        Together they lead where the turns lead, by least squares over their angles.
        """
        inside = (self.angles > math.radians(20.0)) & (self.angles < math.radians(300.0))
        turned, end = np.exp(1j * self.angles[inside]), self.ends[inside]
        columns = np.stack((1j * (1.0 - turned), np.ones_like(turned), turned), axis=1)
        found = np.linalg.lstsq(
            np.concatenate((columns.real, columns.imag)),
            np.concatenate((end.real, end.imag)),
            rcond=None,
        )[0]
        return float(found[0]), max(float(found[1]), 0.0), max(float(found[2]), 0.0)


@dataclass(frozen=True)
class Turns:
    """The tables of a vessel by rudder angle.

    Attributes:
        tables: of turns, that of the largest rudder angle first.
        speed: on straight legs, in m/s.
        radius: the smallest of a turn, in m.
        settled: whether turns leave no motion that the turns behind them begin with.
    """

    tables: tuple[TurnTable, ...]
    speed: float
    radius: float
    settled: bool = True

    def at(self, numbers: Sequence[int], holds: Array) -> tuple[Part, Part]:
        """Return turns of tables [n] held for [n] in s, to starboard, and their derivatives."""
        rows, slopes = np.zeros((2, len(holds), 3 * POINTS + 1))
        for number, which in _groups(numbers):
            rows[which] = self.tables[number].spline(holds[which])
            slopes[which] = self.tables[number].slope(holds[which])
        made, change = (
            Part(part[:, :POINTS] + 1j * part[:, POINTS : 2 * POINTS], part[:, -2], part[:, -1])
            for part in (rows, slopes)
        )
        return made, change

    def legs(self, numbers: Sequence[int], lengths: Array) -> tuple[Part, Part]:
        """Return the legs behind such turns at lengths [n, K] in m, and their derivatives."""
        count = len(lengths)
        both = [
            Part(np.zeros(lengths.shape, complex), np.zeros(count), np.zeros(count))
            for _ in range(2)
        ]
        for number, which in _groups(numbers):
            for whole, found in zip(both, self.tables[number].along(lengths[which]), strict=True):
                for into, values in zip(whole, found, strict=True):
                    into[which] = values
        return both[0], both[1]


def _groups(numbers: Sequence[int]) -> list[tuple[int, NDArray[np.intp]]]:
    """Return each table's number and the turns that are of it."""
    every = np.array(numbers, dtype=np.intp)
    return [(int(number), np.flatnonzero(every == number)) for number in np.unique(every)]


def arcs(radii: Array, speed: float) -> Turns:
    """Return the turns of a vessel that yaws at once: arcs of the radii [n] in m."""
    angles = np.linspace(0.0, _MOST, _HOLDS)
    headings = angles[:, None] * np.linspace(0.0, 1.0, POINTS + 1)[1:]
    tables = [
        TurnTable(
            angles * radius / speed,
            1j * radius * (1.0 - np.exp(1j * headings)),
            headings,
            angles * radius / speed,
            0.0,
        )
        for radius in radii
    ]
    return Turns(tuple(tables), speed, float(radii[0]))


def simulated_turns(make: TurnMaker, rudder: Array, radius: float) -> Turns:
    """Return the turns of a vessel at rudder angles [n] in rad, each from straight ahead.

    Behind a turn the sway dies out. The leg is put where it ends up, and the last part of the turn
    is bent towards it.

    Args:
        make: the simulated turns.
        rudder: angles, the largest first.
        radius: the vessel's smallest turning radius in m.
    """
    turning = make.turning
    holds = np.stack([_holds(np.linspace(0.0, 1.0, _HOLDS), angle, turning) for angle in rudder])
    tail = _SETTLED * turning.time
    made = make(holds[:, 1:], rudder, [make.straight] * len(rudder), tail)
    share = np.linspace(0.0, 1.0, POINTS + 1)[1:]
    tables, left = [], 0.0
    for angle, held, group in zip(rudder, holds, made, strict=True):
        points, headings, times = _sampled(group)
        for k, turn in enumerate(group):
            track, course = turn.along(np.linspace(0.0, tail, 60))
            moved = float(np.hypot(*np.diff(track, axis=0).T).sum())
            end = complex(*track[-1]) - moved * np.exp(1j * course[-1])
            slower = abs(moved / (turning.speed * tail) - 1.0)
            aside = abs(end - points[k, -1]) / radius
            left = max(left, slower, aside, abs(float(course[-1]) - headings[k, -1]))
            points[k] += share**3 * (end - points[k, -1])
            headings[k] += share**3 * (course[-1] - headings[k, -1])
        none = np.zeros((1, POINTS))
        tables.append(
            TurnTable(
                held,
                np.concatenate((none, points)),
                np.concatenate((none, headings)),
                np.concatenate(([0.0], times)),
                float(angle),
            )
        )
    return Turns(tuple(tables), turning.speed, radius, left < _NOTHING)


def following_turns(
    make: TurnMaker, holds: Array, rudder: Array, begin: Sequence[Array], radius: float
) -> tuple[Turns, list[Turn]]:
    """Return tables of n turns, each from a motion of its own, and the middle one of each.

    Args:
        make: the simulated turns.
        holds: [n, K] in s, K odd.
        rudder: [n] in rad, positive to starboard.
        begin: state of the vessel [nx] that each begins with.
        radius: the vessel's smallest turning radius in m.
    """
    tail = 2.0 * _SETTLED * make.turning.time
    made = make(holds, rudder, begin, tail)
    tables, middles = [], []
    for angle, held, group in zip(rudder, holds, made, strict=True):
        points, headings, times = _sampled(group)
        middle = group[len(group) // 2]
        track, course = middle.along(np.linspace(0.0, tail, 80))
        places = (track - track[0]) @ (1.0, 1j) * np.exp(-1j * course[0])
        leg = np.stack((places.real, places.imag, course - course[0]), axis=-1)
        if angle < 0:
            points, headings = points.conj(), -headings
            leg[:, 1:] *= -1.0
        moved = np.concatenate(([0.0], np.cumsum(np.abs(np.diff(places)))))
        tables.append(
            TurnTable(held, points, headings, times, abs(float(angle)), CubicSpline(moved, leg))
        )
        middles.append(middle)
    return Turns(tuple(tables), make.turning.speed, radius), middles


def state_behind(turn: Turn, length: float) -> Array:
    """Return the state of the vessel [nx] after a length in m of the leg behind a turn."""
    times = np.linspace(0.0, float(turn.leg.x[-1]), 80)
    track, _ = turn.along(times)
    moved = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(track, axis=0).T))))
    state: Array = turn.leg(float(np.interp(length, moved, times)))
    return state


def _sampled(group: Sequence[Turn]) -> tuple[np.ndarray, Array, Array]:
    """Return points [K, POINTS], headings [K, POINTS] and times [K] of turns, even in time."""
    share = np.linspace(0.0, 1.0, POINTS + 1)[1:]
    points, headings = np.zeros((len(group), POINTS), dtype=complex), np.zeros((len(group), POINTS))
    for k, turn in enumerate(group):
        track, headings[k] = turn.at(share * turn.lasts)
        points[k] = track @ (1.0, 1j)
    return points, headings, np.array([turn.lasts for turn in group])


def _holds(share: Array, rudder: float, turning: Turning) -> Array:
    """Return the times in s for which the rudder is held, up to the largest angle of a turn.

    By Nomoto's model angles are K d (t1 - t2), t2 = T ln(2 - exp(-t1 / T)).
    """
    longest = _MOST / (turning.gain * rudder) + math.log(2.0) * turning.time
    return share**1.3 * longest

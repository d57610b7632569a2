"""A route: straight legs and turns in turn, and how far its points move with their lengths."""

from __future__ import annotations

import cmath
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from residnet.control.courses.turn_table import POINTS, Turns
from residnet.control.courses.turns import Array

LEG = 12
"""Points of a leg beside its beginning."""
_FINE = 8
"""Times as many points as a turn is searched with describe it in the end."""


@dataclass(frozen=True)
class Bend:
    """A turn of a route before its time is known.

    Attributes:
        side: +1 to starboard, -1 to port.
        angle: in rad.
        table: number of the table of turns.
        passed: buoys that are passed in it.
    """

    side: int
    angle: float
    table: int
    passed: tuple[int, ...] = ()


@dataclass(frozen=True)
class Sketch:
    """A route in outline.

    Attributes:
        heading: of the first leg in rad.
        legs: [n + 1] lengths in m.
        bends: [n] between the legs.
        passed: for each leg, the buoys that are passed on it.
    """

    heading: float
    legs: tuple[float, ...]
    bends: tuple[Bend, ...]
    passed: tuple[tuple[int, ...], ...]

    def simplified(self, short: float, small: float) -> Sketch:
        """Return the outline with bends joined that turn to one side with a short leg between.

        Bends below `small` rad are left out.
        """
        sketch, k = self, 0
        while k < len(sketch.bends):
            bend = sketch.bends[k]
            if bend.angle < small:
                sketch = sketch._without(k)
                k = max(k - 1, 0)
                continue
            following = sketch.bends[k + 1] if k + 1 < len(sketch.bends) else None
            if following and following.side == bend.side and sketch.legs[k + 1] < short:
                sketch = sketch._joined(k)
                continue
            k += 1
        return sketch

    def _without(self, k: int) -> Sketch:
        """Return the outline without a bend: both legs beside it are one."""
        legs = (*self.legs[:k], self.legs[k] + self.legs[k + 1], *self.legs[k + 2 :])
        here = (*self.passed[k], *self.bends[k].passed, *self.passed[k + 1])
        passed = (*self.passed[:k], here, *self.passed[k + 2 :])
        return Sketch(self.heading, legs, (*self.bends[:k], *self.bends[k + 1 :]), passed)

    def _joined(self, k: int) -> Sketch:
        """Return the outline with a bend and the next as one."""
        one, two = self.bends[k], self.bends[k + 1]
        wider = max(one, two, key=lambda bend: bend.angle)
        bend = replace(
            wider,
            angle=one.angle + two.angle,
            passed=(*one.passed, *self.passed[k + 1], *two.passed),
        )
        half = 0.5 * self.legs[k + 1]
        legs = (
            *self.legs[:k],
            self.legs[k] + half,
            self.legs[k + 2] + half,
            *self.legs[k + 3 :],
        )
        passed = (*self.passed[: k + 1], *self.passed[k + 2 :])
        return Sketch(self.heading, legs, (*self.bends[:k], bend, *self.bends[k + 2 :]), passed)


@dataclass(frozen=True)
class Drawn:
    """A route's points, its length of time, and what they change by.

    A point moves with a length of its own part of the route, and with those of all parts before
    it: these shift it and turn it about where they end.

    Attributes:
        points: [S] complex in m, from the start on.
        time: in s.
        heading: of the last leg in rad.
        slower: derivatives [nz] of the time.
        turned: derivatives [nz] of the last heading.
        inner: derivatives [S] of the points by the length of their own part.
        own: number in z of that length [S].
        after: first point [nz] behind the part of each length.
        shift, turn, pivot: what each length does to the points behind its part [nz].
        units: of z [nz].
    """

    points: np.ndarray
    time: float
    heading: float
    slower: Array
    turned: Array
    inner: np.ndarray
    own: NDArray[np.intp]
    after: NDArray[np.intp]
    shift: np.ndarray
    turn: Array
    pivot: np.ndarray
    units: Array

    def moved(self, at: NDArray[np.intp]) -> np.ndarray:
        """Return the derivatives [P, nz] of points with the numbers [P]."""
        away = self.points[at][:, None] - self.pivot
        rows = np.where(at[:, None] >= self.after, self.shift + 1j * self.turn * away, 0.0)
        own = self.own[at]
        inside = np.flatnonzero(own > 0)
        rows[inside, own[inside]] = self.inner[at[inside]]
        result: np.ndarray = rows * self.units
        return result


def _mirrored(points: np.ndarray, sides: Array) -> np.ndarray:
    """Return turns [n, K] to starboard as turns to their sides [n]: to port they are mirrored."""
    result: np.ndarray = points.real + 1j * sides[:, None] * points.imag
    return result


@final
@dataclass
class Route:
    """A route as a function of z = (first heading, leg, hold, leg, hold, ..., leg).

    Headings are in rad, legs in m and holds in s, each divided by its unit.

    Attributes:
        start: complex, in m.
        sides: [n] of the turns.
        numbers: [n] of their tables.
        turns: the tables.
        units: [2 n + 2] of z.
    """

    start: complex
    sides: tuple[int, ...]
    numbers: tuple[int, ...]
    turns: Turns
    units: Array = field(init=False)

    def __post_init__(self) -> None:
        self.units = np.ones(2 + 2 * len(self.sides))
        self.units[1::2] = self.turns.radius
        self.units[2::2] = self.turns.radius / self.turns.speed

    def begin(self, sketch: Sketch) -> Array:
        """Return the z that an outline stands for; turns need room before and behind them."""
        z = np.zeros(len(self.units))
        z[0], legs = sketch.heading, np.array(sketch.legs)
        for k, bend in enumerate(sketch.bends):
            table = self.turns.tables[bend.table]
            _, before, behind = table.fitted
            z[2 + 2 * k] = table.hold(bend.angle)
            part = min(bend.angle / 0.8, 1.0)
            legs[k] -= part * before
            legs[k + 1] -= part * behind
        z[1::2] = np.maximum(legs, 0.0)
        result: Array = z / self.units
        return result

    def least(self) -> Array:
        """Return the smallest z."""
        least = np.zeros(len(self.units))
        least[0] = -np.inf
        least[2::2] = [self.turns.tables[number].holds[0] for number in self.numbers]
        result: Array = least / self.units
        return result

    def most(self) -> Array:
        """Return the largest z."""
        most = np.full(len(self.units), np.inf)
        most[2::2] = [self.turns.tables[number].longest for number in self.numbers]
        result: Array = most / self.units
        return result

    def place_of(self, sketch: Sketch, buoys: np.ndarray) -> NDArray[np.intp]:
        """Return the points [N] at which an outline passes its buoys, in their order."""
        z = self.begin(sketch)
        points = self(z).points
        at, last = np.zeros(len(buoys), dtype=np.intp), 0
        parts: list[tuple[int, int, Sequence[int]]] = []
        place = 0
        for k, on_leg in enumerate(sketch.passed):
            parts.append((place, place + LEG, on_leg))
            place += LEG
            if k < len(sketch.bends):
                parts.append((place, place + POINTS, sketch.bends[k].passed))
                place += POINTS
        for low, high, passed in parts:
            for buoy in passed:
                begin = min(max(low, last), high)
                near = begin + int(np.abs(points[begin : high + 1] - buoys[buoy]).argmin())
                at[buoy] = last = near
        return at

    def __call__(self, z: Array) -> Drawn:
        """Return the points of z, the time, and what they change by."""
        z = z * self.units
        size, number, speed = len(z), len(self.sides), self.turns.speed
        sides, begin, first = np.array(self.sides, dtype=float), float(z[0]), float(z[1])
        shares = np.linspace(0.0, 1.0, LEG + 1)[1:]
        made, change = self.turns.at(self.numbers, z[2::2])
        behind, onward = self.turns.legs(self.numbers, z[3::2, None] * shares)
        made, change, behind, onward = (
            part._replace(points=_mirrored(part.points, sides))
            for part in (made, change, behind, onward)
        )
        bent, swung = sides * made.headings, sides * behind.headings
        levels = begin + np.concatenate(([0.0], np.cumsum(bent + swung)))
        along, beyond = np.exp(1j * levels), np.exp(1j * (levels[:-1] + bent))
        track = along[:-1, None] * made.points
        leg = beyond[:, None] * behind.points
        at = self.start + first * along[0]
        ends = at + np.cumsum(track[:, -1:] + leg[:, -1:])
        corners = np.concatenate(([at], ends))[:-1] + track[:, -1]
        starts = np.concatenate(([at], ends))[:-1]
        parts = np.concatenate((starts[:, None] + track, corners[:, None] + leg), axis=1)
        points = np.concatenate(
            ([self.start], self.start + first * along[0] * shares, parts.ravel())
        )
        inner = np.concatenate(
            (
                along[:-1, None] * change.points,
                shares * beyond[:, None] * onward.points,
            ),
            axis=1,
        )
        shift, turn, pivot = np.zeros(size, complex), np.zeros(size), np.full(size, self.start)
        turn[0], shift[1], pivot[1] = 1.0, along[0], at
        turn[2::2], turn[3::2] = sides * change.headings, sides * onward.headings
        shift[2::2] = along[:-1] * change.points[:, -1]
        shift[3::2] = beyond * onward.points[:, -1]
        pivot[2::2], pivot[3::2] = corners, ends
        lengths = np.array([1, LEG, *(POINTS, LEG) * number])
        slower = np.zeros(size)
        slower[1::2], slower[2::2] = 1.0 / speed, change.times
        return Drawn(
            points,
            float(z[1::2].sum()) / speed + float(made.times.sum()),
            float(levels[-1]),
            slower * self.units,
            turn * self.units,
            np.concatenate(([0.0], along[0] * shares, inner.ravel())),
            np.repeat(np.arange(size), lengths),
            np.concatenate(([0], np.cumsum(lengths)[1:])),
            shift,
            turn,
            pivot,
            self.units,
        )

    def sailed(self, z: Array) -> list[tuple[np.ndarray, Array, float]]:
        """Return the parts of a route: points [K] complex, vessel's headings [K], and rudder."""
        z = z * self.units
        level, at = float(z[0]), self.start
        along = cmath.exp(1j * level)
        parts = [(np.array([at, at + float(z[1]) * along]), np.full(2, level), 0.0)]
        at += float(z[1]) * along
        for k, (side, number) in enumerate(zip(self.sides, self.numbers, strict=True)):
            hold, leg, table = float(z[2 + 2 * k]), float(z[3 + 2 * k]), self.turns.tables[number]
            track, heading, lasted = table(hold)
            share = min(hold / lasted, 1.0) if lasted > 0 else 1.0
            over = min(max(round(share * _FINE * POINTS), 1), _FINE * POINTS)
            track, heading = (
                np.concatenate(([0.0], track if side > 0 else track.conj())),
                np.concatenate(([0.0], side * heading)),
            )
            even = np.linspace(0.0, 1.0, POINTS + 1)
            smooth = CubicSpline(even, np.stack((track.real, track.imag, heading.real), axis=-1))
            fine = smooth(np.linspace(0.0, 1.0, _FINE * POINTS + 1))
            points, heading = at + along * (fine[:, 0] + 1j * fine[:, 1]), fine[:, 2]
            parts.append((points[: over + 1], level + heading[: over + 1], side * table.rudder))
            parts.append((points[over:], level + heading[over:], -side * table.rudder))
            level += float(heading[-1])
            along, at = cmath.exp(1j * level), complex(points[-1])
            behind, _ = table.along(leg * np.linspace(0.0, 1.0, 100)[:, None] ** 2)
            places = behind.points[:, 0] if side > 0 else behind.points[:, 0].conj()
            parts.append((at + along * places, level + side * behind.headings, 0.0))
            level += side * float(behind.headings[-1])
            along, at = cmath.exp(1j * level), complex(parts[-1][0][-1])
        return parts

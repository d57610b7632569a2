"""The search for the quickest course of turns and legs.

Splines through simulated turns give what a choice of times leads to.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, final

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import Bounds, minimize

from residnet.control.courses.turns import Array, Turn

_LEG = 60
"""Points of a leg, denser at its beginning, where the turn's sway dies out; many more where a turn
is not one of several.
"""
_ASIDE = 0.5
"""By which the first heading may be changed, in rad."""
_DIFFERENCE = 1e-5
_ROUNDS = 60
_WEIGHTS = (1.0, 0.1)
_PENALTY = 100.0
"""Units of time for a turning radius by which a mark is missed."""


class Mark(NamedTuple):
    """What a turn is made at.

    Attributes:
        number: of the buoy or way-point, from 1.
        north, east: in m.
        turn: to starboard (+1) or to port (-1).
        clearance: between the mark and the track in m, the mark on the inner side; where it is
            negative, the track may pass within that distance on either side.
        rudder: angle that the turn is made with in rad, positive.
    """

    number: int
    north: float
    east: float
    turn: int
    clearance: float
    rudder: float


@dataclass(frozen=True)
class CourseRequest:
    """The start, the marks and the end of a course.

    Attributes:
        start: north, east [2] in m.
        heading: at the start in rad; None to start on the first leg.
        marks: in their order.
        goal: where it ends.
        radius: the vessel's turning radius in m, the unit of lengths.
        speed: in m/s; times count in radius / speed.
    """

    start: Array
    heading: float | None
    marks: tuple[Mark, ...]
    goal: Mark
    radius: float
    speed: float

    @property
    def unit(self) -> float:
        """The unit of times in s."""
        return self.radius / self.speed

    @property
    def first(self) -> int:
        """Turns before the first mark's: one where the heading at the start is given."""
        return 0 if self.heading is None else 1

    @cached_property
    def low(self) -> Array:
        """Least clearance of each mark, then of the goal."""
        return np.array([mark.clearance for mark in (*self.marks, self.goal)]) / self.radius

    @cached_property
    def high(self) -> Array:
        """Largest clearance of each mark, then of the goal."""
        passed = np.where(self.low > 0, np.inf, -self.low)
        # the course ends where it touches the goal's circle
        passed[-1] = abs(self.low[-1])
        return passed


@final
class Family:
    """A turn and the leg behind it as functions of the time for which the rudder is held.

    They are cubic splines through simulated turns, in units of the course's time; a single turn
    stands for itself.

    Args:
        turns: from one and the same motion, held ever longer.
        unit: of times in s.
    """

    def __init__(self, turns: Sequence[Turn], unit: float) -> None:
        self.times = (
            turns[0].leg.x[-1]
            * np.linspace(0.0, 1.0, _LEG if len(turns) > 1 else 10 * _LEG) ** 2
            / unit
        )
        rows = []
        for turn in turns:
            after, heading = turn.along(unit * self.times)
            rows.append(
                np.concatenate(
                    (turn.track.ravel(), after.ravel(), heading, [turn.times[-1] / unit])
                )
            )
        holds = np.array([turn.hold for turn in turns]) / unit
        self.points = len(turns[0].track)
        self.low, self.high = float(holds[0]), float(holds[-1])
        self.row = rows[0]
        self.spline = CubicSpline(holds, np.array(rows)) if len(turns) > 1 else None

    def __call__(self, hold: float) -> tuple[Array, Array, Array, float]:
        """Return the turn's track [N, 2], the leg's [M, 2], its headings [M] and beginning.

        The turn's track ends with the counter-rudder; the leg is sampled at `times`.
        """
        row = self.row if self.spline is None else self.spline(hold)
        split, end = 2 * self.points, 2 * (self.points + len(self.times))
        return (
            row[:split].reshape(-1, 2),
            row[split:end].reshape(-1, 2),
            row[end:-1],
            float(row[-1]),
        )


def rotated(points: Array, heading: float) -> Array:
    """Return the points [N, 2] of a frame with that heading in the earth's frame."""
    c, s = math.cos(heading), math.sin(heading)
    rotated: Array = points @ np.array([[c, s], [-s, c]])
    return rotated


def _clearance(mark: Mark, track: Array) -> float:
    """Return the distance of a mark from a track of straight pieces, positive on the inner side."""
    place = np.array([mark.north, mark.east])
    begin, piece = track[:-1], np.diff(track, axis=0)
    square = (piece**2).sum(axis=1)
    share = np.clip(((place - begin) * piece).sum(axis=1) / np.maximum(square, 1e-12), 0.0, 1.0)
    offset = place - begin - share[:, None] * piece
    near = int((offset**2).sum(axis=1).argmin())
    side = piece[near, 0] * offset[near, 1] - piece[near, 1] * offset[near, 0]
    return math.copysign(math.hypot(*offset[near]), side * mark.turn)


@final
class Problem:
    """What a choice of times leads to: z = (first heading, leg, hold, leg, hold, ..., leg).

    Headings are in rad, times in the course's unit of time.

    Args:
        request: the course that is asked for.
        families: of its turns.
        straight: speed of the first leg in m/s.
    """

    def __init__(self, request: CourseRequest, families: Sequence[Family], straight: float) -> None:
        self.request, self.families, self.straight = request, families, straight

    def legs(self, z: Array) -> tuple[list[tuple[Array, Array]], float, float]:
        """Return the tracks of turns and legs in the earth's frame, the last heading and the time.

        Before the first leg there is no turn.
        """
        level, unit = float(z[0]), self.request.unit
        along = np.array([math.cos(level), math.sin(level)])
        at = self.request.start + self.straight * unit * float(z[1]) * along
        parts, time = [(self.request.start[None], np.stack((self.request.start, at)))], float(z[1])
        for family, hold, leg in zip(self.families, z[2::2], z[3::2], strict=True):
            track, after, heading, begin = family(float(hold))
            passed = int(np.searchsorted(family.times, leg))
            end = np.array([np.interp(leg, family.times, after[:, i]) for i in range(2)])
            remaining = np.concatenate((after[:passed], end[None]))
            parts.append((at + rotated(track, level), at + rotated(remaining, level)))
            at = parts[-1][1][-1]
            level += float(np.interp(leg, family.times, heading))
            time += begin + float(leg)
        return parts, level, time

    def results(self, z: Array) -> Array:
        """Return the time, the clearances of marks and goal, and the distance left on the last leg.

        The course ends where that distance is zero: abeam of the goal.
        """
        request = self.request
        parts, level, time = self.legs(z)
        results = []
        for i, mark in enumerate(request.marks, start=request.first):
            results.append(_clearance(mark, np.concatenate((parts[i][1], *parts[i + 1]))))
        remaining = np.array([request.goal.north, request.goal.east]) - parts[-1][1][-1]
        along = remaining[0] * math.cos(level) + remaining[1] * math.sin(level)
        across = request.goal.turn * (
            remaining[1] * math.cos(level) - remaining[0] * math.sin(level)
        )
        if request.goal.clearance > 0:
            results += [across, along]
        else:
            results += [math.hypot(along, across), 0.0]
        return np.array([time, *(value / request.radius for value in results)])

    def missed(self, z: Array) -> Array:
        """Return by how much clearances and the end miss their limits, in turning radii."""
        results = self.results(z)[1:]
        outside = np.maximum(
            np.maximum(self.request.low - results[:-1], results[:-1] - self.request.high), 0.0
        )
        return np.append(outside, abs(results[-1]))

    def cost(self, z: Array) -> float:
        """Return the time of the course, and by how much it misses as a penalty."""
        return float(self.results(z)[0] + _PENALTY * self.missed(z).max())


class _Differences:
    """Values of a function and its Jacobian by forward differences, once for each point."""

    def __init__(self, function: Callable[[Array], Array]) -> None:
        self.function = function
        self.at: Array | None = None

    def __call__(self, z: Array) -> tuple[Array, Array]:
        if self.at is None or not np.array_equal(self.at, z):
            self.at = z.copy()
            value = self.function(z)
            columns = [
                (self.function(z + _DIFFERENCE * unit) - value) / _DIFFERENCE
                for unit in np.eye(len(z))
            ]
            self.last = (value, np.stack(columns, axis=-1))
        return self.last


def quickest(problem: Problem, z: Array, reach: float) -> Array:
    """Return the best z that sequential quadratic programming finds from a start.

    Times stay within those that the families know; a single turn's time stays.

    The time is linear in z: how far its first steps go depends on the weight of the time beside the
    constraints, so that several are tried.

    Args:
        problem: see there.
        z: [2 + 2 n] to begin from.
        reach: by which legs may change, in units of time.
    """
    request, values = problem.request, _Differences(problem.results)
    least, most = z - reach, z + reach
    least[2::2], most[2::2] = (
        [family.low for family in problem.families],
        [family.high for family in problem.families],
    )
    least[3::2] = np.maximum(least[3::2], 0.0)
    most[3::2] = np.minimum(most[3::2], [family.times[-1] for family in problem.families])
    aside = _ASIDE if request.heading is None else 0.0
    least[0], most[0] = z[0] - aside, z[0] + aside
    least[1], most[1] = (
        (max(float(least[1]), 0.0), float(most[1])) if request.heading is None else (0.0, 0.0)
    )
    begin = np.clip(z, least, most)
    # its types know no constraints with Jacobians
    solve: Any = minimize
    candidates = [begin]
    for weight in _WEIGHTS:
        result = solve(
            lambda z, weight=weight: weight * values(z)[0][0],
            begin,
            jac=lambda z, weight=weight: weight * values(z)[1][0],
            method="SLSQP",
            bounds=Bounds(least, most),
            constraints=_constraints(request, values),
            options={"maxiter": _ROUNDS, "ftol": 1e-6 * weight},
        )
        candidates.append(np.clip(result.x, least, most))
    return min(candidates, key=problem.cost)


def _constraints(request: CourseRequest, values: _Differences) -> list[dict[str, Any]]:
    low, high = request.low, request.high
    n, bounded = len(low), np.flatnonzero(np.isfinite(high))
    if request.goal.clearance > 0:
        bounded = bounded[:-1]
        kinds = [
            ("ineq", 1.0, np.arange(1, n), -low[:-1]),
            ("eq", 1.0, np.array([n, n + 1]), np.array([-low[-1], 0.0])),
        ]
    else:
        kinds = [("ineq", 1.0, np.arange(1, n + 1), -low)]
    kinds.append(("ineq", -1.0, 1 + bounded, high[bounded]))
    return [
        {
            "type": kind,
            "fun": lambda z, sign=sign, rows=rows, shift=shift: sign * values(z)[0][rows] + shift,
            "jac": lambda z, sign=sign, rows=rows: sign * values(z)[1][rows],
        }
        for kind, sign, rows, shift in kinds
        if len(rows)
    ]

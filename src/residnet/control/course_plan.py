"""Courses that a vessel can follow: its own turns between straight legs, placed so that they keep out of circles or reach into them.

A course of arcs and tangents asks for a yaw rate that jumps. A vessel with a yaw time constant T runs U T past the point where such an arc
begins; here each turn is one that the vessel has made (`turns.make_turns`), and only where it is made is left to find.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import Bounds, minimize

from residnet.control.turns import Array, Turn
from residnet.core.errors import ConfigError

TurnMaker = Callable[[Array, Array], list[Turn]]
"""Turns by heading changes [B] in rad and, for each, the radius in m that it need not be tighter than."""
_GRID = np.radians(np.array([2, *range(10, 311, 10)], dtype=float))
_CLOSE = math.radians(1.5)
_POINTS = 90
_GUESSES = ((1.05, 0.2), (1.15, 0.3), (0.0, 1.0), (0.5, 0.5))
"""What the search begins from: circles as a multiple, and turning radii by which legs are shortened."""
_DIFFERENCE = 1e-5
_ROUNDS = 60
_TOLERANCE = 1e-3
"""Of clearances, as a share of the vessel's turning radius."""


class Mark(NamedTuple):
    """What a turn is made at.

    Attributes:
        number: of the buoy or way-point, from 1.
        north, east: in m.
        turn: to starboard (+1) or to port (-1).
        clearance: between the mark and the track in m, the mark on the inner side; negative where the track passes on the inner side of it.
    """

    number: int
    north: float
    east: float
    turn: int
    clearance: float


@dataclass(frozen=True)
class Course:
    """A course by the distance along it, in even steps.

    Attributes:
        step: in m.
        track: north, east [N, 2] in m.
        direction: of the track [N] in rad, not wrapped.
        heading: of the vessel [N] in rad, not wrapped; it differs from the direction by the drift angle.
        rudder: that the nominal vessel needs [N] in rad.
        length: where it ends, in m; the points go on beyond it.
    """

    step: float
    track: Array
    direction: Array
    heading: Array
    rudder: Array
    length: float


class _Family:
    """Turns of every angle, by cubic splines through some; one turn alone stands for all."""

    def __init__(self, turns: Sequence[Turn]) -> None:
        share = np.linspace(0.0, 1.0, _POINTS if len(turns) > 1 else 10 * _POINTS)
        own = [np.linspace(0.0, 1.0, len(turn.track)) for turn in turns]
        tracks = np.array([[np.interp(share, t, turn.track[:, i]) for t, turn in zip(own, turns, strict=True)] for i in range(2)])
        lengths = np.array([_length(turn.track) for turn in turns])
        self.rows = np.concatenate((tracks.transpose(1, 2, 0).reshape(len(turns), -1), lengths[:, None]), axis=1)
        self.spline = CubicSpline(np.array([turn.angle for turn in turns]), self.rows) if len(turns) > 1 else None

    def __call__(self, angle: float) -> tuple[Array, float]:
        """Track [N, 2] to starboard in the turn's own frame and its length in m."""
        row = self.rows[0] if self.spline is None else self.spline(angle)
        return row[:-1].reshape(-1, 2), float(row[-1])


def _length(track: Array) -> float:
    return float(np.hypot(*np.diff(track, axis=0).T).sum())


def _turned(points: Array, heading: float, side: int) -> Array:
    """Points of a turn's own frame [N, 2] in the earth's, relative to where the turn begins."""
    c, s = math.cos(heading), math.sin(heading)
    east = side * points[:, 1]
    return np.stack((c * points[:, 0] - s * east, s * points[:, 0] + c * east), axis=-1)


def _clearance(mark: Mark, track: Array) -> float:
    """Distance of a mark from a track of straight pieces, positive on the inner side of its turn."""
    place = np.array([mark.north, mark.east])
    begin, piece = track[:-1], np.diff(track, axis=0)
    square = (piece**2).sum(axis=1)
    share = np.clip(((place - begin) * piece).sum(axis=1) / np.maximum(square, 1e-12), 0.0, 1.0)
    away = place - begin - share[:, None] * piece
    near = int((away**2).sum(axis=1).argmin())
    side = piece[near, 0] * away[near, 1] - piece[near, 1] * away[near, 0]
    return math.copysign(math.hypot(*away[near]), side * mark.turn)


class _Problem:
    """The shortest course of legs and turns: z = (first heading, leg, angle, leg, angle, ..., leg), lengths in turning radii."""

    def __init__(self, start: Array, heading: float | None, marks: Sequence[Mark], goal: Mark, make: TurnMaker, scale: float) -> None:
        self.start, self.heading, self.marks, self.goal, self.scale, self.make = start, heading, marks, goal, scale, make
        self.radii = np.array([max(mark.clearance, 0.0) for mark in marks] + [0.0] * (heading is not None))
        every = {radius: _Family(make(_GRID, np.full(len(_GRID), radius))) for radius in set(self.radii.tolist())}
        self.families = [every[radius] for radius in self.radii.tolist()]

    def angles(self, z: Array) -> Array:
        """Of the turns at the marks, then of one at the start; all positive."""
        if self.heading is None:
            return z[2::2]
        return np.array([*z[2::2], max(abs(math.remainder(float(z[0]) - self.heading, 2.0 * math.pi)), 1e-3)])

    def narrow(self, z: Array) -> None:
        """Turns of angles about those of z, in place of the wide grid."""
        grids = [np.maximum(angle, 2.5 * _CLOSE) + _CLOSE * np.arange(-2, 3) for angle in self.angles(z)]
        if grids:
            turns = self.make(np.concatenate(grids), np.repeat(self.radii, 5))
            self.families = [_Family(turns[5 * i : 5 * i + 5]) for i in range(len(grids))]

    def fix(self, z: Array) -> list[Turn]:
        """The turns of the angles of z alone; only legs are left to change."""
        angles = self.angles(z)
        turns = self.make(angles, self.radii) if len(angles) else []
        self.families = [_Family([turn]) for turn in turns]
        return turns

    def beginning(self, z: Array) -> tuple[Array, float, Array]:
        """Where the first leg begins, the length until there, and the track [N, 2] of the turn to it."""
        if self.heading is None:
            return self.start, 0.0, self.start[None]
        aside = math.remainder(float(z[0]) - self.heading, 2.0 * math.pi)
        track, length = self.families[-1](abs(aside))
        track = self.start + _turned(track, self.heading, 1 if aside > 0 else -1)
        return track[-1], length, track

    def length(self, z: Array) -> float:
        """Of the course in turning radii."""
        turns = sum(family(angle)[1] for family, angle in zip(self.families, z[2::2], strict=False))
        return float(z[1::2].sum() + (turns + self.beginning(z)[1]) / self.scale)

    def results(self, z: Array) -> Array:
        """Clearances of the marks, then the goal's offset from the last leg and the distance left along it, in turning radii."""
        at, _, _ = self.beginning(z)
        level, found = float(z[0]), []
        ends = [at + self.scale * z[1] * np.array([math.cos(level), math.sin(level)])]
        tracks = []
        for i, (mark, family) in enumerate(zip(self.marks, self.families, strict=False)):
            tracks.append(ends[-1] + _turned(family(float(z[2 + 2 * i]))[0], level, mark.turn))
            level += mark.turn * float(z[2 + 2 * i])
            ends.append(tracks[-1][-1] + self.scale * z[3 + 2 * i] * np.array([math.cos(level), math.sin(level)]))
        for i, mark in enumerate(self.marks):
            before = at if i == 0 else tracks[i - 1][-1]
            found.append(_clearance(mark, np.concatenate((before[None], tracks[i], ends[i + 1][None]))))
        left = np.array([self.goal.north, self.goal.east]) - ends[-1]
        along = left[0] * math.cos(level) + left[1] * math.sin(level)
        across = left[1] * math.cos(level) - left[0] * math.sin(level)
        return np.array([*found, self.goal.turn * across - max(self.goal.clearance, 0.0), along + min(self.goal.clearance, 0.0)]) / self.scale


class _Differences:
    """Values of a function and its Jacobian by forward differences, once for each point."""

    def __init__(self, function: Callable[[Array], Array]) -> None:
        self.function = function
        self.at: Array | None = None
        self.calls = 0

    def __call__(self, z: Array) -> tuple[Array, Array]:
        if self.at is None or not np.array_equal(self.at, z):
            self.at = z.copy()
            self.calls += 1
            value = self.function(z)
            columns = [(self.function(z + _DIFFERENCE * unit) - value) / _DIFFERENCE for unit in np.eye(len(z))]
            self.known = (value, np.stack(columns, axis=-1))
        return self.known


def plan(
    start: tuple[float, float], heading: float | None, marks: Sequence[Mark], goal: Mark, make: TurnMaker, scale: float, step: float, beyond: float
) -> Course:
    """The shortest course of legs and turns from a start past the marks to the goal.

    Args:
        start: (north, east) in m.
        heading: at the start in rad; None to start on the first leg.
        marks: in their order.
        goal: passed at its clearance on the inner side of its turn, and the course ends abeam of it; with a clearance <= 0 the course ends
            at that distance before it.
        make: turns.
        scale: the vessel's turning radius in m.
        step: between the points of the course in m.
        beyond: how far the points go on behind the end, in m.

    Raises:
        ConfigError: where marks lie too close together for the vessel's turns.
    """
    n = len(marks)
    problem = _Problem(np.array(start), heading, marks, goal, make, scale)
    low = np.array([mark.clearance for mark in marks]) / scale
    high = np.array([np.inf if mark.clearance > 0 else -mark.clearance for mark in marks]) / scale
    tries = [_shortest(problem, _guess(np.array(start), marks, goal, scale, wide, short), low, high, fixed=False) for wide, short in _GUESSES]
    z = min(tries, key=lambda z: problem.length(z) + 100.0 * float(_missed(problem.results(z), low, high).max()))
    problem.narrow(z)
    z = _shortest(problem, z, low, high, fixed=False)
    turns = problem.fix(z)
    z[2::2] = [turn.angle for turn in turns[:n]]
    if heading is not None:
        z[0] = heading + math.copysign(turns[-1].angle, math.remainder(float(z[0]) - heading, 2.0 * math.pi))
    z = _shortest(problem, z, low, high, fixed=True)
    found = problem.results(z)
    missed = _missed(found, low, high)
    if float(missed.max()) > _TOLERANCE:
        worst = (*marks, goal)[min(int(missed.argmax()), n)].number
        raise ConfigError(f"no course found that passes mark {worst} as asked for with this vessel's turns; move it, or allow more rudder")
    return _composed(problem, z, turns, step, beyond)


def _missed(found: Array, low: Array, high: Array) -> Array:
    """How far clearances lie outside their limits and the end of the course from the goal, in turning radii."""
    n = len(low)
    return np.concatenate((np.maximum(np.maximum(low - found[:n], found[:n] - high), 0.0), np.abs(found[n:])))


def _shortest(problem: _Problem, z: Array, low: Array, high: Array, *, fixed: bool) -> Array:
    """Sequential quadratic programming from z; with `fixed`, first heading and legs alone."""
    n = len(low)
    both = _Differences(lambda z: np.concatenate(([problem.length(z)], problem.results(z))))
    bounded = np.isfinite(high)
    kinds = (
        ("ineq", 1.0, np.arange(1, n + 1), -low),
        ("ineq", -1.0, 1 + np.flatnonzero(bounded), high[bounded]),
        ("eq", 1.0, np.arange(n + 1, n + 3), 0.0),
    )
    least, most = np.zeros(len(z)), np.full(len(z), np.inf)
    least[2::2], most[2::2] = (z[2::2], z[2::2]) if fixed else (_GRID[0], _GRID[-1])
    least[0], most[0] = (z[0], z[0]) if fixed and problem.heading is not None else (-np.inf, np.inf)
    constraints: list[Any] = [
        {
            "type": kind,
            "fun": lambda z, sign=sign, rows=rows, shift=shift: sign * both(z)[0][rows] + shift,
            "jac": lambda z, sign=sign, rows=rows: sign * both(z)[1][rows],
        }
        for kind, sign, rows, shift in kinds
        if len(rows)
    ]
    # its types know no constraints with Jacobians
    solve: Any = minimize
    found: Array = solve(
        lambda z: both(z)[0][0],
        z,
        jac=lambda z: both(z)[1][0],
        method="SLSQP",
        bounds=Bounds(least, most),
        constraints=constraints,
        options={"maxiter": _ROUNDS, "ftol": 1e-6},
    ).x
    return found


def _guess(start: Array, marks: Sequence[Mark], goal: Mark, scale: float, wide: float, short: float) -> Array:
    """Tangents of circles about the marks, wider than they are or, where they are entered, a share of the turning radius."""
    points = np.array([start, *[(mark.north, mark.east) for mark in (*marks, goal)]])
    legs = np.diff(points, axis=0)
    sizes = np.hypot(*legs.T)
    circles = [mark.turn * wide * (mark.clearance if mark.clearance > 0 else scale) for mark in marks]
    radii = np.array([0.0, *circles, goal.turn * max(goal.clearance, 0.0)])
    aside = np.arcsin(np.clip(np.diff(radii) / sizes, -0.99, 0.99))
    headings = np.arctan2(legs[:, 1], legs[:, 0]) - aside
    angles = (np.array([mark.turn for mark in marks]) * np.diff(headings)) % (2.0 * math.pi)
    z = np.zeros(2 + 2 * len(marks))
    z[0], z[1::2], z[2::2] = headings[0], np.maximum(sizes * np.cos(aside) / scale - short, 0.0), np.clip(angles, _GRID[0], _GRID[-1])
    return z


def _composed(problem: _Problem, z: Array, turns: Sequence[Turn], step: float, beyond: float) -> Course:
    """Legs and turns as one course."""
    at, level = problem.start, float(z[0])
    parts: list[tuple[Array, Array, Array]] = []
    if problem.heading is not None:
        side = 1 if math.remainder(level - problem.heading, 2.0 * math.pi) > 0 else -1
        turn = turns[-1]
        parts.append((at + _turned(turn.track, problem.heading, side), problem.heading + side * turn.heading, side * turn.rudder))
        at = parts[-1][0][-1]
    for mark, turn, leg in zip(problem.marks, turns, z[1::2], strict=False):
        end = at + problem.scale * leg * np.array([math.cos(level), math.sin(level)])
        parts.append((np.stack((at, end)), np.full(2, level), np.zeros(2)))
        parts.append((end + _turned(turn.track, level, mark.turn), level + mark.turn * turn.heading, mark.turn * turn.rudder))
        at, level = parts[-1][0][-1], level + mark.turn * turn.angle
    direction = np.array([math.cos(level), math.sin(level)])
    left = problem.scale * float(z[-1])
    parts.append((np.stack((at, at + left * direction, at + (left + beyond) * direction)), np.full(3, level), np.zeros(3)))
    return _sampled(parts, beyond, step)


def _sampled(parts: Sequence[tuple[Array, Array, Array]], beyond: float, step: float) -> Course:
    track, heading, rudder = (np.concatenate([part[i] for part in parts]) for i in range(3))
    moved = np.hypot(*np.diff(track, axis=0).T)
    # where parts meet, what the next one asks for holds
    distinct = np.concatenate((moved > 1e-9, [True]))
    track, heading, rudder = track[distinct], heading[distinct], rudder[distinct]
    along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(track, axis=0).T))))
    at = step * np.arange(math.floor(along[-1] / step) + 1)
    points = np.stack([np.interp(at, along, track[:, i]) for i in range(2)], axis=-1)
    direction = np.unwrap(np.arctan2(*np.gradient(points, axis=0).T[::-1]))
    direction += 2.0 * math.pi * round((heading[0] - direction[0]) / (2.0 * math.pi))
    # a command stands until the next
    held = rudder[np.searchsorted(along, at, side="right") - 1]
    return Course(step, points, direction, np.interp(at, along, heading), held, float(along[-1]) - beyond)

"""Courses that a vessel can follow: its own turns and the straight legs between.

They are timed so that they keep out of circles or reach into them.

A course of arcs and tangents needs a yaw rate that jumps. A vessel with a yaw time constant T
runs U T past the point where such an arc begins; here every turn is one that the vessel makes
(`turns.TurnMaker`) from the motion that the turn before it left, and how long the rudder is held
and legs last is left to find.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from residnet.control.courses.course_search import (
    CourseRequest,
    Family,
    Mark,
    Problem,
    quickest,
    rotated,
)
from residnet.control.courses.turns import Array, SteadyTurn, Turn, TurnMaker
from residnet.control.heading.turning import Turning
from residnet.core.errors import ConfigError

_GUESSES = ((1.05, 0.2), (1.15, 0.3), (0.0, 1.0), (0.5, 0.5))
"""What the search begins from: circles as a multiple, and turning radii by which legs are
shortened.
"""
_WIDE = np.radians(np.array([0, *range(10, 341, 10)], dtype=float))
_NARROW = np.radians([8.0, 4.0, 2.0, 2.0, 1.0, 1.0, 1.0, 1.0])
"""Turned angles between the turns that are tried, round for round."""
_FAR = 0.1
"""Turning radii by which a mark may be missed before turns are made from the motion that they begin
with.
"""
_TOLERANCE = 1e-3
"""Of clearances, as a share of the vessel's turning radius."""
_SETTLED = 3e-4
"""Share of the course's time by which a round may still change it."""


@dataclass(frozen=True)
class Course:
    """A course by the distance along it, in even steps.

    Attributes:
        step: in m.
        track: north, east [N, 2] in m.
        direction: of the track [N] in rad, not wrapped.
        heading: of the vessel [N] in rad, not wrapped; it differs from the direction by the drift
            angle.
        rudder: that the nominal vessel needs [N] in rad.
        length: where it ends, in m; the points go on beyond it.
    """

    step: float
    track: Array
    direction: Array
    heading: Array
    rudder: Array
    length: float


def plan(
    start: tuple[float, float],
    heading: float | None,
    marks: Sequence[Mark],
    goal: Mark,
    make: TurnMaker,
    steady: SteadyTurn,
    step: float,
    beyond: float,
) -> Course:
    """Return the quickest course of turns and legs from a start past the marks to the goal.

    Args:
        start: (north, east) in m.
        heading: at the start in rad; None to start on the first leg.
        marks: in their order.
        goal: passed at its clearance on the inner side of its turn, and the course ends abeam of
            it; with a clearance <= 0 the course ends at that distance from it.
        make: turns.
        steady: the vessel's smallest turn.
        step: between the points of the course in m.
        beyond: how far the points go on behind the end, in m.

    Raises:
        ConfigError: where marks lie too close together for the vessel's turns.
    """
    request = CourseRequest(
        np.array(start), heading, tuple(marks), goal, steady.radius, make.turning.speed
    )
    search = _Search(request, make)
    z, turns = search.converge(
        *search.begin([_guess(request, make.turning, wide, short) for wide, short in _GUESSES])
    )
    missed = search.fixed(turns).missed(z)
    if float(missed.max()) > _TOLERANCE:
        worst = (*marks, goal)[min(int(missed.argmax()), len(marks))].number
        raise ConfigError(
            f"no course found that passes mark {worst} at its clearance with this vessel's turns;"
            " move it, or allow more rudder"
        )
    return _joined(request, z, turns, make.turning.speed, step, beyond)


class _Search:
    """Rounds of search among turns that are made ever closer to the ones chosen.

    Each turn starts from the motion that the one before it leaves.
    """

    def __init__(self, request: CourseRequest, make: TurnMaker) -> None:
        self.request, self.make = request, make
        points = np.array(
            [request.start, *[(mark.north, mark.east) for mark in (*request.marks, request.goal)]]
        )
        # no leg takes longer
        self.leg = 1.2 * float(np.hypot(*np.diff(points, axis=0).T).max()) / make.turning.speed

    def problem(self, holds: Array, rudder: Array, begin: Sequence[Array]) -> Problem:
        """Return the problem of turns made with holds [n, K] in s from the given motions."""
        turns = self.make(holds, rudder, begin, self.leg) if len(holds) else []
        return Problem(
            self.request,
            [Family(group, self.request.unit) for group in turns],
            self.make.turning.speed,
        )

    def fixed(self, turns: Sequence[Turn]) -> Problem:
        """Return the problem of given turns, whose holds do not change."""
        return Problem(
            self.request,
            [Family([turn], self.request.unit) for turn in turns],
            self.make.turning.speed,
        )

    def begin(self, guesses: Sequence[tuple[Array, Array]]) -> tuple[Array, Array]:
        """Return the times and rudder angles of the best course of turns from straight ahead.

        It is searched for from each guess, and mark by mark where none of these passes all marks.
        """
        problems: dict[bytes, Problem] = {}
        tries = []
        for z, rudder in guesses:
            if rudder.tobytes() not in problems:
                holds = np.array([_holds(_WIDE, abs(angle), self.make.turning) for angle in rudder])
                problems[rudder.tobytes()] = self.problem(
                    holds, rudder, [self.make.straight] * len(rudder)
                )
            problem = problems[rudder.tobytes()]
            z = quickest(problem, z, math.inf)
            tries.append((problem.cost(z), z, rudder))
        _, z, rudder = min(tries, key=lambda attempt: attempt[0])
        problem = problems[rudder.tobytes()]
        if float(problem.missed(z).max()) > _FAR:
            z = min((z, self._mark_by_mark(problem, guesses[0][0], rudder)), key=problem.cost)
        return z, rudder

    def _mark_by_mark(self, whole: Problem, guess: Array, rudder: Array) -> Array:
        """Return the times of a course that is searched for to one mark after the other."""
        request, first = self.request, self.request.first
        marks = (*request.marks, request.goal)
        z = guess[: 2 + 2 * first]
        for k, (mark, after) in enumerate(zip(marks, (*marks[1:], None), strict=True)):
            problem = Problem(
                replace(request, marks=marks[:k], goal=mark),
                whole.families[: first + k],
                whole.straight,
            )
            z = quickest(problem, z, math.inf)
            if after is None:
                break
            line = np.array([after.north - mark.north, after.east - mark.east])
            size = math.hypot(*line)
            aside = (
                after.turn * max(after.clearance, 0.0) - mark.turn * max(mark.clearance, 0.0)
            ) / size
            heading = math.atan2(line[1], line[0]) - math.asin(min(max(aside, -0.99), 0.99))
            angle = (mark.turn * (heading - problem.legs(z)[1])) % (2.0 * math.pi)
            hold = (
                _holds(
                    np.array([min(angle, _WIDE[-1])]),
                    abs(float(rudder[first + k])),
                    self.make.turning,
                )[0]
                / request.unit
            )
            z = np.array(
                [*z[:-1], max(z[-1] - 0.5, 0.0), hold, max(size / request.radius - 0.5, 0.0)]
            )
        return z

    def chain(self, z: Array, rudder: Array) -> list[Turn]:
        """Return the turns of z, each from the motion at the end of the leg before it."""
        turns: list[Turn] = []
        state = self.make.straight
        for hold, leg, angle in zip(
            self.request.unit * z[2::2], self.request.unit * z[3::2], rudder, strict=True
        ):
            turns += self.make(
                np.array([[hold]]), np.array([angle]), [state], float(leg) + self.make.turning.time
            )[0]
            state = turns[-1].leg(leg)
        return turns

    def converge(self, z: Array, rudder: Array) -> tuple[Array, list[Turn]]:
        """Return the best of rounds in which turns and legs come to fit each other."""
        turns = self.chain(z, rudder)
        best, cost = (z, turns), self.fixed(turns).cost(z)
        for width in _NARROW if len(rudder) else ():
            states = [
                turn.leg(self.request.unit * leg) for turn, leg in zip(turns, z[3::2], strict=True)
            ]
            spacing = width / (self.make.turning.gain * np.abs(rudder))
            holds = np.maximum(self.request.unit * z[2::2], 2.0 * spacing)[:, None] + spacing[
                :, None
            ] * np.arange(-2, 3)
            z = quickest(
                self.problem(holds, rudder, [self.make.straight, *states[:-1]]), z, 6.0 * width
            )
            turns = self.chain(z, rudder)
            before, now = cost, self.fixed(turns).cost(z)
            if now < cost:
                best, cost = (z, turns), now
            if (
                abs(now - before) < _SETTLED * before
                and float(self.fixed(turns).missed(z).max()) < _TOLERANCE
            ):
                break
        z, turns = best
        return quickest(self.fixed(turns), z, _NARROW[-1]), turns


def _holds(angles: Array, rudder: float, turning: Turning) -> Array:
    """Return the times in s for which the rudder is held for turns of angles [K] in rad.

    By Nomoto's model they are K d (t1 - t2), t2 = T ln(2 - exp(-t1 / T)).
    """
    plain = angles / (turning.gain * rudder)
    holds = plain
    for _ in range(100):
        holds = plain + turning.time * np.log(2.0 - np.exp(-holds / turning.time))
    return holds


def _guess(
    request: CourseRequest, turning: Turning, wide: float, short: float
) -> tuple[Array, Array]:
    """Return the times and signed rudder angles of tangents of circles about the marks.

    The circles are wider than the marks' or, where these are entered, a share of the turning
    radius.
    """
    points = np.array(
        [request.start, *[(mark.north, mark.east) for mark in (*request.marks, request.goal)]]
    )
    lines = np.diff(points, axis=0)
    sizes = np.hypot(*lines.T)
    circles = [
        mark.turn * wide * (mark.clearance if mark.clearance > 0 else request.radius)
        for mark in request.marks
    ]
    radii = np.array([0.0, *circles, request.goal.turn * max(request.goal.clearance, 0.0)])
    aside = np.arcsin(np.clip(np.diff(radii) / sizes, -0.99, 0.99))
    headings = np.arctan2(lines[:, 1], lines[:, 0]) - aside
    signs = np.array([mark.turn for mark in request.marks], dtype=float)
    rudder = signs * np.array([mark.rudder for mark in request.marks])
    angles = (signs * np.diff(headings)) % (2.0 * math.pi)
    legs = np.maximum(sizes * np.cos(aside) / request.radius - short, 0.0)
    if request.heading is not None:
        first = math.remainder(float(headings[0]) - request.heading, 2.0 * math.pi)
        angles = np.concatenate(([abs(first)], angles))
        rudder = np.concatenate(([math.copysign(request.goal.rudder, first)], rudder))
        headings, legs = np.array([request.heading]), np.concatenate(([0.0], legs))
    z = np.zeros(2 + 2 * len(angles))
    z[0], z[1::2] = headings[0], legs
    z[2::2] = [
        _holds(np.array([angle]), abs(rudder_angle), turning)[0] / request.unit
        for angle, rudder_angle in zip(angles, rudder, strict=True)
    ]
    return z, rudder


def _joined(
    request: CourseRequest,
    z: Array,
    turns: Sequence[Turn],
    speed: float,
    step: float,
    beyond: float,
) -> Course:
    """Return the legs and turns as one course."""
    level, unit = float(z[0]), request.unit
    at = request.start + speed * unit * float(z[1]) * np.array([math.cos(level), math.sin(level)])
    parts = [(np.stack((request.start, at)), np.full(2, level), np.zeros(2))]
    for turn, leg in zip(turns, z[3::2], strict=True):
        held = np.where(turn.times < turn.hold, turn.rudder, -turn.rudder)
        parts.append((at + rotated(turn.track, level), level + turn.heading, held))
        track, heading = turn.along(np.linspace(0.0, unit * float(leg), 500))
        parts.append((at + rotated(track, level), level + heading, np.zeros(500)))
        at, level = parts[-1][0][-1], float(parts[-1][1][-1])
    direction = np.array([math.cos(level), math.sin(level)])
    parts.append((np.stack((at, at + beyond * direction)), np.full(2, level), np.zeros(2)))
    return _sampled(parts, beyond, step)


def _sampled(parts: Sequence[tuple[Array, Array, Array]], beyond: float, step: float) -> Course:
    track, heading, rudder = (np.concatenate([part[i] for part in parts]) for i in range(3))
    moved = np.hypot(*np.diff(track, axis=0).T)
    # where parts meet, the rudder of the next one holds
    distinct = np.concatenate((moved > 1e-9, [True]))
    track, heading, rudder = track[distinct], heading[distinct], rudder[distinct]
    along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(track, axis=0).T))))
    at = step * np.arange(math.floor(along[-1] / step) + 1)
    points = np.stack([np.interp(at, along, track[:, i]) for i in range(2)], axis=-1)
    direction = np.unwrap(np.arctan2(*np.gradient(points, axis=0).T[::-1]))
    direction += 2.0 * math.pi * round((heading[0] - direction[0]) / (2.0 * math.pi))
    # a command stands until the next
    held = rudder[np.searchsorted(along, at, side="right") - 1]
    return Course(
        step, points, direction, np.interp(at, along, heading), held, float(along[-1]) - beyond
    )

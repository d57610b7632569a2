"""Courses that a vessel can follow: its own turns and the straight legs between, timed so that they
keep out of circles or reach into them.

A course of arcs and tangents asks for a yaw rate that jumps. A vessel with a yaw time constant T
runs U T past the point where such an arc begins; here every turn is one that the vessel makes
(`turns.TurnMaker`) from the motion that the turn before it left, and how long the rudder is held
and legs last is left to find.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from residnet.control.courses.course_search import Asked, Family, Mark, Problem, quickest, turned
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
    asked = Asked(np.array(start), heading, tuple(marks), goal, steady.radius, make.turning.speed)
    search = _Search(asked, make)
    z, made = search.settle(
        *search.begin([_guess(asked, make.turning, wide, short) for wide, short in _GUESSES])
    )
    found = search.fixed(made).missed(z)
    if float(found.max()) > _TOLERANCE:
        worst = (*marks, goal)[min(int(found.argmax()), len(marks))].number
        raise ConfigError(
            f"no course found that passes mark {worst} as asked for with this vessel's turns; move"
            " it, or allow more rudder"
        )
    return _composed(asked, z, made, make.turning.speed, step, beyond)


class _Search:
    """Rounds of search among turns that are made ever closer to the ones chosen, each from the
    motion that the one before it leaves.
    """

    def __init__(self, asked: Asked, make: TurnMaker) -> None:
        self.asked, self.make = asked, make
        points = np.array(
            [asked.start, *[(mark.north, mark.east) for mark in (*asked.marks, asked.goal)]]
        )
        # no leg takes longer
        self.leg = 1.2 * float(np.hypot(*np.diff(points, axis=0).T).max()) / make.turning.speed

    def problem(self, holds: Array, rudder: Array, begin: Sequence[Array]) -> Problem:
        """Of turns made with holds [n, K] in s from the motions given."""
        turns = self.make(holds, rudder, begin, self.leg) if len(holds) else []
        return Problem(
            self.asked, [Family(own, self.asked.unit) for own in turns], self.make.turning.speed
        )

    def fixed(self, made: Sequence[Turn]) -> Problem:
        """Of turns as they are."""
        return Problem(
            self.asked, [Family([turn], self.asked.unit) for turn in made], self.make.turning.speed
        )

    def begin(self, guesses: Sequence[tuple[Array, Array]]) -> tuple[Array, Array]:
        """Return the times and rudder angles of the best course of turns from straight ahead: searched for from each guess, and mark by mark where none of these passes all marks."""
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
        _, z, rudder = min(tries, key=lambda one: one[0])
        problem = problems[rudder.tobytes()]
        if float(problem.missed(z).max()) > _FAR:
            z = min((z, self._grown(problem, guesses[0][0], rudder)), key=problem.cost)
        return z, rudder

    def _grown(self, whole: Problem, guess: Array, rudder: Array) -> Array:
        """Return the times of a course that is searched for to the first mark, then on to the next, and so on."""
        asked, first = self.asked, self.asked.first
        marks = (*asked.marks, asked.goal)
        z = guess[: 2 + 2 * first]
        for k, (mark, after) in enumerate(zip(marks, (*marks[1:], None), strict=True)):
            problem = Problem(
                replace(asked, marks=marks[:k], goal=mark),
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
                / asked.unit
            )
            z = np.array(
                [*z[:-1], max(z[-1] - 0.5, 0.0), hold, max(size / asked.radius - 0.5, 0.0)]
            )
        return z

    def chain(self, z: Array, rudder: Array) -> list[Turn]:
        """Return the turns of z, each from the motion at the end of the leg before it."""
        made: list[Turn] = []
        state = self.make.straight
        for hold, leg, angle in zip(
            self.asked.unit * z[2::2], self.asked.unit * z[3::2], rudder, strict=True
        ):
            made += self.make(
                np.array([[hold]]), np.array([angle]), [state], float(leg) + self.make.turning.time
            )[0]
            state = made[-1].leg(leg)
        return made

    def settle(self, z: Array, rudder: Array) -> tuple[Array, list[Turn]]:
        """Return the best of rounds in which turns and legs come to belong to each other."""
        made = self.chain(z, rudder)
        best, cost = (z, made), self.fixed(made).cost(z)
        for width in _NARROW if len(rudder) else ():
            left = [
                turn.leg(self.asked.unit * leg) for turn, leg in zip(made, z[3::2], strict=True)
            ]
            apart = width / (self.make.turning.gain * np.abs(rudder))
            holds = np.maximum(self.asked.unit * z[2::2], 2.0 * apart)[:, None] + apart[
                :, None
            ] * np.arange(-2, 3)
            z = quickest(
                self.problem(holds, rudder, [self.make.straight, *left[:-1]]), z, 6.0 * width
            )
            made = self.chain(z, rudder)
            before, now = cost, self.fixed(made).cost(z)
            if now < cost:
                best, cost = (z, made), now
            if (
                abs(now - before) < _SETTLED * before
                and float(self.fixed(made).missed(z).max()) < _TOLERANCE
            ):
                break
        z, made = best
        return quickest(self.fixed(made), z, _NARROW[-1]), made


def _holds(angles: Array, rudder: float, turning: Turning) -> Array:
    """For how long [s] the rudder is held for turns of angles [K] in rad by Nomoto's model: K d (t1
    - t2), t2 = T ln(2 - exp(-t1 / T)).
    """
    plain = angles / (turning.gain * rudder)
    holds = plain
    for _ in range(100):
        holds = plain + turning.time * np.log(2.0 - np.exp(-holds / turning.time))
    return holds


def _guess(asked: Asked, turning: Turning, wide: float, short: float) -> tuple[Array, Array]:
    """Return the tangents of circles about the marks, wider than they are or, where they are entered, a share of the turning radius: times, and rudder angles with their signs."""
    points = np.array(
        [asked.start, *[(mark.north, mark.east) for mark in (*asked.marks, asked.goal)]]
    )
    lines = np.diff(points, axis=0)
    sizes = np.hypot(*lines.T)
    circles = [
        mark.turn * wide * (mark.clearance if mark.clearance > 0 else asked.radius)
        for mark in asked.marks
    ]
    radii = np.array([0.0, *circles, asked.goal.turn * max(asked.goal.clearance, 0.0)])
    aside = np.arcsin(np.clip(np.diff(radii) / sizes, -0.99, 0.99))
    headings = np.arctan2(lines[:, 1], lines[:, 0]) - aside
    signs = np.array([mark.turn for mark in asked.marks], dtype=float)
    rudder = signs * np.array([mark.rudder for mark in asked.marks])
    angles = (signs * np.diff(headings)) % (2.0 * math.pi)
    legs = np.maximum(sizes * np.cos(aside) / asked.radius - short, 0.0)
    if asked.heading is not None:
        first = math.remainder(float(headings[0]) - asked.heading, 2.0 * math.pi)
        angles = np.concatenate(([abs(first)], angles))
        rudder = np.concatenate(([math.copysign(asked.goal.rudder, first)], rudder))
        headings, legs = np.array([asked.heading]), np.concatenate(([0.0], legs))
    z = np.zeros(2 + 2 * len(angles))
    z[0], z[1::2] = headings[0], legs
    z[2::2] = [
        _holds(np.array([angle]), abs(one), turning)[0] / asked.unit
        for angle, one in zip(angles, rudder, strict=True)
    ]
    return z, rudder


def _composed(
    asked: Asked, z: Array, made: Sequence[Turn], speed: float, step: float, beyond: float
) -> Course:
    """Return the legs and turns as one course."""
    level, unit = float(z[0]), asked.unit
    at = asked.start + speed * unit * float(z[1]) * np.array([math.cos(level), math.sin(level)])
    parts = [(np.stack((asked.start, at)), np.full(2, level), np.zeros(2))]
    for turn, leg in zip(made, z[3::2], strict=True):
        held = np.where(turn.times < turn.hold, turn.rudder, -turn.rudder)
        parts.append((at + turned(turn.track, level), level + turn.heading, held))
        track, heading = turn.along(np.linspace(0.0, unit * float(leg), 500))
        parts.append((at + turned(track, level), level + heading, np.zeros(500)))
        at, level = parts[-1][0][-1], float(parts[-1][1][-1])
    direction = np.array([math.cos(level), math.sin(level)])
    parts.append((np.stack((at, at + beyond * direction)), np.full(2, level), np.zeros(2)))
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
    return Course(
        step, points, direction, np.interp(at, along, heading), held, float(along[-1]) - beyond
    )

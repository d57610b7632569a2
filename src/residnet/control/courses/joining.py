"""Courses whose turns begin with the motion that the turns before them leave."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import final

import numpy as np

from residnet.control.courses.fitting import Fit, Fitted
from residnet.control.courses.route import Route
from residnet.control.courses.turn_table import Turns, following_turns, state_behind
from residnet.control.courses.turns import Array, TurnMaker

_ROUNDS = ((0.1, 0.0), (0.1, 0.5), (0.04, 0.1), (0.02, 0.05), (0.02, 0.03))
"""Turned angles in rad between the turns that are made anew, and by how much z may then change.

Motions behind turns follow from z, and z is chosen for them: both settle as z changes less.
"""
_WIDER = (1.0, 5.0)
"""Multiples of that change that are tried until what is asked is held."""
_HELD = 1e-3
"""Turning radii that may be missed."""
_COMPARED = 2
"""Rounds after which several courses are compared."""
_UNCHANGED = 1e-3
"""Largest change of z with which turns made anew fit each other."""
_MOST = 3
"""Courses whose turns are made anew, at most."""
_SLOWER = 1.1
"""Multiple of the quickest course's time from which on another is not made anew."""


def joined(
    turns: Turns, found: Sequence[tuple[Fit, Fitted]], make: TurnMaker
) -> Iterator[tuple[Fit, Fitted]]:
    """Yield courses with turns that follow each other as the vessel makes them, quickest first.

    What turns leave to those behind them changes which course is quickest.

    Args:
        turns: that the courses were found with, each from straight ahead.
        found: the courses, quickest first.
        make: makes turns from any motion.
    """
    if turns.settled:
        yield from found
        return
    distinct: dict[tuple[int, ...], tuple[Fit, Fitted]] = {}
    for one in found:
        if one[1].time < _SLOWER * found[0][1].time:
            distinct.setdefault(one[0].route.sides, one)
    begun = [_Joining(turns, make, *one) for one in list(distinct.values())[:_MOST]]
    for course in begun:
        course.advance(0, _COMPARED)
    for course in sorted(begun, key=lambda course: course.fitted.time):
        course.advance(_COMPARED, len(_ROUNDS))
        yield course.fit, course.fitted


@final
@dataclass
class _Joining:
    """A course whose turns are made anew, round for round."""

    turns: Turns
    make: TurnMaker
    fit: Fit
    fitted: Fitted
    begin: list[Array] = field(default_factory=list)

    def __post_init__(self) -> None:
        route = self.fit.route
        rudder = [self.turns.tables[number].rudder for number in route.numbers]
        self.rudder = np.array(route.sides) * rudder
        self.begin = [self.make.straight] * len(rudder)

    def advance(self, first: int, last: int) -> None:
        """Make the turns anew, and fit the course to them, in some of the rounds."""
        for width, reach in _ROUNDS[first:last]:
            if len(self.rudder) == 0:
                return
            before = self.fitted.z
            self._round(width, reach)
            if reach > 0.0 and np.abs(self.fitted.z - before).max() < _UNCHANGED:
                return

    def _round(self, width: float, reach: float) -> None:
        route, z = self.fit.route, self.fitted.z
        values = z * route.units
        spacing = width / (self.make.turning.gain * np.abs(self.rudder))
        middle = np.maximum(values[2::2], 2.0 * spacing + 0.1 * self.make.dt)
        holds = middle[:, None] + spacing[:, None] * np.arange(-2, 3)
        turns, made = following_turns(self.make, holds, self.rudder, self.begin, route.turns.radius)
        self.begin = [self.make.straight]
        for turn, leg in zip(made[:-1], values[3:-1:2], strict=True):
            self.begin.append(state_behind(turn, float(leg)))
        if reach > 0.0:
            follows = Route(route.start, route.sides, tuple(range(len(holds))), turns)
            self.fit = self.fit.on(follows)
            for wider in _WIDER:
                fitted = self.fit.solve(np.clip(z, follows.least(), follows.most()), wider * reach)
                self.fitted = fitted
                if fitted.missed <= _HELD * turns.radius:
                    break

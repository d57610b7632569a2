"""A check of courses by their points alone: order, side of the closest approach, clearance.

It uses nothing of what plans them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from residnet.core.config import Config, Metres

Array = NDArray[np.float64]
Protocol = Literal["enter", "sides"]
"""Buoys are entered: a circle of acceptance about each; or each is passed on its side, outside its
own circle.
"""


class BuoyConfig(Config):
    """A buoy with the side to pass it on and the circle to keep out of.

    Attributes:
        north: place in m.
        east: place in m.
        leave_to: the side of the vessel that it passes on; rounded to starboard, it is left to
            starboard. Document 004 plots x to the right and y upwards: its "counter-clockwise" is a
            turn from x towards y, to starboard with x north and y east.
        radius: of the circle that the vessel must stay outside of.
    """

    north: Metres
    east: Metres
    leave_to: Literal["starboard", "port"]
    radius: Metres


class Passage(NamedTuple):
    """How a track passes a buoy.

    Attributes:
        at: sample of the closest approach in the buoy's turn.
        side: that the buoy lies on there.
        distance: there, in m.
        least: smallest distance on the whole track, from `left_behind` on.
        side_there: that the buoy lies on at that distance.
    """

    at: int
    side: str
    distance: float
    least: float
    side_there: str


def left_behind(distance: Array, radius: float) -> int:
    """Return the sample from which a buoy counts: 0, or where the circle is left that it begins in.

    It is left once the track is outside and comes nearer again: going away is no approach. It is
    the number of samples where the track never is.

    Args:
        distance: of the samples from the buoy [N] in m.
        radius: of its circle in m.
    """
    if distance[0] >= radius:
        return 0
    outside = distance >= radius
    if not outside.any():
        return len(distance)
    first = int(outside.argmax())
    nearer = np.flatnonzero(np.diff(distance[first:]) < 0)
    return first + int(nearer[0]) if len(nearer) else len(distance) - 1


def passages(track: Array, buoys: Sequence[BuoyConfig]) -> list[Passage]:
    """Return how a track [N, 2] passes buoys in their order.

    The moments are in the order of the buoys, and the sum of the distances then is least.
    """
    distance = np.stack([np.hypot(*(track - (b.north, b.east)).T) for b in buoys])
    for row, buoy in zip(distance, buoys, strict=True):
        begin = left_behind(row, buoy.radius)
        row[: begin if begin < len(row) else 0] = np.inf
    total, choices = distance[0], []
    number = np.arange(len(track))
    for row in distance[1:]:
        best = np.minimum.accumulate(total)
        choices.append(np.maximum.accumulate(np.where(total <= best, number, 0)))
        total = row + best
    at = [int(total.argmin())]
    for choice in reversed(choices):
        at.append(int(choice[at[-1]]))
    found = []
    for row, buoy, here in zip(distance, buoys, reversed(at), strict=True):
        nearest = int(row.argmin())
        found.append(
            Passage(
                here,
                _side(track, here, buoy),
                float(row[here]),
                float(row[nearest]),
                _side(track, nearest, buoy),
            )
        )
    return found


def _side(track: Array, at: int, buoy: BuoyConfig) -> str:
    """Return the side that a buoy lies on at a sample."""
    step = track[min(at + 1, len(track) - 1)] - track[max(at - 1, 0)]
    north, east = buoy.north - track[at, 0], buoy.east - track[at, 1]
    return "starboard" if step[0] * east - step[1] * north > 0 else "port"


def first_fault(
    track: Array, buoys: Sequence[BuoyConfig], protocol: Protocol, turn: float, missed: float = 0.0
) -> tuple[int, str] | None:
    """Return the first buoy, from 0, where a track [N, 2] does wrong, and what; None where nowhere.

    A circle may be entered between the samples: nearer by what `_between` says.

    Args:
        track: north, east in m.
        buoys: in their order.
        turn: least radius of its turns in m.
        missed: by which circles may be missed, in m.
    """
    step = float(np.hypot(*np.diff(track, axis=0).T).max())
    for number, (passage, buoy) in enumerate(zip(passages(track, buoys), buoys, strict=True), 1):
        if protocol == "enter":
            if passage.distance > buoy.radius + missed + _between(buoy.radius, step, turn):
                return number - 1, (
                    f"buoy {number}: passed at {passage.distance:.4g} m, its circle of"
                    f" {buoy.radius:.4g} m is not entered in its turn"
                )
        elif passage.least < buoy.radius - missed:
            return number - 1, (
                f"buoy {number}: its circle of {buoy.radius:.4g} m is cut, {passage.least:.4g} m"
            )
        elif {passage.side, passage.side_there} != {buoy.leave_to}:
            return (
                number - 1,
                f"buoy {number}: it is not left to {buoy.leave_to} where it is nearest",
            )
    return None


def _between(distance: float, step: float, turn: float) -> float:
    """Return how much nearer than its samples a track may come to a point that it passes.

    A sample lies at most half a step from the closest approach, along an arc that bends away.
    """
    return min(0.5 * step, step**2 / 8 * (1 / turn + 1 / distance)) if distance else 0.0

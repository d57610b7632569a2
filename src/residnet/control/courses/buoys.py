"""Courses round buoys, each with a side to pass and a radius to keep: arcs and their tangents.

Source: document 004 sections 6.1.4.2, 6.2.4.2.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

from residnet.core.config import Config, Metres
from residnet.core.errors import ConfigError

Side = Literal["starboard", "port"]


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
    leave_to: Side
    radius: Metres


class Piece(NamedTuple):
    """A part of a course: a straight line (`turn` 0) or an arc about a centre.

    An arc turns to starboard (+1) or port (-1).

    Attributes:
        length: in m.
        north, east, heading: of its beginning, in m and rad.
        turn: see above.
        radius: of an arc in m.
    """

    length: float
    north: float
    east: float
    heading: float
    turn: int
    radius: float


class Feasibility(NamedTuple):
    """The radius of a buoy's circle beside the smallest that a vessel can turn with, in m."""

    buoy: int
    radius: float
    smallest: float

    @property
    def possible(self) -> bool:
        """Whether the circle is no tighter than the vessel turns."""
        return self.radius >= self.smallest


def feasibility(buoys: Sequence[BuoyConfig], smallest: float) -> list[Feasibility]:
    """Return each buoy's radius beside the vessel's smallest turning radius in m.

    Both printed courses ask for less than the vessel can do (correction G18).
    """
    return [Feasibility(number + 1, buoy.radius, smallest) for number, buoy in enumerate(buoys)]


def widened(buoys: Sequence[BuoyConfig], smallest: float) -> list[BuoyConfig]:
    """Return the buoys with radii that the vessel can follow."""
    return [buoy.model_copy(update={"radius": max(buoy.radius, smallest)}) for buoy in buoys]


def taut_course(start: tuple[float, float], buoys: Sequence[BuoyConfig]) -> list[Piece]:
    """Return the taut course from a point round the buoys in their order, to the last one's circle.

    It consists of tangents and arcs in turn, as a rope would lie that is laid round every buoy on
    its side.

    Raises:
        ConfigError: where the start lies in the first circle, or circles overlap so that no tangent
            joins them.
    """
    if not buoys:
        raise ConfigError("a course needs at least one buoy")
    return _tangents(start, list(enumerate(buoys, start=1)))


def overlapping(buoys: Sequence[BuoyConfig]) -> list[tuple[int, int]]:
    """Return the numbers of following buoys that no course passes between, though it has to.

    Their circles overlap, and they are left to different sides.
    """
    return [
        (number, number + 1)
        for number, (one, two) in enumerate(itertools.pairwise(buoys), start=1)
        if one.leave_to != two.leave_to
        and math.hypot(two.north - one.north, two.east - one.east) < one.radius + two.radius
    ]


def _tangents(start: tuple[float, float], buoys: Sequence[tuple[int, BuoyConfig]]) -> list[Piece]:
    """Return the course that touches every circle of numbered buoys."""
    signs = [1 if buoy.leave_to == "starboard" else -1 for _, buoy in buoys]
    lines: list[tuple[float, float, float, float]] = []
    north, east, radius, sign = start[0], start[1], 0.0, 0
    for (number, buoy), side in zip(buoys, signs, strict=True):
        along, across = buoy.north - north, buoy.east - east
        # the tangent from circle 0 to circle 1: the centres' line in its own frame is (length, s1
        # r1 - s0 r0)
        offset = side * buoy.radius - sign * radius
        square = along**2 + across**2 - offset**2
        if square <= 0:
            raise ConfigError(
                f"buoy {number}: its circle of {buoy.radius:.4g} m overlaps what comes before it:"
                " no tangent joins them"
            )
        heading = math.atan2(across, along) - math.atan2(offset, math.sqrt(square))
        begin = (
            north + sign * radius * math.sin(heading),
            east - sign * radius * math.cos(heading),
        )
        lines.append((*begin, heading, math.sqrt(square)))
        north, east, radius, sign = buoy.north, buoy.east, buoy.radius, side
    pieces: list[Piece] = []
    for number, (line_north, line_east, heading, length) in enumerate(lines):
        if number > 0:
            before, side = lines[number - 1], signs[number - 1]
            turned = (side * (heading - before[2])) % (2.0 * math.pi)
            end = (
                before[0] + before[3] * math.cos(before[2]),
                before[1] + before[3] * math.sin(before[2]),
            )
            pieces.append(
                Piece(
                    turned * buoys[number - 1][1].radius,
                    *end,
                    before[2],
                    side,
                    buoys[number - 1][1].radius,
                )
            )
        pieces.append(Piece(length, line_north, line_east, heading, 0, 0.0))
    return pieces

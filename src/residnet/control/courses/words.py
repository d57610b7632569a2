"""Paths of a turn, a straight line and a turn between many poses at once, and what they touch.

Positions are complex numbers, north + i east in m.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from residnet.control.courses.turns import Array

_FULL = 2.0 * math.pi
SIDES = ((1, 1), (-1, -1), (1, -1), (-1, 1))
"""To which sides the first and the last turn of each kind of path go."""
_WIDE = 0.6
"""Angle in rad from which a turn needs all of the straight room before and behind it."""


class Room(NamedTuple):
    """What a turn needs: its radius, and straight parts before and behind it, all in m."""

    radius: float
    before: float
    behind: float


class Paths(NamedTuple):
    """Paths [...] of two turns with a straight line between.

    Attributes:
        first, last: angles in rad.
        straight: length of the line in m.
        heading: of the line in rad.
        length: in m; infinite where there is no such path.
    """

    first: Array
    last: Array
    straight: Array
    heading: Array
    length: Array


def _turned(side: int, begin: Array, end: Array) -> Array:
    """Return the angles from one heading to another on a side; no full turn for rounding errors."""
    angle = (side * (end - begin)) % _FULL
    result: Array = np.where(angle > _FULL - 1e-6, 0.0, angle)
    return result


def paths(
    places: np.ndarray, headings: Array, ends: np.ndarray, courses: Array, room: Room
) -> Paths:
    """Return the paths [4, ...] of `SIDES` from poses to poses, which broadcast.

    The straight line leaves room to come out of the first turn and to go into the last one.
    """
    found = []
    for one, two in SIDES:
        begin = places + 1j * one * room.radius * np.exp(1j * headings)
        end = ends + 1j * two * room.radius * np.exp(1j * courses)
        far, bearing = np.abs(end - begin), np.angle(end - begin)
        if one == two:
            straight, heading = far, bearing
        else:
            straight = np.sqrt(np.maximum(far**2 - 4.0 * room.radius**2, 0.0))
            heading = bearing + one * np.arctan2(2.0 * room.radius, straight)
        first, last = _turned(one, headings, heading), _turned(two, heading, courses)
        needed = room.behind * np.minimum(first / _WIDE, 1.0) + room.before * np.minimum(
            last / _WIDE, 1.0
        )
        possible = np.asarray(straight >= needed - 1e-9)
        if one != two:
            possible = possible & (far >= 2.0 * room.radius)
        length = np.where(possible, room.radius * (first + last) + straight, np.inf)
        found.append((first, last, straight, heading, length))
    return Paths(*(np.stack(part) for part in zip(*found, strict=True)))


def clear(
    places: np.ndarray,
    headings: Array,
    ends: np.ndarray,
    courses: Array,
    kinds: NDArray[np.intp],
    found: Paths,
    radius: float,
    centres: np.ndarray,
    radii: Array,
) -> NDArray[np.bool_]:
    """Return which of K paths keep out of all circles.

    Args:
        places: of the beginnings [K], as are the following.
        headings: there.
        ends: of the paths.
        courses: there.
        kinds: numbers in `SIDES`.
        found: the paths, [K] each.
        radius: of the turns in m.
        centres: of the circles [C].
        radii: of the circles [C] in m.
    """
    sides = np.array(SIDES)[kinds]
    begin = places + 1j * sides[:, 0] * radius * np.exp(1j * headings)
    end = ends + 1j * sides[:, 1] * radius * np.exp(1j * courses)
    along = np.exp(1j * found.heading)
    out = begin - 1j * sides[:, 0] * radius * along
    back = out + found.straight * along
    distance = np.minimum(
        _from_arc(begin, sides[:, 0], headings, found.first, places, out, radius, centres),
        _from_arc(end, sides[:, 1], found.heading, found.last, back, ends, radius, centres),
    )
    distance = np.minimum(distance, from_line(out, back, centres))
    free: NDArray[np.bool_] = np.all(np.asarray(distance >= radii), axis=1)
    return free


def from_line(begin: np.ndarray, end: np.ndarray, centres: np.ndarray) -> Array:
    """Return the distances [K, C] of points from straight lines [K]."""
    line = (end - begin)[:, None]
    away = centres[None] - begin[:, None]
    share = np.clip((away * line.conj()).real / np.maximum(np.abs(line) ** 2, 1e-12), 0.0, 1.0)
    distance: Array = np.abs(away - share * line)
    return distance


def _from_arc(
    centre: np.ndarray,
    side: NDArray[np.intp],
    heading: Array,
    angle: Array,
    begin: np.ndarray,
    end: np.ndarray,
    radius: float,
    points: np.ndarray,
) -> Array:
    """Return the distances [K, C] of points from arcs [K]."""
    away = points[None] - centre[:, None]
    at = np.angle(away) + side[:, None] * (0.5 * math.pi)
    within = (side[:, None] * (at - heading[:, None])) % _FULL <= angle[:, None]
    ends = np.minimum(np.abs(points[None] - begin[:, None]), np.abs(points[None] - end[:, None]))
    distance: Array = np.where(within, np.abs(np.abs(away) - radius), ends)
    return distance

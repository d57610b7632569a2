"""The outline of a course past buoys: dynamic programming over the poses in which it passes them.

Each buoy is passed in its turn, on its side. Between two buoys the course may go round others.
Paths from pose to pose are of a turn, a straight line and a turn, many at once; positions are
complex numbers, north + i east in m.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from residnet.control.courses.turns import Array, Bend, Sketch

_ANGLES = 36
"""Places about a circle at which it may be touched, ten degrees apart."""
RINGS = (0.0, 0.25)
"""How much farther off than its circle a buoy may be passed, in turning radii."""
_TRIED = 24
"""Paths to a pose that are looked at, the shortest first, before all are."""
_LOOSE = 0.05
"""Turning radii by which the outline may cut a circle; what it leads to is moved out of it."""
_ENTERED = 18
"""Courses, 20 degrees apart, in which a circle may be entered."""
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


@dataclass(frozen=True)
class Circle:
    """A circle about a buoy.

    Attributes:
        place: complex, in m.
        radius: in m.
        side: +1 where the buoy is left to starboard, -1 to port, 0 where the circle is entered.
        table: number of the table of turns that lead round it.
    """

    place: complex
    radius: float
    side: int
    table: int


@final
class _Poses:
    """Poses [M] that a course may come through, the cost of coming there, and from where.

    On the arc about a buoy the course may go on, from the pose where it joins the arc to any that
    follows.
    """

    def __init__(self, places: np.ndarray, headings: Array, buoy: int | None) -> None:
        self.places, self.headings, self.buoy = places, headings, buoy
        size = len(places)
        self.cost = np.full(size, np.inf)
        self.behind: list[tuple[_Poses, NDArray[np.intp]] | None] = [None] * size
        self.origin = np.full((size, 3), -1, dtype=np.intp)
        """Group, pose in it, and kind of path that each pose is reached by."""
        self.sources: list[_Poses] = []
        self.arc: slice | None = None
        self.side, self.table, self.ring = 0, 0, 0.0
        # where an arc is left to, the pose where it was joined
        self.joined = np.arange(size)
        self.out = self.cost

    def with_arc(self, side: int, table: int, ring: float) -> _Poses:
        """Mark the last poses as those of an arc about the buoy."""
        self.arc = slice(len(self.places) - _ANGLES, len(self.places))
        self.side, self.table, self.ring = side, table, ring
        return self

    def leave(self) -> None:
        """Fill in the cost of leaving each pose: on an arc it may have been joined before."""
        self.out = self.cost.copy()
        if self.arc is None:
            return
        step = 2.0 * math.pi / _ANGLES
        number = np.arange(_ANGLES)
        # round a buoy to starboard the place on the circle moves with growing angle
        passed = (self.side * (number[None, :] - number[:, None])) % _ANGLES
        total = self.cost[self.arc][:, None] + self.ring * step * passed
        best = total.argmin(axis=0)
        self.out[self.arc] = total[best, number]
        self.joined[self.arc] = self.arc.start + best

    def angle(self, pose: int) -> float:
        """Return the angle of the arc that is followed before a pose is left."""
        if self.arc is None or pose < self.arc.start:
            return 0.0
        return (self.side * (pose - int(self.joined[pose])) % _ANGLES) * 2.0 * math.pi / _ANGLES


@final
class Outlines:
    """The search for outlines of a course.

    Args:
        start: complex, in m.
        heading: at the start in rad; None for any.
        circles: of the buoys in their order.
        rooms: the same for the turns round each buoy.
        unit: the turning radius in m.
    """

    def __init__(
        self,
        start: complex,
        heading: float | None,
        circles: Sequence[Circle],
        room: Room,
        rooms: Sequence[Room],
        unit: float,
        rings: Sequence[float] = RINGS,
    ) -> None:
        self.start, self.heading, self.circles = start, heading, circles
        self.room, self.rooms, self.unit, self.rings = room, rooms, unit, rings
        self.kept = [circle for circle in circles if circle.side != 0]
        self.centres = np.array([circle.place for circle in self.kept])
        self.radii = np.array([circle.radius for circle in self.kept]) - _LOOSE * unit

    def find(self) -> Sketch | None:
        """Return the shortest outline; None where there is none."""
        headings = (
            np.linspace(-math.pi, math.pi, 2 * _ANGLES, endpoint=False)
            if self.heading is None
            else np.array([self.heading])
        )
        first = _Poses(np.full(len(headings), self.start), headings, None)
        first.cost[:] = first.out[:] = 0.0
        groups = [first]
        for number in range(len(self.circles)):
            target = self._poses(number)
            before = [groups[-1]]
            if self.centres.size:
                for other in self._between(number):
                    for side in (1, -1):
                        via = self._around(self.kept[other], side, None, ())
                        self._reach(before, via, number == 0)
                        if np.isfinite(via.out).any():
                            before.append(via)
            self._reach(before, target, number == 0)
            if not np.isfinite(target.out).any():
                return None
            groups.append(target)
        return self._traced(groups[-1])

    def _poses(self, number: int) -> _Poses:
        """Return the poses in which a buoy is passed, or in which its circle is entered."""
        circle = self.circles[number]
        if circle.side != 0:
            return self._around(circle, circle.side, number, self.rings)
        courses = np.linspace(-math.pi, math.pi, _ENTERED, endpoint=False)
        spots = circle.place + circle.radius * np.array(
            [0.0, *np.exp(2j * math.pi * np.arange(8) / 8)]
        )
        return _Poses(np.repeat(spots, len(courses)), np.tile(courses, len(spots)), number)

    def _around(
        self, circle: Circle, side: int, number: int | None, rings: Sequence[float]
    ) -> _Poses:
        """Return poses along circles about a buoy, the last ones on an arc about it."""
        angle = 2.0 * math.pi * np.arange(_ANGLES) / _ANGLES
        room = self.rooms[self.circles.index(circle)]
        ring = max(circle.radius, room.radius)
        radii = [circle.radius + extra * self.unit for extra in rings]
        spots = np.concatenate([radius * np.exp(1j * angle) for radius in (*radii, ring)])
        headings = np.tile(angle + side * 0.5 * math.pi, len(radii) + 1)
        poses = _Poses(circle.place + spots, headings, number)
        return poses.with_arc(side, circle.table, ring)

    def _between(self, number: int) -> list[int]:
        """Return the circles that lie in the way to a buoy, the nearest first."""
        begin = self.start if number == 0 else self.circles[number - 1].place
        end = self.circles[number].place
        near = from_line(np.array([begin]), np.array([end]), self.centres)[0]
        wide = max(self.radii.max(), self.unit) + self.unit
        found = [
            k
            for k, circle in enumerate(self.kept)
            if near[k] < self.radii[k] + wide
            and circle is not self.circles[number]
            and (number == 0 or circle is not self.circles[number - 1])
            and (number > 0 or abs(circle.place - begin) > circle.radius)
        ]
        line = (end - begin) / max(abs(end - begin), 1e-9)
        return sorted(found, key=lambda k: ((self.kept[k].place - begin) * line.conjugate()).real)

    def _shifted(self, poses: _Poses, onward: bool) -> tuple[np.ndarray, Array]:
        """Return where paths begin behind poses or end before them, and the lengths to there.

        An arc about a buoy needs room to go into it and to come out of it.
        """
        away = np.zeros(len(poses.places))
        if poses.arc is not None:
            room = self.room
            away[poses.arc] = room.behind if onward else room.before
        along = np.exp(1j * poses.headings)
        return poses.places + (away if onward else -away) * along, away

    def _reach(self, sources: Sequence[_Poses], target: _Poses, first: bool) -> None:
        """Fill in the cheapest ways to the poses of a target."""
        ends, extra = self._shifted(target, onward=False)
        radii = self.radii
        if first and len(radii):
            # a circle in which the course begins is left first
            radii = np.where(np.abs(self.centres - self.start) < radii, 0.0, radii)
        free = (
            (np.abs(target.places[:, None] - self.centres) >= radii).all(axis=1)
            if len(radii)
            else np.ones(len(ends), dtype=bool)
        )
        target.sources = list(sources)
        for group, source in enumerate(sources):
            begin, lead = self._shifted(source, onward=True)
            usable = np.flatnonzero(np.isfinite(source.out))
            wanted = np.flatnonzero(free)
            if len(usable) == 0 or len(wanted) == 0:
                continue
            # straight parts before the first and behind the last turn
            start = begin[usable] + self.room.before * np.exp(1j * source.headings[usable])
            goal = ends[wanted] - self.room.behind * np.exp(1j * target.headings[wanted])
            found = paths(
                start[:, None],
                source.headings[usable][:, None],
                goal[None],
                target.headings[wanted][None],
                self.room,
            )
            cost = (
                found.length
                + (source.out[usable] + lead[usable])[None, :, None]
                + (extra[wanted] + self.room.before + self.room.behind)[None, None]
            )
            best, chosen = self._free(
                cost, found, start, source.headings[usable], goal, target.headings[wanted], radii
            )
            better = best < target.cost[wanted]
            rows = wanted[better]
            target.cost[rows] = best[better]
            kind, pose = np.divmod(chosen[better], len(usable))
            target.origin[rows] = np.stack((np.full(len(rows), group), usable[pose], kind), axis=-1)
        target.leave()

    def _free(
        self,
        cost: Array,
        found: Paths,
        start: np.ndarray,
        headings: Array,
        goal: np.ndarray,
        courses: Array,
        radii: Array,
    ) -> tuple[Array, NDArray[np.intp]]:
        """Return the cost [M] of the cheapest path to each pose that is clear, and its number."""
        flat = cost.reshape(-1, cost.shape[-1])
        best, chosen = np.full(flat.shape[1], np.inf), np.zeros(flat.shape[1], dtype=np.intp)
        if not len(radii):
            chosen = flat.argmin(axis=0)
            return flat[chosen, np.arange(flat.shape[1])], chosen
        number = len(headings)
        tried = min(_TRIED, len(flat) - 1)
        order = np.argpartition(flat, tried, axis=0)[: tried + 1]
        every = np.broadcast_to(np.arange(flat.shape[1]), order.shape)
        rows, columns = order.ravel(), every.ravel()
        finite = np.isfinite(flat[rows, columns])
        rows, columns = rows[finite], columns[finite]
        kinds, poses = np.divmod(rows, number)
        part = Paths(*(value.reshape(-1, flat.shape[1])[rows, columns] for value in found))
        free = clear(
            start[poses],
            headings[poses],
            goal[columns],
            courses[columns],
            kinds,
            part,
            self.room.radius,
            self.centres,
            radii,
        )
        rows, columns = rows[free], columns[free]
        values = flat[rows, columns]
        last = np.argsort(-values, kind="stable")
        best[columns[last]], chosen[columns[last]] = values[last], rows[last]
        return best, chosen

    def _traced(self, last: _Poses) -> Sketch:
        """Return the outline that leads to the cheapest of the last poses."""
        pose = int(last.cost.argmin())
        group = last
        legs: list[float] = [0.0]
        bends: list[Bend] = []
        passed: list[tuple[int, ...]] = [()]
        final = True
        while group.sources:
            buoy = () if group.buoy is None else (group.buoy,)
            turned = 0.0 if final else group.angle(pose)
            joined = pose if final else int(group.joined[pose])
            on_arc = group.arc is not None and pose >= group.arc.start
            if on_arc and turned > 0.0:
                legs[0] += self.room.behind
                bends.insert(0, Bend(group.side, turned, group.table, buoy))
                legs.insert(0, self.room.before)
                passed.insert(0, ())
            else:
                passed[0] = (*buoy, *passed[0])
                legs[0] += (
                    self.room.before + (0.0 if final else self.room.behind) if on_arc else 0.0
                )
            source_number, source_pose, kind = (int(value) for value in group.origin[joined])
            source = group.sources[source_number]
            begin, _ = self._shifted(source, onward=True)
            ends, _ = self._shifted(group, onward=False)
            start = begin[source_pose] + self.room.before * np.exp(
                1j * source.headings[source_pose]
            )
            goal = ends[joined] - self.room.behind * np.exp(1j * group.headings[joined])
            path = paths(
                start, source.headings[source_pose], goal, group.headings[joined], self.room
            )
            one, two = SIDES[kind]
            legs[0] += self.room.behind
            bends.insert(0, Bend(two, float(path.last[kind]), 0))
            legs.insert(0, float(path.straight[kind]))
            passed.insert(0, ())
            bends.insert(0, Bend(one, float(path.first[kind]), 0))
            legs.insert(0, self.room.before)
            passed.insert(0, ())
            group, pose, final = source, source_pose, False
        return Sketch(float(group.headings[pose]), tuple(legs), tuple(bends), tuple(passed))

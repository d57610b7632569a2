"""Buoy courses as configs: the request, the plan that a vessel can follow, the shortest course."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from pydantic import Field

from residnet.control.courses.course_check import Asked, Protocol
from residnet.control.courses.course_plan import Course, CourseRequest, plan
from residnet.control.courses.outline import Circle
from residnet.control.courses.turns import (
    SteadyTurn,
    TurnMaker,
    Turns,
    arcs,
    simulated_turns,
    steady_turn,
    turning_step,
)
from residnet.control.heading.turning import Turning
from residnet.control.heading.vessels import SteeredVessel
from residnet.core.config import Config, Metres, MetresPerSecond, Radians, Seconds
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


_TURN = 2.0 * math.pi


def _arc(side: float, begin: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the angle turned from one heading to another, side +1 to starboard and -1 to port."""
    # a full turn that is none but for rounding
    turned = (side * (end - begin)) % _TURN
    return np.where(turned > _TURN - 1e-9, 0.0, turned)


def _centre(pose: np.ndarray, side: float, radius: float) -> np.ndarray:
    return pose[..., :2] + side * radius * np.stack(
        (-np.sin(pose[..., 2]), np.cos(pose[..., 2])), axis=-1
    )


def dubins_length(start: np.ndarray, end: np.ndarray, radius: float) -> np.ndarray:
    """Return the length [...] in m of the shortest path between poses of bounded curvature.

    The path is two arcs and their common tangent, or three arcs (L. E. Dubins 1957). Poses [..., 3]
    = (north, east, heading) broadcast; turns have a radius of at least `radius`.
    """
    start, end = np.broadcast_arrays(np.asarray(start, dtype=float), np.asarray(end, dtype=float))
    h0, h1 = start[..., 2], end[..., 2]
    best = np.full(h0.shape, np.inf)
    for side in (1.0, -1.0):
        centre = _centre(start, side, radius)
        line = _centre(end, side, radius) - centre
        distance, bearing = (
            np.hypot(line[..., 0], line[..., 1]),
            np.arctan2(line[..., 1], line[..., 0]),
        )
        best = np.minimum(
            best, radius * (_arc(side, h0, bearing) + _arc(side, bearing, h1)) + distance
        )
        # three arcs, the middle one about either point that is two radii from both centres
        lean = np.arccos(np.clip(distance / (4.0 * radius), 0.0, 1.0))
        for hand in (1.0, -1.0):
            out = bearing + hand * lean
            back = bearing + math.pi - hand * lean
            first, second = out + side * 0.5 * math.pi, back + side * 0.5 * math.pi
            turned = _arc(side, h0, first) + _arc(-side, first, second) + _arc(side, second, h1)
            best = np.where(distance <= 4.0 * radius, np.minimum(best, radius * turned), best)
        line = _centre(end, -side, radius) - centre
        distance, bearing = (
            np.hypot(line[..., 0], line[..., 1]),
            np.arctan2(line[..., 1], line[..., 0]),
        )
        straight = np.sqrt(np.maximum(distance**2 - 4.0 * radius**2, 0.0))
        heading = bearing + side * np.arctan2(2.0 * radius, straight)
        total = radius * (_arc(side, h0, heading) + _arc(-side, heading, h1)) + straight
        best = np.where(distance >= 2.0 * radius, np.minimum(best, total), best)
    return best


_STEP = math.log(1.12)
"""Between the radii of the turns that a plan uses, logarithmic."""
_BESIDE = 0.05
"""Of a buoy's radius by which a plan comes nearer than where it begins, unless room lacks."""


class BuoyCourseConfig(Config):
    """A course past buoys.

    Attributes:
        buoys: in their order; sides and radii are for the protocol `sides`, the positions for both.
        acceptance: radius of the circles that are entered.
        start: (north, east).
        heading: at the start; null to start on the first leg.
        share: of the rudder's limit that turns are planned with; the rest is left to keep to them.
        reach: share of the circle of acceptance that the plan reaches into from its edge, at least.
        margin: that the plan keeps from the buoys' circles, as a share of their radius.
        current: strongest that the plan leaves room for; the vessel is displaced by it until the
            guidance has corrected.
        lookahead: of the line-of-sight guidance.
        planning_dt: step of the simulated turns; null for the longest that simulates them as half
            of it does, to 0.001 turning radii.
        turning_time: until a held rudder's turn is steady.
    """

    buoys: tuple[BuoyConfig, ...] = Field(min_length=2)
    acceptance: Metres = Field(gt=0)
    start: tuple[Metres, Metres] = (0.0, 0.0)
    heading: Radians | None = None
    share: float = Field(default=0.9, gt=0, lt=1)
    reach: float = Field(default=0.1, ge=0, lt=1)
    margin: float = Field(default=0.01, ge=0, lt=1)
    current: MetresPerSecond = Field(default=0.0, ge=0)
    lookahead: Metres = Field(gt=0)
    planning_dt: Seconds | None = Field(default=None, gt=0)
    turning_time: Seconds = Field(default=100.0, gt=0)


@dataclass(frozen=True)
class PlannedCourse:
    """What is flown, and what it is measured against.

    Attributes:
        protocol: see there.
        course: the plan.
        buoys: with radii that the vessel can follow.
        steady: the vessel's smallest turn.
        reference: length in m that times are compared with, for turns of that radius that begin at
            once: of the taut course round all buoys where they are passed on their sides, which
            need not be the shortest, and of the shortest course found where they are entered.
    """

    protocol: Protocol
    course: Course
    buoys: tuple[BuoyConfig, ...]
    steady: SteadyTurn
    reference: float


def smallest_turn(
    config: BuoyCourseConfig, vessel: SteeredVessel, turning: Turning, limit: float
) -> SteadyTurn:
    """Return the smallest turn of the nominal vessel, at the rudder's limit in rad."""
    step = config.planning_dt or turning_step(vessel, turning, limit)
    return steady_turn(vessel, limit, config.turning_time, step)


def feasibility(buoys: Sequence[BuoyConfig], smallest: float) -> list[dict[str, float | bool]]:
    """Return each buoy's radius and the smallest possible one in m, and whether it is possible.

    Both printed courses ask for less than the vessel can do (correction G18).
    """
    return [
        {
            "buoy": number,
            "radius": buoy.radius,
            "smallest": smallest,
            "possible": buoy.radius >= smallest,
        }
        for number, buoy in enumerate(buoys, start=1)
    ]


def plan_course(
    config: BuoyCourseConfig,
    protocol: Protocol,
    vessel: SteeredVessel,
    turning: Turning,
    limit: float,
    steady: SteadyTurn,
) -> PlannedCourse:
    """Return the quickest course found that the nominal vessel can follow, with rudder in reserve.

    Raises:
        ConfigError: where none is found.
    """
    buoys = tuple(widened(config.buoys, steady.radius))
    step = 0.1 * turning.speed
    if protocol == "sides" and (pairs := overlapping(buoys)):
        one, two = pairs[0]
        raise ConfigError(
            f"buoys {one} and {two}: their circles overlap, and the course has to pass between"
            " them; move one, or give them smaller circles"
        )
    current = config.current / turning.speed
    share = config.share * (1.0 - current)
    aside = config.current * (turning.time + config.lookahead / turning.speed)
    margin = config.reach if protocol == "enter" else config.margin
    circles, radii = _request(config, protocol, buoys, steady.radius / share, margin, aside)
    rudder = limit * steady.radius / radii
    # what a turn takes is seen from the yaw rate that it reaches, which K overstates in hard turns
    reached = replace(turning, gain=steady.yaw_rate / limit)
    make = TurnMaker(vessel, reached, steady.step)
    turns = simulated_turns(make, rudder, steady.radius)
    course = plan(
        _asked(config, protocol, buoys, circles, turns, aside), step, 5.0 * config.lookahead, make
    )
    reference = _reference(config, protocol, buoys, steady, turning.speed)
    return PlannedCourse(protocol, course, buoys, steady, reference)


def _reference(
    config: BuoyCourseConfig,
    protocol: Protocol,
    buoys: tuple[BuoyConfig, ...],
    steady: SteadyTurn,
    speed: float,
) -> float:
    """Return the length in m that plans and flights are compared with."""
    if protocol == "enter":
        circles, radii = _request(config, protocol, buoys, steady.radius, 0.0, 0.0)
        asked = _asked(config, protocol, buoys, circles, arcs(radii, speed))
        return plan(asked, 0.1 * speed, 0.1 * speed).length
    try:
        line, *rest = taut_course(config.start, buoys)
    except ConfigError:
        places = np.array([config.start, *((buoy.north, buoy.east) for buoy in buoys)])
        return float(np.hypot(*np.diff(places, axis=0).T).sum())
    onto = line.length
    if config.heading is not None:
        end = (
            line.north + line.length * math.cos(line.heading),
            line.east + line.length * math.sin(line.heading),
            line.heading,
        )
        onto = float(
            dubins_length(np.array([*config.start, config.heading]), np.array(end), steady.radius)
        )
    return onto + sum(piece.length for piece in rest)


def _asked(
    config: BuoyCourseConfig,
    protocol: Protocol,
    buoys: tuple[BuoyConfig, ...],
    circles: tuple[Circle, ...],
    turns: Turns,
    aside: float = 0.0,
) -> CourseRequest:
    asked = tuple(
        Asked(
            buoy.north,
            buoy.east,
            config.acceptance if protocol == "enter" else buoy.radius,
            buoy.leave_to,
        )
        for buoy in buoys
    )
    return CourseRequest(config.start, config.heading, circles, asked, protocol, turns, aside)


def _request(
    config: BuoyCourseConfig,
    protocol: Protocol,
    buoys: tuple[BuoyConfig, ...],
    tightest: float,
    margin: float,
    aside: float,
) -> tuple[tuple[Circle, ...], np.ndarray]:
    """Return the circles that a plan keeps to, and the radii in m of the turns that it uses.

    A wide circle is rounded with less rudder.
    """
    if protocol == "enter":
        depth = max((1.0 - margin) * config.acceptance - aside, 0.05 * config.acceptance)
        return tuple(
            Circle(complex(buoy.north, buoy.east), depth, 0, 0) for buoy in buoys
        ), np.array([tightest])
    radii = [_kept(buoy, config.start, margin, aside) for buoy in buoys]
    # a few rudder angles do for circles of many sizes
    steps = [max(math.floor(math.log(radius / tightest) / _STEP), 0) for radius in radii]
    wide = sorted({0, *steps})
    return tuple(
        Circle(
            complex(buoy.north, buoy.east),
            radius,
            1 if buoy.leave_to == "starboard" else -1,
            wide.index(step),
        )
        for buoy, radius, step in zip(buoys, radii, steps, strict=True)
    ), tightest * np.exp(_STEP * np.array(wide))


def _kept(buoy: BuoyConfig, start: tuple[float, float], margin: float, aside: float) -> float:
    """Return the radius in m that a plan keeps from a buoy: less where it begins nearer than that.

    The start may lie on the wrong side: then the course passes nearer than it begins, by as much as
    it may be displaced, or half way between its start and the circle. Where it begins within the
    buoy's own circle, it leaves that first.
    """
    radius = (1.0 + margin) * buoy.radius + aside
    room = math.hypot(buoy.north - start[0], buoy.east - start[1]) - buoy.radius
    if room < 0:
        return radius
    nearer = min(max(aside, _BESIDE * buoy.radius), 0.5 * room)
    return min(radius, buoy.radius + room - nearer)

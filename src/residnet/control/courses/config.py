"""Buoy courses as configs: the request, the plan that a vessel can follow, the shortest course."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field

from residnet.control.courses.buoys import (
    BuoyConfig,
    feasibility,
    overlapping,
    taut_course,
    widened,
)
from residnet.control.courses.course_check import Asked, Protocol
from residnet.control.courses.course_plan import Course, CourseRequest, plan
from residnet.control.courses.dubins import dubins_length
from residnet.control.courses.outline import Circle
from residnet.control.courses.turn_table import Turns, arcs, simulated_turns
from residnet.control.courses.turns import SteadyTurn, TurnMaker, steady_turn, turning_step
from residnet.control.heading.turning import Turning
from residnet.control.heading.vessels import SteeredVessel
from residnet.core.config import Config, Metres, MetresPerSecond, Radians, Seconds
from residnet.core.errors import ConfigError

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


def report_feasibility(
    config: BuoyCourseConfig, steady: SteadyTurn
) -> list[dict[str, float | bool]]:
    """Return each buoy's radius and the smallest possible one in m, and whether it is possible."""
    return [
        {
            "buoy": found.buoy,
            "radius": found.radius,
            "smallest": found.smallest,
            "possible": found.possible,
        }
        for found in feasibility(config.buoys, steady.radius)
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
        _asked(config, protocol, buoys, circles, turns, aside),
        step,
        5.0 * config.lookahead,
        make,
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

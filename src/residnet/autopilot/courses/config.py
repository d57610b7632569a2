"""Buoy courses as configs: the request, the plan that a vessel can follow, the shortest course."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from pydantic import Field

from residnet.autopilot.courses.course_check import BuoyConfig, Protocol
from residnet.autopilot.courses.course_plan import Course, CourseRequest, find_quickest_course
from residnet.autopilot.courses.outline import Circle
from residnet.autopilot.courses.turns import (
    SteadyTurn,
    TurnMaker,
    TurnTables,
    arc_turns,
    choose_time_step,
    simulate_steady_turn,
    simulate_turns,
)
from residnet.autopilot.heading.turning import NomotoModel
from residnet.autopilot.heading.vessels import SteeredVessel
from residnet.core.config import Config, Metres, MetresPerSecond, Radians, Seconds
from residnet.core.errors import ConfigError


def enlarge_to_turning_radius(buoys: Sequence[BuoyConfig], min_radius: float) -> list[BuoyConfig]:
    """Return the buoys with radii that the vessel can follow."""
    return [buoy.model_copy(update={"radius": max(buoy.radius, min_radius)}) for buoy in buoys]


def overlapping_pairs(buoys: Sequence[BuoyConfig]) -> list[tuple[int, int]]:
    """Return the numbers of following buoys that no course passes between, though it has to.

    Their circles overlap, and they are left to different sides.
    """
    return [
        (number, number + 1)
        for number, (first, second) in enumerate(itertools.pairwise(buoys), start=1)
        if first.leave_to != second.leave_to
        and math.hypot(second.north - first.north, second.east - first.east)
        < first.radius + second.radius
    ]


_LOG_RADIUS_STEP = math.log(1.12)
"""Between the radii of the turns that a plan uses, logarithmic."""
_MIN_START_CLEARANCE = 0.05
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
        shortest: the same course without margins, for turns of that radius that begin at once.
    """

    protocol: Protocol
    course: Course
    buoys: tuple[BuoyConfig, ...]
    steady: SteadyTurn
    shortest: CourseRequest

    @cached_property
    def reference_length(self) -> float:
        """The length in m of the shortest course found, which times are compared with."""
        try:
            shortest_length = find_quickest_course(
                self.shortest, self.course.step, self.course.step
            ).length
        except ConfigError:
            return self.course.length
        return min(shortest_length, self.course.length)


def smallest_turn(
    config: BuoyCourseConfig, vessel: SteeredVessel, nomoto: NomotoModel, limit: float
) -> SteadyTurn:
    """Return the smallest turn of the nominal vessel, at the rudder's limit in rad."""
    step = config.planning_dt or choose_time_step(vessel, nomoto, limit)
    return simulate_steady_turn(vessel, limit, config.turning_time, step)


def buoy_feasibility(
    buoys: Sequence[BuoyConfig], min_radius: float
) -> list[dict[str, float | bool]]:
    """Return each buoy's radius and the smallest possible one in m, and whether it is possible.

    Both printed courses ask for less than the vessel can do (correction G18).
    """
    return [
        {
            "buoy": number,
            "radius": buoy.radius,
            "smallest": min_radius,
            "possible": buoy.radius >= min_radius,
        }
        for number, buoy in enumerate(buoys, start=1)
    ]


def plan_course(
    config: BuoyCourseConfig,
    protocol: Protocol,
    vessel: SteeredVessel,
    nomoto: NomotoModel,
    limit: float,
    steady: SteadyTurn,
) -> PlannedCourse:
    """Return the quickest course found that the nominal vessel can follow, with rudder in reserve.

    Raises:
        ConfigError: where none is found.
    """
    buoys = tuple(enlarge_to_turning_radius(config.buoys, steady.radius))
    if protocol == "sides" and (pairs := overlapping_pairs(buoys)):
        first, second = pairs[0]
        raise ConfigError(
            f"buoys {first} and {second}: their circles overlap, and the course has to pass between"
            " them; move one, or give them smaller circles"
        )
    current = config.current / nomoto.speed
    rudder_share = config.share * (1.0 - current)
    max_offset = config.current * (nomoto.time + config.lookahead / nomoto.speed)
    clearance_margin = config.reach if protocol == "enter" else config.margin
    # what a turn takes is seen from the yaw rate that it reaches, which K overstates in hard turns
    achieved_nomoto = replace(nomoto, gain=steady.yaw_rate / limit)
    turn_maker = TurnMaker(vessel, achieved_nomoto, steady.step)

    def request(
        min_radius: float,
        margin: float,
        max_offset: float,
        make_turns: Callable[[np.ndarray], TurnTables],
    ) -> CourseRequest:
        circles, radii = _clearance_circles(config, protocol, buoys, min_radius, margin, max_offset)
        checked_buoys = buoys
        if protocol == "enter":
            checked_buoys = tuple(
                buoy.model_copy(update={"radius": config.acceptance}) for buoy in buoys
            )
        return CourseRequest(
            config.start,
            config.heading,
            circles,
            checked_buoys,
            protocol,
            make_turns(radii),
            max_offset,
        )

    def simulated(radii: np.ndarray) -> TurnTables:
        return simulate_turns(turn_maker, limit * steady.radius / radii, steady.radius)

    step = 0.1 * nomoto.speed
    course_request = request(steady.radius / rudder_share, clearance_margin, max_offset, simulated)
    course = find_quickest_course(course_request, step, 5.0 * config.lookahead, turn_maker)
    shortest = request(steady.radius, 0.0, 0.0, lambda radii: arc_turns(radii, nomoto.speed))
    return PlannedCourse(protocol, course, buoys, steady, shortest)


def _clearance_circles(
    config: BuoyCourseConfig,
    protocol: Protocol,
    buoys: tuple[BuoyConfig, ...],
    min_radius: float,
    margin: float,
    max_offset: float,
) -> tuple[tuple[Circle, ...], np.ndarray]:
    """Return the circles that a plan keeps to, and the radii in m of the turns that it uses.

    A wide circle is rounded with less rudder.
    """
    if protocol == "enter":
        depth = max((1.0 - margin) * config.acceptance - max_offset, 0.05 * config.acceptance)
        return tuple(
            Circle(complex(buoy.north, buoy.east), depth, 0, 0) for buoy in buoys
        ), np.array([min_radius])
    radii = [_clearance_radius(buoy, config.start, margin, max_offset) for buoy in buoys]
    # a few rudder angles do for circles of many sizes
    buoy_steps = [
        max(math.floor(math.log(radius / min_radius) / _LOG_RADIUS_STEP), 0) for radius in radii
    ]
    radius_steps = sorted({0, *buoy_steps})
    return tuple(
        Circle(
            complex(buoy.north, buoy.east),
            radius,
            1 if buoy.leave_to == "starboard" else -1,
            radius_steps.index(step),
        )
        for buoy, radius, step in zip(buoys, radii, buoy_steps, strict=True)
    ), min_radius * np.exp(_LOG_RADIUS_STEP * np.array(radius_steps))


def _clearance_radius(
    buoy: BuoyConfig, start: tuple[float, float], margin: float, max_offset: float
) -> float:
    """Return the radius in m that a plan keeps from a buoy: less where it begins nearer than that.

    The start may lie on the wrong side: then the course passes nearer than it begins, by as much as
    it may be displaced, or half way between its start and the circle. Where it begins within the
    buoy's own circle, it leaves that first.
    """
    radius = (1.0 + margin) * buoy.radius + max_offset
    start_distance = math.hypot(buoy.north - start[0], buoy.east - start[1]) - buoy.radius
    if start_distance < 0:
        return radius
    start_clearance = min(max(max_offset, _MIN_START_CLEARANCE * buoy.radius), 0.5 * start_distance)
    return min(radius, buoy.radius + start_distance - start_clearance)

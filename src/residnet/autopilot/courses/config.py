"""Configuration and planning of courses past buoys."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from pydantic import Field

from residnet.autopilot.courses.course_check import BuoyConfig, PassingRule
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
from residnet.autopilot.records import BuoyFeasibility
from residnet.core.config import Config, Metres, MetresPerSecond, Radians, Seconds
from residnet.core.errors import ConfigError


def enlarge_to_turning_radius(buoys: Sequence[BuoyConfig], min_radius: float) -> list[BuoyConfig]:
    """Return the buoys with radii of at least the turning radius of the vessel."""
    return [buoy.model_copy(update={"radius": max(buoy.radius, min_radius)}) for buoy in buoys]


def overlapping_pairs(buoys: Sequence[BuoyConfig]) -> list[tuple[int, int]]:
    """Return the numbers (from 1) of consecutive buoys between which no course can pass.

    Their circles overlap, and they are to be left to different sides.
    """
    return [
        (number, number + 1)
        for number, (first, second) in enumerate(itertools.pairwise(buoys), start=1)
        if first.leave_to != second.leave_to
        and math.hypot(second.north - first.north, second.east - first.east)
        < first.radius + second.radius
    ]


_LOG_RADIUS_STEP = math.log(1.12)
"""Logarithmic step between the turning radii of a plan."""
_MIN_START_CLEARANCE = 0.05
"""Decrease of the clearance from a buoy below the start distance, relative to its radius."""


class BuoyCourseConfig(Config):
    """A course past buoys.

    Attributes:
        buoys: buoys in order; the protocol `enter` uses only their positions.
        acceptance: radius of the circles of acceptance in m.
        start: start position (north, east) in m.
        heading: start heading in rad; null to start on the first leg.
        share: fraction of the rudder limit that planned turns use; the difference is reserved for
            path following.
        reach: smallest depth of the course inside a circle of acceptance, as a fraction of its
            radius.
        margin: clearance of the course from the circles of the buoys, as a fraction of their
            radius.
        current: largest current speed in m/s; the plan reserves the distance by which it displaces
            the vessel until the guidance has corrected it.
        lookahead: look-ahead distance of the line-of-sight guidance in m.
        planning_dt: time step of the simulated turns in s; null to choose the largest converged
            step (to 0.001 turning radii).
        turning_time: time in s until the turn at a constant rudder angle is steady.
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
    """A planned course and the reference that its duration is compared with.

    Attributes:
        protocol: rule for passing buoys.
        course: the planned course.
        buoys: buoys with radii that the vessel can follow.
        steady: tightest steady turn of the vessel.
        shortest: shortest course without margins, with arcs of the radius of that turn.
    """

    protocol: PassingRule
    course: Course
    buoys: tuple[BuoyConfig, ...]
    steady: SteadyTurn
    shortest: CourseRequest

    @cached_property
    def reference_length(self) -> float:
        """Length in m of the shortest course, the reference for course times."""
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
    """Simulate the tightest turn of the nominal vessel, at the rudder limit in rad."""
    step = config.planning_dt or choose_time_step(vessel, nomoto, limit)
    return simulate_steady_turn(vessel, limit, config.turning_time, step)


def buoy_feasibility(buoys: Sequence[BuoyConfig], min_radius: float) -> list[BuoyFeasibility]:
    """Describe how the radii of the buoys compare with the smallest turning radius in m.

    Both courses of Gouletas 2020 have radii below it (see G18 in docs/documents/corrections.md).
    """
    return [
        BuoyFeasibility(
            buoy=number,
            radius=buoy.radius,
            smallest=min_radius,
            possible=buoy.radius >= min_radius,
        )
        for number, buoy in enumerate(buoys, start=1)
    ]


def plan_course(
    config: BuoyCourseConfig,
    protocol: PassingRule,
    vessel: SteeredVessel,
    nomoto: NomotoModel,
    limit: float,
    steady: SteadyTurn,
) -> PlannedCourse:
    """Plan the quickest course that the nominal vessel can follow with a reserve of rudder.

    Args:
        config: settings of the course.
        protocol: rule for passing buoys.
        vessel: steered vessel.
        nomoto: K, T and speed of the vessel.
        limit: rudder limit in rad.
        steady: tightest steady turn.

    Raises:
        ConfigError: if no course is found.
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
    # the gain of the steady turn replaces K, which overestimates the yaw rate of hard turns
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
    protocol: PassingRule,
    buoys: tuple[BuoyConfig, ...],
    min_radius: float,
    margin: float,
    max_offset: float,
) -> tuple[tuple[Circle, ...], np.ndarray]:
    """Return the circles of a plan with margins, and the turning radii in m that it uses.

    A large circle is rounded with a smaller rudder angle.
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
    """Return the clearance in m of a plan from a buoy, reduced if the start is nearer.

    The start may be on the wrong side of the buoy. The clearance is then below the start distance
    by the largest deviation from the course, or half way between start distance and circle. A
    course that starts inside the circle of the buoy leaves it first.
    """
    radius = (1.0 + margin) * buoy.radius + max_offset
    start_distance = math.hypot(buoy.north - start[0], buoy.east - start[1]) - buoy.radius
    if start_distance < 0:
        return radius
    start_clearance = min(max(max_offset, _MIN_START_CLEARANCE * buoy.radius), 0.5 * start_distance)
    return min(radius, buoy.radius + start_distance - start_clearance)

"""Buoy courses as configs: the request, the plan that a vessel can follow, the shortest course."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field

from residnet.control.courses.buoys import BuoyConfig, course_round, feasibility, widened
from residnet.control.courses.course_plan import Course, plan
from residnet.control.courses.course_search import Mark
from residnet.control.courses.dubins import dubins_length, shortest_course
from residnet.control.courses.turns import SteadyTurn, TurnMaker, steady_turn
from residnet.control.heading.steering import SteeredVessel
from residnet.control.heading.turning import Turning
from residnet.core.config import Config, Metres, Radians, Seconds

Protocol = Literal["enter", "sides"]
"""Buoys are entered: a circle of acceptance about each; or each is passed on its side, outside its
own circle.
"""


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
        lookahead: of the line-of-sight guidance.
        planning_dt: step of the simulated turns.
        turning_time: until a held rudder's turn is steady.
    """

    buoys: tuple[BuoyConfig, ...] = Field(min_length=2)
    acceptance: Metres = Field(gt=0)
    start: tuple[Metres, Metres] = (0.0, 0.0)
    heading: Radians | None = None
    share: float = Field(default=0.9, gt=0, lt=1)
    reach: float = Field(default=0.1, ge=0, lt=1)
    margin: float = Field(default=0.01, ge=0, lt=1)
    lookahead: Metres = Field(gt=0)
    planning_dt: Seconds = Field(default=0.05, gt=0)
    turning_time: Seconds = Field(default=100.0, gt=0)


@dataclass(frozen=True)
class PlannedCourse:
    """What is flown, and what it is measured against.

    Attributes:
        protocol: see there.
        course: the plan.
        buoys: with radii that the vessel can follow.
        steady: the vessel's smallest turn.
        floor: length in m of the shortest course of bounded curvature at that radius that fulfils
            the protocol.
    """

    protocol: Protocol
    course: Course
    buoys: tuple[BuoyConfig, ...]
    steady: SteadyTurn
    floor: float


def smallest_turn(config: BuoyCourseConfig, vessel: SteeredVessel, limit: float) -> SteadyTurn:
    """Return the smallest turn of the nominal vessel, at the rudder's limit in rad."""
    return steady_turn(vessel, limit, config.turning_time, config.planning_dt)


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
    """Return the shortest course that the nominal vessel can follow with a share of its rudder.

    Raises:
        ConfigError: where there is none.
    """
    buoys = tuple(widened(config.buoys, steady.radius))
    hardest = config.share * limit
    marks = (
        _to_enter(config, hardest)
        if protocol == "enter"
        else _to_pass(config, buoys, hardest, steady.radius)
    )
    make = TurnMaker(vessel, turning, config.planning_dt)
    course = plan(
        config.start,
        config.heading,
        marks[:-1],
        marks[-1],
        make,
        steady,
        0.1 * turning.speed,
        5.0 * config.lookahead,
    )
    return PlannedCourse(protocol, course, buoys, steady, _floor(config, protocol, buoys, steady))


def _to_enter(config: BuoyCourseConfig, rudder: float) -> list[Mark]:
    """Return the marks where the line from way-point to way-point bends.

    One that the line enters anyway needs none.
    """
    depth = -(1.0 - config.reach) * config.acceptance
    places = [config.start, *((buoy.north, buoy.east) for buoy in config.buoys)]
    numbers = list(range(1, len(places)))
    marks: list[Mark] = []
    before = places[0]
    for number, after in itertools.pairwise(numbers):
        place, target = places[number], places[after]
        along, across = (
            (target[0] - before[0], target[1] - before[1]),
            (
                place[0] - before[0],
                place[1] - before[1],
            ),
        )
        offset = along[0] * across[1] - along[1] * across[0]
        inside = 0 <= along[0] * across[0] + along[1] * across[1] <= along[0] ** 2 + along[1] ** 2
        if inside and abs(offset) <= -depth * math.hypot(*along):
            continue
        marks.append(Mark(number, *place, -1 if offset > 0 else 1, depth, rudder))
        before = place
    return [*marks, Mark(numbers[-1], *places[-1], 1, depth, rudder)]


def _to_pass(
    config: BuoyCourseConfig, buoys: tuple[BuoyConfig, ...], rudder: float, smallest: float
) -> list[Mark]:
    """Return the marks where the taut course bends round a circle."""
    arcs = [piece for piece in course_round(config.start, buoys) if piece.turn != 0]
    marks = []
    for number, buoy in enumerate(buoys, start=1):
        sign = 1 if buoy.leave_to == "starboard" else -1
        # the centre of an arc is its buoy
        centres = [
            (
                arc.north - arc.turn * arc.radius * math.sin(arc.heading),
                arc.east + arc.turn * arc.radius * math.cos(arc.heading),
            )
            for arc in arcs
        ]
        if number == len(buoys) or any(
            math.hypot(n - buoy.north, e - buoy.east) < 1e-6 * buoy.radius + 1e-9
            for n, e in centres
        ):
            # a wide circle needs less rudder
            needed = rudder * min(1.0, smallest / buoy.radius)
            marks.append(
                Mark(
                    number, buoy.north, buoy.east, sign, (1.0 + config.margin) * buoy.radius, needed
                )
            )
    return marks


def _floor(
    config: BuoyCourseConfig, protocol: Protocol, buoys: tuple[BuoyConfig, ...], steady: SteadyTurn
) -> float:
    if protocol == "sides":
        line, *rest = course_round(config.start, buoys)
        onto = line.length
        if config.heading is not None:
            end = (
                line.north + line.length * math.cos(line.heading),
                line.east + line.length * math.sin(line.heading),
                line.heading,
            )
            onto = float(
                dubins_length(
                    np.array([*config.start, config.heading]), np.array(end), steady.radius
                )
            )
        return onto + sum(piece.length for piece in rest)
    points = [(buoy.north, buoy.east) for buoy in config.buoys]
    return shortest_course(
        (*config.start, config.heading), points, config.acceptance, steady.radius
    )

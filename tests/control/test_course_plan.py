"""Planned courses and guidance along them, against closed forms of Nomoto's model and geometry of
their own.
"""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np
import pytest
import torch

from residnet.control.base import ClosedLoop
from residnet.control.courses.config import (
    BuoyConfig,
    BuoyCourseConfig,
    PlannedCourse,
    feasibility,
    overlapping,
    plan_course,
    smallest_turn,
    widened,
)
from residnet.control.courses.course_check import Protocol
from residnet.control.courses.course_plan import Course
from residnet.control.courses.turns import TurnMaker, steady_turn, turning_step
from residnet.control.guidance import CourseGuidance, TrackKeeping
from residnet.control.heading.classical import HeadingPD
from residnet.control.heading.turning import Turning
from residnet.control.heading.vessels import SteeredPlant
from residnet.core.errors import ConfigError
from residnet.dynamics.rollout import Rollout
from residnet.physics.vessel import load_vessel

LIMIT = math.radians(5)
TURNING = Turning(gain=3.47, time=3.94, speed=3.2)
BUOYS = (
    BuoyConfig(north=50, east=30, leave_to="port", radius=10),
    BuoyConfig(north=100, east=20, leave_to="starboard", radius=10),
    BuoyConfig(north=50, east=80, leave_to="port", radius=10),
)
WANTED = BuoyCourseConfig(buoys=BUOYS, acceptance=3.4, lookahead=12.0, planning_dt=0.2)


@pytest.fixture(scope="module")
def vessel() -> SteeredPlant:
    return SteeredPlant(load_vessel("nomoto_oceanos").build())


def plan_of(vessel: SteeredPlant, protocol: Protocol = "sides", **changes: Any) -> PlannedCourse:
    wanted = WANTED.model_copy(update=changes)
    steady = smallest_turn(wanted, vessel, TURNING, LIMIT)
    return plan_course(wanted, protocol, vessel, TURNING, LIMIT, steady)


def circle(radius: float, step: float = 0.1) -> Course:
    """A turn to starboard for ever, from the origin northwards."""
    angle = np.arange(0.0, 3.0 * math.pi, step / radius)
    track = radius * np.stack((np.sin(angle), 1.0 - np.cos(angle)), axis=-1)
    return Course(step, track, angle, angle, np.full(len(angle), 0.04), 2.5 * math.pi * radius)


def test_the_steady_turn_is_that_of_the_model(vessel: SteeredPlant) -> None:
    steady = steady_turn(vessel, LIMIT, 100.0, 0.05)
    assert steady.radius == pytest.approx(3.2 / (3.47 * LIMIT), rel=1e-3)
    # printed radii of 10 m are too tight for five degrees of rudder
    assert not any(one["possible"] for one in feasibility(BUOYS, steady.radius))
    wide = feasibility(widened(BUOYS, steady.radius), steady.radius)
    assert all(one["possible"] for one in wide)


def test_circles_that_overlap_leave_no_way_between_them() -> None:
    near = BUOYS[1].model_copy(update={"north": 50, "east": 45})
    assert overlapping([BUOYS[0], near, BUOYS[2]]) == [(1, 2)]
    assert overlapping(BUOYS) == []


def test_turns_take_the_time_of_full_rudder_and_counter_rudder(vessel: SteeredPlant) -> None:
    """T r_dot + r = K delta, rest to rest: turned K d (t1 - t2), t2 = T ln(2 - exp(-t1 / T))."""
    make = TurnMaker(vessel, TURNING, 0.05)
    holds = np.array([[3.0, 9.0], [5.03, 12.0]])
    for side, row in zip(
        (1, -1), make(holds, 0.9 * LIMIT * np.array([1, -1]), [make.straight] * 2, 4.0), strict=True
    ):
        for turn in row:
            counter = 3.94 * math.log(2.0 - math.exp(-turn.hold / 3.94))
            assert turn.lasts == pytest.approx(turn.hold + counter, abs=1e-3)
            angle = side * 3.47 * 0.9 * LIMIT * (turn.hold - counter)
            end, turned = turn.at(np.array([turn.lasts]))
            assert turned == pytest.approx(angle, abs=1e-4)
            # straight on behind it
            track, heading = turn.along(np.array([0.0, 4.0]))
            assert heading == pytest.approx(angle, abs=1e-4)
            assert track[0] == pytest.approx(end[0], abs=1e-9)
            assert track[1] - track[0] == pytest.approx(
                3.2 * 4.0 * np.array([math.cos(angle), math.sin(angle)]), abs=2e-3
            )


def test_a_turn_that_follows_a_turn_begins_with_its_yaw(vessel: SteeredPlant) -> None:
    """Nomoto's heading from a yaw rate r0: r0 T (1 - e) + K d (t - T (1 - e)), e = exp(-t / T)."""
    make = TurnMaker(vessel, TURNING, 0.05)
    begin = make.straight.copy()
    begin[vessel.column("r")], begin[vessel.column("psi")] = -0.1, 2.0
    turn = make(np.array([[6.0]]), np.array([LIMIT]), [begin], 1.0)[0][0]
    faded = 1.0 - math.exp(-6.0 / 3.94)
    assert turn.at(np.array([6.0]))[1] == pytest.approx(
        -0.1 * 3.94 * faded + 3.47 * LIMIT * (6.0 - 3.94 * faded), abs=1e-5
    )


def test_the_step_of_simulated_turns_follows_the_vessel(vessel: SteeredPlant) -> None:
    """A turn with the step chosen ends where one with a thirtieth of it does."""
    for name, turning in (
        ("nomoto_oceanos", TURNING),
        ("patrol_p06_linear", Turning(gain=0.3829, time=5.154, speed=7.71)),
    ):
        steered = SteeredPlant(load_vessel(name).build())
        step = turning_step(steered, turning, LIMIT)
        ends = []
        for dt in (step, step / 30.0):
            make = TurnMaker(steered, turning, dt)
            ((turn,),) = make(
                np.array([[1.5 * turning.time]]), np.array([LIMIT]), [make.straight], 1.0
            )
            track, heading = turn.along(np.zeros(1))
            ends.append([*track[0] * turning.gain * LIMIT / turning.speed, heading[0]])
        assert step > 0.1 * turning.time
        assert ends[0] == pytest.approx(ends[1], abs=2e-3)


def past(*places: tuple[float, float, Literal["starboard", "port"]]) -> tuple[BuoyConfig, ...]:
    return tuple(
        BuoyConfig(north=north, east=east, leave_to=side, radius=10) for north, east, side in places
    )


@pytest.mark.parametrize(
    "buoys",
    [
        BUOYS,
        # to and fro, with sides that need loops
        past((60, 0, "port"), (10, 25, "port"), (75, 45, "starboard"), (60, -45, "starboard")),
        # the shortest outline leads to fits that miss the last of these by six metres
        past(
            (37.41, 53.58, "port"),
            (63.62, -16.91, "port"),
            (114.34, 56.85, "port"),
            (164.22, 42.69, "starboard"),
            (187.47, 135.26, "port"),
            (167.39, 28.22, "port"),
        ),
    ],
)
def test_a_plan_leaves_every_buoy_on_its_side_outside_its_circle(
    vessel: SteeredPlant, buoys: tuple[BuoyConfig, ...]
) -> None:
    """Judged by the points of the plan alone; no part is tighter than the vessel turns."""
    planned = plan_of(vessel, buoys=buoys)
    course, radius = planned.course, planned.steady.radius
    count = int(course.length / course.step)
    track, passed = course.track[: count + 2], -1
    assert np.abs(np.diff(course.direction[:count])).max() <= 1.03 * course.step / radius
    for buoy in buoys:
        away = np.array([buoy.north, buoy.east]) - track
        distance = np.hypot(*away.T)
        assert distance.min() >= radius
        # the course may come back to a buoy as near as in its turn, on the same side
        nearest = np.flatnonzero(distance <= distance.min() + 0.01)
        near = passed = int(nearest[nearest > passed][0])
        step = track[min(near + 1, len(track) - 1)] - track[near - 1]
        on_starboard = step[0] * away[near, 1] - step[1] * away[near, 0] > 0
        assert on_starboard == (buoy.leave_to == "starboard")
    most = 1.06 if buoys is BUOYS else 1.1
    assert planned.reference < course.length <= most * planned.reference


@pytest.mark.long
def test_a_given_heading_lengthens_the_shortest_course_past_sides(vessel: SteeredPlant) -> None:
    """Along the first leg it changes nothing; away from it the vessel has to come round, pi R and
    more.
    """
    free = plan_of(vessel)
    along, radius = float(free.course.heading[0]), free.steady.radius
    onward, away = (plan_of(vessel, heading=heading) for heading in (along, along + math.pi))
    assert onward.reference == pytest.approx(free.reference, rel=2e-3)
    assert onward.course.length == pytest.approx(free.course.length, rel=0.02)
    assert away.reference > free.reference + math.pi * radius
    assert free.course.length + radius < away.course.length
    # it comes round within a full turn
    assert away.course.length < 1.05 * (free.course.length + 2.0 * math.pi * radius)


def test_circles_of_acceptance_are_entered(vessel: SteeredPlant) -> None:
    planned = plan_of(vessel, "enter", heading=0.0)
    assert planned.course.heading[0] == pytest.approx(0.0, abs=1e-6)
    inside = planned.course.track[: int(planned.course.length / planned.course.step) + 2]
    for buoy in BUOYS:
        assert np.hypot(inside[:, 0] - buoy.north, inside[:, 1] - buoy.east).min() <= 3.4
    assert planned.reference < planned.course.length <= 1.06 * planned.reference


def test_what_no_course_can_do_is_refused(vessel: SteeredPlant) -> None:
    here = tuple(BuoyConfig(north=n, east=0, leave_to="port", radius=10) for n in (0.0, 1.5))
    with pytest.raises(ConfigError, match="begins within every circle"):
        plan_of(vessel, "enter", buoys=here)
    near = BuoyConfig(north=52, east=20, leave_to="starboard", radius=10)
    with pytest.raises(ConfigError, match=r"buoy|mark"):
        plan_of(vessel, buoys=(BUOYS[0], near, BUOYS[2]))


def test_guidance_asks_for_tangent_yaw_rate_and_line_of_sight_on_a_circle() -> None:
    state = ("x", "y", "psi", "u", "v", "r")
    guidance = CourseGuidance(circle(20.0), 8.0, state)
    angle, aside = 0.7, 3.0
    # to port of a turn to starboard: outside the circle
    x = torch.tensor(
        [
            [
                (20 + aside) * math.sin(angle),
                20 - (20 + aside) * math.cos(angle),
                angle,
                3.0,
                0.0,
                0.0,
            ]
        ],
        dtype=torch.float64,
    )
    s = torch.tensor([[20 * angle - 0.5]], dtype=torch.float64)
    for _ in range(4):
        reference, s = guidance(x, 0, s)
    assert float(s) == pytest.approx(20 * angle, abs=1e-3)
    assert float(guidance.error(x, s[:, 0])[1]) == pytest.approx(-aside, abs=1e-3)
    assert float(reference[0, 0]) == pytest.approx(angle + math.atan(aside / 8.0), abs=1e-3)
    assert float(reference[0, 1]) == pytest.approx(3.0 / (20 + aside), rel=1e-3)
    assert float(reference[0, 2]) == pytest.approx(0.04)


def test_a_vessel_beside_the_course_comes_back_to_it(vessel: SteeredPlant) -> None:
    course = circle(15.0)
    steady = 3.2 / 15.0 / 3.47
    course = Course(
        course.step,
        course.track,
        course.direction,
        course.heading,
        np.full(len(course.track), steady),
        course.length,
    )
    law = HeadingPD.placed(
        vessel.state, gain=3.47, time=3.94, frequency=1.0, damping=1.0, limit=LIMIT
    )
    guidance = CourseGuidance(course, 8.0, vessel.state)
    x, w = vessel.start(torch.ones(2, dtype=torch.float64))
    x[:, vessel.column("y")] = torch.tensor([2.0, -2.0], dtype=torch.float64)
    loop = Rollout(
        vessel.model(0.05),
        ClosedLoop(TrackKeeping(law, vessel.state, limit=LIMIT, dt=0.05), guidance),
    )
    states, _, _ = loop(
        x,
        w.unsqueeze(1).expand(-1, 600, -1),
        torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64).expand(2, -1),
    )
    end = states[:, -1]
    radius = torch.hypot(end[:, vessel.column("x")], end[:, vessel.column("y")] - 15.0)
    assert radius.tolist() == pytest.approx([15.0, 15.0], abs=0.05)


def test_a_vessel_that_sways_and_rolls_follows_turns_that_join_each_other() -> None:
    patrol = SteeredPlant(load_vessel("patrol_p06_linear").build())
    turning = patrol.turning(LIMIT, 300.0, 0.1)
    wanted = BuoyCourseConfig(
        buoys=(
            BuoyConfig(north=500, east=300, leave_to="port", radius=100),
            BuoyConfig(north=1000, east=200, leave_to="starboard", radius=100),
            BuoyConfig(north=700, east=700, leave_to="port", radius=100),
        ),
        acceptance=51.5,
        lookahead=100.0,
        turning_time=200.0,
    )
    planned = plan_course(
        wanted, "enter", patrol, turning, LIMIT, smallest_turn(wanted, patrol, turning, LIMIT)
    )
    assert np.ptp(np.sign(planned.course.rudder)) == 2.0
    law = HeadingPD.placed(
        patrol.state, gain=turning.gain, time=turning.time, frequency=0.8, damping=1.0, limit=LIMIT
    )
    follower = TrackKeeping(law, patrol.state, limit=LIMIT, dt=0.1, rate=patrol.rate)
    guidance = CourseGuidance(planned.course, wanted.lookahead, patrol.state)
    x, w = patrol.start(torch.ones(1, dtype=torch.float64))
    x[:, patrol.column("psi")] = float(planned.course.heading[0])
    nominal = torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64)
    with torch.no_grad():
        states, _, _ = Rollout(patrol.model(0.1), ClosedLoop(follower, guidance))(
            x, w.unsqueeze(1).expand(-1, 2500, -1), nominal
        )
    place, aside = torch.zeros(1, 1, dtype=torch.float64), []
    for state in states[0, ::5]:
        _, place = guidance(state[None], 0, place)
        aside.append(abs(float(guidance.error(state[None], place[:, 0])[1])))
    assert float(place) >= planned.course.length
    # two of a hundred of the hull's length, where one turn joins the next
    assert max(aside) < 0.02 * 51.5


def test_a_current_that_is_planned_for_keeps_the_course_farther_off(vessel: SteeredPlant) -> None:
    planned = plan_of(vessel, current=0.3)
    for buoy in planned.buoys:
        away = planned.course.track - (buoy.north, buoy.east)
        assert np.hypot(*away.T).min() >= planned.steady.radius + 0.3 * TURNING.time

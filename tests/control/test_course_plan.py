"""Planned courses and guidance along them, against closed forms of Nomoto's model and geometry of their own."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from residnet.control.base import ClosedLoop
from residnet.control.buoys import BuoyConfig
from residnet.control.course_guidance import CourseGuidance
from residnet.control.course_plan import Course
from residnet.control.courses import BuoyCourseConfig, plan_course, report_feasibility, smallest_turn
from residnet.control.following import Following
from residnet.control.heading_pid import HeadingPID
from residnet.control.steering import SteeredPlant
from residnet.control.turning import Turning
from residnet.control.turns import make_turns, steady_turn
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
WANTED = BuoyCourseConfig(buoys=BUOYS, acceptance=3.4, lookahead=12.0)


@pytest.fixture(scope="module")
def vessel() -> SteeredPlant:
    return SteeredPlant(load_vessel("nomoto_oceanos").build())


def circle(radius: float, step: float = 0.1) -> Course:
    """A turn to starboard for ever, from the origin northwards."""
    angle = np.arange(0.0, 3.0 * math.pi, step / radius)
    track = radius * np.stack((np.sin(angle), 1.0 - np.cos(angle)), axis=-1)
    return Course(step, track, angle, angle, np.full(len(angle), 0.04), 2.5 * math.pi * radius)


def test_the_steady_turn_is_that_of_the_model(vessel: SteeredPlant) -> None:
    steady = steady_turn(vessel, LIMIT, 100.0, 0.05)
    assert steady.radius == pytest.approx(3.2 / (3.47 * LIMIT), rel=1e-3)
    assert not any(one["possible"] for one in report_feasibility(WANTED, steady))


def test_turns_take_the_time_of_full_rudder_and_counter_rudder(vessel: SteeredPlant) -> None:
    """T r_dot + r = K delta from rest to rest: K d (t1 - t2) turned, t2 = T ln(2 - exp(-t1 / T))."""
    dt = 0.02
    for turn in make_turns(vessel, TURNING, np.radians([40.0, 120.0]), np.full(2, 0.9 * LIMIT), LIMIT, dt):
        first = np.count_nonzero(turn.rudder > 0.0) * dt
        rate = 3.47 * 0.9 * LIMIT
        back = 3.94 * math.log(2.0 - math.exp(-first / 3.94))
        assert turn.angle == pytest.approx(rate * (first - back), abs=rate * dt)
        assert turn.heading[-1] == pytest.approx(turn.angle, abs=math.radians(0.85))
        assert np.hypot(*np.diff(turn.track, axis=0).T) == pytest.approx(3.2 * dt, rel=1e-3)


def test_no_part_of_a_plan_is_tighter_than_the_vessel_turns_and_buoys_stay_outside(vessel: SteeredPlant) -> None:
    steady = smallest_turn(WANTED, vessel, LIMIT)
    planned = plan_course(WANTED, "sides", vessel, TURNING, LIMIT, steady)
    inside = planned.course.track[: int(planned.course.length / planned.course.step)]
    heading = planned.course.direction[: len(inside)]
    assert np.abs(np.diff(heading)).max() <= 1.03 * planned.course.step / steady.radius
    for buoy in planned.buoys:
        assert np.hypot(inside[:, 0] - buoy.north, inside[:, 1] - buoy.east).min() >= steady.radius
    assert planned.floor <= planned.course.length <= 1.06 * planned.floor


def test_circles_of_acceptance_are_entered(vessel: SteeredPlant) -> None:
    steady = smallest_turn(WANTED, vessel, LIMIT)
    planned = plan_course(WANTED.model_copy(update={"heading": 0.0}), "enter", vessel, TURNING, LIMIT, steady)
    assert planned.course.heading[0] == pytest.approx(0.0, abs=1e-6)
    inside = planned.course.track[: int(planned.course.length / planned.course.step) + 2]
    for buoy in BUOYS:
        assert np.hypot(inside[:, 0] - buoy.north, inside[:, 1] - buoy.east).min() <= 3.4
    assert planned.course.length <= 1.06 * planned.floor


def test_buoys_too_close_for_the_vessel_are_refused(vessel: SteeredPlant) -> None:
    near = WANTED.model_copy(update={"buoys": (BUOYS[0], BuoyConfig(north=52, east=20, leave_to="starboard", radius=10), BUOYS[2])})
    with pytest.raises(ConfigError, match=r"buoy|mark"):
        plan_course(near, "sides", vessel, TURNING, LIMIT, smallest_turn(near, vessel, LIMIT))


def test_guidance_asks_for_tangent_yaw_rate_and_line_of_sight_on_a_circle() -> None:
    state = ("x", "y", "psi", "u", "v", "r")
    guidance = CourseGuidance(circle(20.0), 8.0, state)
    angle, aside = 0.7, 3.0
    # to port of a turn to starboard: outside the circle
    x = torch.tensor([[(20 + aside) * math.sin(angle), 20 - (20 + aside) * math.cos(angle), angle, 3.0, 0.0, 0.0]], dtype=torch.float64)
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
    course = Course(course.step, course.track, course.direction, course.heading, np.full(len(course.track), steady), course.length)
    law = HeadingPID.placed(vessel.state, gain=3.47, time=3.94, frequency=1.0, damping=1.0, limit=LIMIT)
    guidance = CourseGuidance(course, 8.0, vessel.state)
    x, w = vessel.start(torch.ones(2, dtype=torch.float64))
    x[:, vessel.column("y")] = torch.tensor([2.0, -2.0], dtype=torch.float64)
    loop = Rollout(vessel.model(0.05), ClosedLoop(Following(law, vessel.state, limit=LIMIT, dt=0.05), guidance))
    states, _, _ = loop(x, w.unsqueeze(1).expand(-1, 600, -1), torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64).expand(2, -1))
    end = states[:, -1]
    radius = torch.hypot(end[:, vessel.column("x")], end[:, vessel.column("y")] - 15.0)
    assert radius.tolist() == pytest.approx([15.0, 15.0], abs=0.05)

"""Guidance along legs and courses: geometry of a leg, circle of acceptance, arrival; wheel-over
against turns that SciPy integrates; integral action against a steady current in closed form.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from pydantic import ValidationError
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from torch import Tensor

from residnet.autopilot.base import ClosedLoop, Policy, Reference
from residnet.autopilot.courses.course_plan import Course
from residnet.autopilot.guidance import (
    CourseGuidance,
    DriftEstimate,
    EnclosureConfig,
    IntegralLookAheadConfig,
    LineOfSight,
    LookAheadConfig,
    LookAheadLineOfSight,
    TrackKeeping,
    WaypointGuidance,
    WheelOver,
)
from residnet.autopilot.heading.classical import HeadingPD
from residnet.autopilot.heading.turning import NomotoModel
from residnet.autopilot.heading.vessels import SteeredPlant
from residnet.core.errors import ConfigError
from residnet.dynamics.simulated import InAmbientCurrent
from residnet.engine.rollout import Rollout
from residnet.physics.vessel import load_vessel

STATE = ("x", "y", "psi", "u", "v", "r")
DT = 0.1
LIMIT = math.radians(5)
SPEED = 3.2
LEG = 0.7
TURNING = NomotoModel(3.47, 3.94, SPEED)
VESSEL = SteeredPlant(load_vessel("nomoto_oceanos").build())
LAW = HeadingPD.from_pole_placement(
    VESSEL.state, gain=3.47, time=3.94, frequency=2.0, damping=1.0, limit=LIMIT
)
FOLLOWER = TrackKeeping(LAW, VESSEL.state, limit=LIMIT, dt=DT)


def d(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def at(*places: tuple[float, float]) -> Tensor:
    x = torch.zeros(len(places), 6, dtype=torch.float64)
    x[:, :2] = torch.tensor(places, dtype=torch.float64)
    return x


def aside(turn: float, along: float, across: float) -> tuple[float, float]:
    """A place so far along a leg in that direction from the origin, and to starboard of it."""
    c, s = math.cos(turn), math.sin(turn)
    return along * c - across * s, along * s + across * c


def apart(one: Tensor, other: float) -> float:
    return abs(math.remainder(float(one) - other, 2 * math.pi))


@pytest.mark.parametrize("turn", [0.0, 1.0, 2.5, -2.0])
def test_it_steers_for_a_point_ahead_on_the_leg(turn: float) -> None:
    """A leg of any direction; 3 m to starboard of it with 4 m look-ahead: atan(3/4) to port of the
    leg's direction.
    """
    sight = LookAheadConfig(distance=4.0).build(0.1)
    guidance = WaypointGuidance([aside(turn, 100.0, 0.0)], 5.0, sight, STATE)
    s = guidance.initial_state(at((0.0, 0.0)))
    for across in (3.0, 0.0, -3.0):
        x = at(aside(turn, 20.0, across))
        heading, s = guidance(x, 0, s)
        assert apart(heading, turn - math.atan(across / 4)) < 1e-12
        _, ahead, error = guidance.leg_geometry(x, s[:, 0].long(), s)
        assert float(ahead) == pytest.approx(80.0)
        assert float(error) == pytest.approx(across, abs=1e-12)


@pytest.mark.parametrize("turn", [1.0, -2.0])
def test_it_steers_for_where_a_circle_about_the_vessel_meets_the_leg(turn: float) -> None:
    """The point is found here from the quadratic equation of a circle and a line, its root further
    along the leg.
    """
    radius = 5.0
    leg = np.array(aside(turn, 100.0, 0.0))
    guidance = WaypointGuidance([tuple(leg)], 2.0, EnclosureConfig(radius=radius).build(0.1), STATE)
    s = guidance.initial_state(at((0.0, 0.0)))
    for along, across in ((20.0, 3.0), (21.0, 0.0), (22.0, -3.0), (23.0, 4.9), (24.0, -4.9)):
        vessel = np.array(aside(turn, along, across))
        share = max(np.roots([leg @ leg, -2 * leg @ vessel, vessel @ vessel - radius**2]).real)
        north, east = share * leg - vessel
        heading, s = guidance(at((vessel[0], vessel[1])), 0, s)
        assert apart(heading, math.atan2(east, north)) < 1e-9
    # out of reach: straight for the leg
    for across in (8.0, -8.0):
        heading, s = guidance(at(aside(turn, 30.0, across)), 0, s)
        assert apart(heading, turn - math.copysign(math.pi / 2, across)) < 1e-9


def test_legs_change_in_the_circle_and_behind_the_point() -> None:
    sight = LookAheadConfig(distance=5.0).build(0.1)
    guidance = WaypointGuidance([(10.0, 0.0), (10.0, 20.0)], 2.0, sight, STATE)
    x = at((7.9, 0.0), (8.1, 0.0), (10.1, 9.0))
    s = guidance.initial_state(at(*[(0.0, 0.0)] * 3))
    heading, s = guidance(x, 0, s)
    assert s[:, 0].tolist() == [0, 1, 1], "before the circle, inside, and past the point beside it"
    # now along the second leg, to the east, with the vessel 1.9 m to the south of it
    assert float(heading[1]) == pytest.approx(math.pi / 2 - math.atan(1.9 / 5))
    assert guidance.is_finished(x, 0, s).tolist() == [False, False, False]
    # arrived once, arrived for good
    for places in (((7.9, 0.0), (10.0, 18.5), (10.0, 25.0)), ((7.9, 0.0), (0.0, 0.0), (0.0, 0.0))):
        _, s = guidance(at(*places), 1, s)
        assert guidance.is_finished(x, 1, s).tolist() == [False, True, True]


def test_nonsense_is_refused() -> None:
    for points, acceptance in (([], 1.0), ([(1.0, 1.0)], 0.0)):
        with pytest.raises(ConfigError, match="way-points"):
            WaypointGuidance(points, acceptance, LookAheadConfig(distance=1.0).build(0.1), STATE)
    for config, key in (
        (LookAheadConfig, "distance"),
        (EnclosureConfig, "radius"),
        (IntegralLookAheadConfig, "gain"),
    ):
        with pytest.raises(ValidationError, match="greater than 0"):
            config.model_validate({"distance": 1.0, "gain": 1.0, key: 0.0})
    with pytest.raises(ConfigError, match="integral line of sight"):
        DriftEstimate(12.0, 0.0, 0.1)


@cache
def turned(change: float) -> np.ndarray:
    """Poses [N, 3] of the turn by full rudder and counter-rudder that ends without yaw at this
    heading.
    """

    def rate(_: float, z: np.ndarray, rudder: float) -> list[float]:
        moved = TURNING.speed * math.cos(z[2]), TURNING.speed * math.sin(z[2])
        return [*moved, z[3], (TURNING.gain * rudder - z[3]) / TURNING.time]

    def stopped(_: float, z: np.ndarray, *rudder: float) -> float:
        return float(z[3])

    stopped.terminal = True  # type: ignore[attr-defined]
    stopped.direction = -1  # type: ignore[attr-defined]
    exact: dict[str, Any] = {"rtol": 1e-8, "atol": 1e-8, "max_step": 0.1}

    def flown(held: float) -> np.ndarray:
        over = solve_ivp(rate, (0.0, held), np.zeros(4), args=(LIMIT,), **exact)
        last = over.y[:, -1]
        back = (-LIMIT,)
        after = solve_ivp(rate, (0.0, 20.0), last, args=back, events=stopped, **exact)
        return np.concatenate((over.y.T, after.y.T))

    return flown(brentq(lambda held: flown(held)[-1, 2] - change, 0.1, 20.0, xtol=1e-5))


@pytest.mark.parametrize("degrees", [10.0, 42.0])
def test_a_gentle_turn_begins_where_it_ends_on_the_next_leg(degrees: float) -> None:
    angle = math.radians(degrees)
    end = turned(angle)[-1]
    corner = end[0] - end[1] / math.tan(angle)
    found = WheelOver(TURNING, LIMIT, 10.0)(d(angle, -angle))
    assert found.tolist() == pytest.approx([corner, corner], rel=5e-3)


@pytest.mark.parametrize("share", [0.5, 0.9])
def test_a_sharp_turn_still_reaches_into_the_circle(share: float) -> None:
    angle = math.radians(140.0)
    distance = float(WheelOver(TURNING, LIMIT, 3.4, share=share)(d(angle)))
    track = turned(angle)[:, :2]
    nearest = np.hypot(track[:, 0] - distance, track[:, 1]).min()
    assert nearest == pytest.approx(share * 3.4, rel=0.02)


def test_legs_change_at_the_wheel_over_on_the_leg_but_in_the_circle_beside_it() -> None:
    over = WheelOver(TURNING, LIMIT, 3.4)
    # straight on needs none and a slow rudder needs half its way more
    quick = over(d(0.0, 1.0))
    slow = WheelOver(TURNING, LIMIT, 3.4, rate=LIMIT / 2.0)(d(0.0, 1.0))
    assert float(quick[0]) == 0.0
    assert (slow - quick).tolist() == pytest.approx([3.2, 3.2])
    guidance = WaypointGuidance(
        [(100.0, 0.0), (100.0, 100.0)], 3.4, LookAheadLineOfSight(10.0), STATE, over
    )
    before = float(over(d(0.5 * math.pi)))
    assert before > 3.4
    # short of it, there, there but aside of the leg, in the circle; the last way-point, which has
    # no wheel-over; and there, on the leg, but at a crab angle
    short = 99.9 - before
    there = 100.1 - before
    x = at((short, 0.0), (there, 0.0), (there, 3.0), (97.0, 0.0), (100.0, 96.5), (there, 0.0))
    x[5, 2] = 0.15
    s = torch.zeros(6, 3, dtype=torch.float64)
    s[4, 0] = 1.0
    compiled = torch.jit.script(guidance)(x, 0, s)[1]
    _, s = guidance(x, 0, s)
    assert torch.equal(compiled, s)
    assert s[:, 0].tolist() == [0.0, 1.0, 0.0, 1.0, 1.0, 0.0]


def circle(radius: float, rudder: float, step: float = 0.1) -> Course:
    """A turn to starboard for ever, from the origin northwards."""
    angle = np.arange(0.0, 3.0 * math.pi, step / radius)
    track = radius * np.stack((np.sin(angle), 1.0 - np.cos(angle)), axis=-1)
    held = np.full(len(angle), rudder)
    return Course(step, track, angle, angle, held, 2.5 * math.pi * radius)


def test_a_course_asks_for_tangent_yaw_rate_and_line_of_sight_on_a_circle() -> None:
    guidance = CourseGuidance(circle(20.0, 0.04), 8.0, STATE)
    angle = 0.7
    across = 3.0
    # to port of a turn to starboard: outside the circle
    x = torch.zeros(1, 6, dtype=torch.float64)
    away = 20 + across
    x[0, :4] = d(away * math.sin(angle), 20 - away * math.cos(angle), angle, 3.0)
    s = d(20 * angle - 0.5)[None]
    for _ in range(4):
        reference, s = guidance(x, 0, s)
    assert float(s) == pytest.approx(20 * angle, abs=1e-3)
    assert float(guidance.track_error(x, s[:, 0])[1]) == pytest.approx(-across, abs=1e-3)
    asked = [angle + math.atan(across / 8.0), 3.0 / away, 0.04]
    assert reference[0, :3].tolist() == pytest.approx(asked, rel=1e-3)


END = (3000.0 * math.cos(LEG), 3000.0 * math.sin(LEG))


def along(drift: DriftEstimate | None) -> CourseGuidance:
    """Straight in the direction of the leg."""
    way = np.arange(0.0, 3000.0, 1.0)
    track = np.stack((way * math.cos(LEG), way * math.sin(LEG)), axis=-1)
    held = np.full(len(way), LEG)
    return CourseGuidance(
        Course(1.0, track, held, held, 0.0 * way, 2900.0), 12.0, VESSEL.state, drift
    )


def legs(sight: LineOfSight) -> WaypointGuidance:
    return WaypointGuidance([END], 5.0, sight, VESSEL.state)


def left(reference: Reference, policy: Policy) -> float:
    """Cross-track error after a minute in a current of 0.8 m/s across the leg to starboard."""
    x, w = VESSEL.straight_course(torch.ones(1, dtype=torch.float64))
    x[:, 2] = LEG
    memory = torch.cat((d(*aside(LEG, 0.0, 0.8)), d(1.0, 1.0, 0.0)))[None]
    model = InAmbientCurrent(VESSEL.model(DT), VESSEL.state)
    with torch.no_grad():
        loop = Rollout(model, ClosedLoop(policy, reference))
        states, _, _ = loop(x, w.unsqueeze(1).expand(-1, round(60.0 / DT), -1), memory)
    x, y = states[0, -1, :2].tolist()
    return float(y * math.cos(LEG) - x * math.sin(LEG))


@pytest.mark.long
def test_without_integral_action_the_error_that_makes_the_crab_angle_stays() -> None:
    """Look-ahead x tan(crab angle) on legs; along a plan more, since the law also damps a return
    that the current undoes.
    """
    crab = math.asin(0.8 / SPEED)

    def balance(e: float) -> float:
        damped = LAW.kd * 0.8 / 12.0 / (1.0 + (e / 12.0) ** 2)
        return float(LAW.kp * (crab - math.atan(e / 12.0)) + damped)

    error = left(legs(LookAheadLineOfSight(12.0)), LAW)
    assert error == pytest.approx(12.0 * math.tan(crab), rel=1e-3)
    assert left(along(None), FOLLOWER) == pytest.approx(brentq(balance, 0.0, 12.0), rel=1e-3)
    # with it none stays
    drift = DriftEstimate(12.0, 0.8, DT)
    assert abs(left(legs(LookAheadLineOfSight(12.0, drift)), LAW)) < 0.1
    assert abs(left(along(drift), FOLLOWER)) < 0.1


def test_a_quarter_of_the_speed_returns_to_the_leg_as_two_equal_poles_do() -> None:
    """e(t) = e0 (1 - a t) exp(-a t), a = U / (2 look-ahead), for small errors of a vessel that
    turns at once.
    """
    drift = DriftEstimate(12.0, 0.8, 0.01)
    a = SPEED / 24.0
    sight = LookAheadLineOfSight(12.0, drift)
    assert sight.n_state == 2
    error = d(0.1)
    s = d(0.0, 0.0)[None]
    direction = d(LEG)
    for _ in range(1000):
        angle, s = sight(error, direction, s)
        error = error + 0.01 * SPEED * torch.sin(angle)
    assert float(error) == pytest.approx(0.1 * (1 - 10.0 * a) * math.exp(-10.0 * a), abs=1e-4)
    assert float(drift.along_component(direction, s)) == pytest.approx(0.0, abs=1e-12)


def test_what_one_leg_has_taught_is_known_on_the_next() -> None:
    """Set to starboard of a leg to the north is ahead on one to the east, and to port on one to the
    south.
    """
    drift = DriftEstimate(10.0, 0.5, 0.1)
    s = d(0.0, 0.0)[None]
    north = d(0.0)
    for _ in range(20):
        s = drift(d(1.0), north, s)
    learnt = float(drift.cross_component(north, s))
    assert learnt > 0
    assert float(drift.along_component(north + 0.5 * math.pi, s)) == pytest.approx(learnt)
    assert float(drift.cross_component(north + math.pi, s)) == pytest.approx(-learnt)
    # it stays at most at 45 deg
    for _ in range(1000):
        s = drift(d(5.0), north, s)
    assert float(drift.cross_component(north, s)) == pytest.approx(1.0)

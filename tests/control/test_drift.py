"""Integral action against a steady current: crab angle and cross-track error in equilibrium, in
closed form, behind a real controller.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.optimize import brentq

from residnet.control.base import ClosedLoop, Policy, Reference
from residnet.control.courses.course_plan import Course
from residnet.control.guidance import (
    CourseGuidance,
    DriftEstimate,
    LineOfSight,
    LookAhead,
    TrackKeeping,
    WaypointGuidance,
)
from residnet.control.heading.classical import HeadingPD
from residnet.control.heading.vessels import SteeredPlant
from residnet.core.errors import ConfigError
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.simulated import InAmbientCurrent
from residnet.physics.vessel import load_vessel

DT, LIMIT, SPEED, LEG = 0.1, math.radians(5), 3.2, 0.7
VESSEL = SteeredPlant(load_vessel("nomoto_oceanos").build())
LAW = HeadingPD.placed(VESSEL.state, gain=3.47, time=3.94, frequency=2.0, damping=1.0, limit=LIMIT)
END = (3000.0 * math.cos(LEG), 3000.0 * math.sin(LEG))


def along(drift: DriftEstimate | None) -> CourseGuidance:
    """Straight in the direction of the leg."""
    way = np.arange(0.0, 3000.0, 1.0)
    ones = np.ones(len(way))
    track = np.stack((way * math.cos(LEG), way * math.sin(LEG)), axis=-1)
    return CourseGuidance(
        Course(1.0, track, LEG * ones, LEG * ones, 0.0 * ones, 2900.0), 12.0, VESSEL.state, drift
    )


def legs(sight: LineOfSight) -> WaypointGuidance:
    return WaypointGuidance([END], 5.0, sight, VESSEL.state)


def sailed(
    reference: Reference, policy: Policy, across: list[float], seconds: float
) -> tuple[np.ndarray, np.ndarray]:
    """Heading less the leg's direction and cross-track error [B] at the end, in currents [B] across
    the leg to starboard.
    """
    x, w = VESSEL.start(torch.ones(len(across), dtype=torch.float64))
    x[:, 2] = LEG
    current = torch.tensor(
        [[-speed * math.sin(LEG), speed * math.cos(LEG)] for speed in across], dtype=torch.float64
    )
    nominal = torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64).expand(len(across), -1)
    with torch.no_grad():
        model = InAmbientCurrent(VESSEL.model(DT), VESSEL.state)
        loop = Rollout(model, ClosedLoop(policy, reference))
        states, _, _ = loop(
            x,
            w.unsqueeze(1).expand(-1, round(seconds / DT), -1),
            torch.cat((current, nominal), dim=1),
        )
    end = states[:, -1].numpy()
    return end[:, 2] - LEG, end[:, 1] * math.cos(LEG) - end[:, 0] * math.sin(LEG)


FOLLOWER = TrackKeeping(LAW, VESSEL.state, limit=LIMIT, dt=DT)
CROSS = [0.8, -1.6, 0.0]


@pytest.mark.long
def test_a_leg_is_kept_at_the_crab_angle_of_the_current() -> None:
    for reference, policy in (
        (legs(LookAhead(12.0, DriftEstimate(12.0, 0.8, DT))), LAW),
        (along(DriftEstimate(12.0, 0.8, DT)), FOLLOWER),
    ):
        heading, error = sailed(reference, policy, CROSS, 120.0)
        assert heading == pytest.approx([-math.asin(speed / SPEED) for speed in CROSS], abs=1e-3)
        assert error == pytest.approx(0.0, abs=0.02)
        # in water at rest nothing changes
        assert heading[2] == pytest.approx(0.0, abs=1e-12)
        assert error[2] == pytest.approx(0.0, abs=1e-9)


def test_without_integral_action_the_error_that_makes_the_crab_angle_stays() -> None:
    """Look-ahead x tan(crab angle) on legs; along a plan more, since the law also damps a return
    that the current undoes.
    """
    crab = math.asin(0.8 / SPEED)
    _, error = sailed(legs(LookAhead(12.0)), LAW, [0.8], 60.0)
    assert error[0] == pytest.approx(12.0 * math.tan(crab), rel=1e-3)
    more = brentq(
        lambda e: (
            LAW.kp * (crab - math.atan(e / 12.0)) + LAW.kd * 0.8 / 12.0 / (1.0 + (e / 12.0) ** 2)
        ),
        0.0,
        12.0,
    )
    _, error = sailed(along(None), FOLLOWER, [0.8], 60.0)
    assert error[0] == pytest.approx(more, rel=1e-3)


def test_a_quarter_of_the_speed_returns_to_the_leg_as_two_equal_poles_do() -> None:
    """e(t) = e0 (1 - a t) exp(-a t), a = U / (2 look-ahead), for small errors of a vessel that
    turns at once.
    """
    drift, a = DriftEstimate(12.0, 0.8, 0.01), SPEED / 24.0
    sight = LookAhead(12.0, drift)
    assert sight.n_state == 2
    error, s, direction = (
        torch.tensor([0.1], dtype=torch.float64),
        torch.zeros(1, 2, dtype=torch.float64),
        torch.tensor([LEG], dtype=torch.float64),
    )
    for _ in range(1000):
        angle, s = sight(error, direction, s)
        error = error + 0.01 * SPEED * torch.sin(angle)
    assert float(error) == pytest.approx(0.1 * (1 - 10.0 * a) * math.exp(-10.0 * a), abs=1e-4)
    assert float(drift.along(direction, s)) == pytest.approx(0.0, abs=1e-12)


def test_what_one_leg_has_taught_is_known_on_the_next() -> None:
    """Set to starboard of a leg to the north is ahead on one to the east, and to port on one to the
    south.
    """
    drift, s = DriftEstimate(10.0, 0.5, 0.1), torch.zeros(1, 2, dtype=torch.float64)
    north = torch.zeros(1, dtype=torch.float64)
    for _ in range(20):
        s = drift(torch.ones(1, dtype=torch.float64), north, s)
    learnt = float(drift.across(north, s))
    assert learnt > 0
    assert float(drift.along(north + 0.5 * math.pi, s)) == pytest.approx(learnt)
    assert float(drift.across(north + math.pi, s)) == pytest.approx(-learnt)
    # it stays at most at 45 deg
    for _ in range(3000):
        s = drift(torch.full((1,), 5.0, dtype=torch.float64), north, s)
    assert float(drift.across(north, s)) == pytest.approx(1.0)


def test_guidance_with_integral_action_compiles() -> None:
    for module in (
        along(DriftEstimate(12.0, 0.8, DT)),
        legs(LookAhead(12.0, DriftEstimate(12.0, 0.8, DT))),
    ):
        x, _ = VESSEL.start(torch.ones(1, dtype=torch.float64))
        s = module.initial_state(x)
        for mine, theirs in zip(module(x, 0, s), torch.jit.script(module)(x, 0, s), strict=True):
            assert torch.equal(mine, theirs)


def test_nonsense_is_refused() -> None:
    with pytest.raises(ConfigError, match="integral line of sight"):
        DriftEstimate(12.0, 0.0, 0.1)

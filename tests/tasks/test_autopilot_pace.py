"""A run whose times are as long as the vessel needs: least times, and what is multiplied."""

from __future__ import annotations

import math
from typing import Any

import pytest
from pydantic import ValidationError

from residnet.control.heading.turning import Turning
from residnet.tasks.autopilot import AutopilotConfig, least_time

CONFIG: dict[str, Any] = {
    "task": "autopilot",
    "name": "slow",
    "vessel": "nomoto_ship",
    "rudder": "20 deg",
    "test": {"duration": "14 s"},
    "conditions": {"beyond": {"late": {"delay": ["0.6 s", "0.6 s"]}}},
    "policies": {"learned": {"start": "ptos"}},
    "peers": {"ptos": {"kind": "ptos"}},
}


def test_the_least_time_is_that_of_two_pulses() -> None:
    # without damping: half the way at full acceleration, half at full braking
    turning = Turning(1e4, 1e6, 1.0)
    acceleration = turning.gain * 0.1 / turning.time
    two = 2.0 * math.sqrt(math.radians(30.0) / acceleration)
    assert least_time(turning, 0.1, None) == pytest.approx(two, rel=1e-3)
    # at once at its speed: the angle over the yaw rate
    quick = Turning(1.0, 1e-4, 1.0)
    assert least_time(quick, 0.1, None) == pytest.approx(math.radians(30.0) / 0.1, rel=1e-3)
    assert least_time(quick, 0.1, 0.05) == pytest.approx(math.radians(30.0) / 0.1 + 4.0, rel=1e-3)


def test_times_follow_the_pace_and_delays_do_not() -> None:
    slow = AutopilotConfig.model_validate(CONFIG | {"pace": 8.0}).paced()
    assert slow.conditions is not None
    assert (slow.test.duration, slow.test.dt) == (112.0, 0.16)
    for conditions in (slow.conditions.stated, slow.conditions.beyond["late"]):
        assert (conditions.duration, conditions.dt, conditions.hold) == (112.0, 0.16, 40.0)
        assert conditions.overshoot_weight == 4.0
    assert slow.conditions.stated.delay == (0.0, 0.4)
    assert slow.policies["learned"].training.dt == 0.32
    assert slow.paced() == slow


def test_the_pace_of_a_vessel_is_measured() -> None:
    slow = AutopilotConfig.model_validate(CONFIG | {"pace": "vessel"}).paced()
    assert slow.test.duration == pytest.approx(14.0 * 8.7, rel=0.05)


def test_a_pace_belongs_to_conditions() -> None:
    without = CONFIG | {"pace": 2.0, "conditions": None, "policies": {}, "peers": {}}
    without |= {"predictive": {"document": {"horizon": 2.0}}}
    with pytest.raises(ValidationError, match="pace: give 'conditions'"):
        AutopilotConfig.model_validate(without)

"""Steering gears identified from commands and angles of known gears."""

from __future__ import annotations

import math

import numpy as np
import pytest

from residnet.core.errors import FitError
from residnet.core.log import Log
from residnet.physics.actuators.steering_gear import (
    estimate_rudder_rate,
    identify_steering_gear,
    simulate_gear,
)

DT = 0.1


def zigzag_log(rate: float, lag: float, delay: float, *, noise: float = 0.05) -> Log:
    """A rudder that is ordered between 10 deg and -10 deg, and to 20 deg, with noise in deg."""
    t = np.arange(0.0, 120.0, DT)
    command = np.radians(np.select([t < 5, (t // 13) % 2 == 0], [0.0, 10.0], -10.0))
    command[t > 90.0] = math.radians(20.0)
    generator = np.random.default_rng(1)
    angle = simulate_gear(command, 0.0, DT, math.radians(rate), lag, delay)
    angle += np.radians(noise) * generator.standard_normal(len(t))
    return Log("zigzag", t, {"cmd_delta": command, "delta": angle})


@pytest.mark.parametrize(
    ("rate", "lag", "delay"), [(8.0, 0.8, 0.3), (5.0, 0.0, 0.0), (200.0, 1.5, 0.0)]
)
def test_rate_lag_and_delay_lie_in_their_intervals(rate: float, lag: float, delay: float) -> None:
    gear = identify_steering_gear([zigzag_log(rate, lag, delay)], "cmd_delta", "delta")
    if rate < 100.0:
        assert gear.rate is not None
        assert gear.rate.ci95 is not None
        assert math.degrees(gear.rate.value) == pytest.approx(rate, rel=0.03)
    if lag == 0.0:
        assert gear.lag is None or gear.lag.value < DT
    else:
        assert gear.lag is not None
        assert gear.lag.value == pytest.approx(lag, abs=0.05)
    if delay == 0.0:
        assert gear.delay is None or gear.delay.value < DT
    else:
        assert gear.delay is not None
        assert gear.delay.value == pytest.approx(delay, abs=0.5 * DT)
    assert gear.rms == pytest.approx(math.radians(0.05), rel=0.3)


def test_the_rate_follows_from_the_angle_alone() -> None:
    gear = estimate_rudder_rate([zigzag_log(8.0, 0.0, 0.0)], "delta")
    assert gear.rate is not None
    assert math.degrees(gear.rate.value) == pytest.approx(8.0, rel=0.05)
    assert gear.n_movements >= 8
    assert "deg/s" in gear.describe()


def test_a_rudder_that_does_not_move_is_refused() -> None:
    t = np.arange(0.0, 60.0, DT)
    still = Log("still", t, {"cmd_delta": 0.0 * t, "delta": 0.0 * t})
    with pytest.raises(FitError, match="needs logs whose rudder moves by 5 deg"):
        identify_steering_gear([still], "cmd_delta", "delta")
    with pytest.raises(FitError, match="declare the rate under"):
        estimate_rudder_rate([still], "delta")

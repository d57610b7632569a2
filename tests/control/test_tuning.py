"""Tuning of linear heading controllers, against the Riccati equation, the single controller and the
limits that it is tuned under.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.linalg import solve_continuous_are

from residnet.control.heading.controllers import (
    LinearRows,
    LqrConfig,
    PdConfig,
    PidConfig,
    Steering,
)
from residnet.control.heading.steering import SteeredPlant, fly
from residnet.control.heading.tuning import TuningTask, tune
from residnet.control.heading.turning import Turning
from residnet.core.errors import FitError
from residnet.physics.vessel import load_vessel

DEG = math.pi / 180
VESSEL = SteeredPlant(load_vessel("nomoto_oceanos").build())
STEERING = Steering(VESSEL, Turning(3.47, 3.94, 3.2), 5 * DEG, 0.05)
SPREAD = torch.tensor([[1.0, 1.0, 0.0], [0.8, 1.2, 0.0], [1.2, 0.8, 0.0]], dtype=torch.float64)


def task(overshoot: float = 0.1 * DEG) -> TuningTask:
    return TuningTask(30 * DEG, SPREAD, overshoot, DEG, 10.0, DEG, 0.2 * DEG, 60.0)


@pytest.mark.parametrize(("heading", "rate"), [(4.0, 0.5), (40.0, 3.0)])
def test_lqr_gains_solve_the_riccati_equation(heading: float, rate: float) -> None:
    gain, time = 3.47, 3.94
    a, b = np.array([[0.0, -1.0], [0.0, -1.0 / time]]), np.array([[0.0], [gain / time]])
    p = solve_continuous_are(a, b, np.diag([heading, rate * time**2]), np.eye(1))
    expected = (-b.T @ p)[0]
    weights = {"heading_weight": torch.tensor(heading), "rate_weight": torch.tensor(rate)}
    kp, kd, ki = LqrConfig().gains(weights, STEERING.turning)
    assert float(kp) == pytest.approx(expected[0], rel=1e-5)
    assert float(kd) == pytest.approx(-expected[1], rel=1e-5)
    assert float(ki) == 0.0


def test_a_row_flies_as_the_controller_itself() -> None:
    config = PidConfig(kp=4.0, damping_time=1.0, integral_time=10.0)
    heading, biased = torch.tensor([0.4]), torch.tensor([[1.0, 1.0, 0.01]])
    gains = tuple(torch.tensor([value], dtype=torch.float64) for value in (4.0, 4.0, 0.4))
    mine = fly(
        VESSEL,
        LinearRows(STEERING, (gains[0], gains[1], gains[2])),
        heading,
        biased,
        dt=0.05,
        duration=30.0,
    )
    theirs = fly(VESSEL, config.build(STEERING), heading, biased, dt=0.05, duration=30.0)
    assert torch.allclose(mine.states, theirs.states, atol=1e-12)


def test_tuned_gains_keep_the_limit_and_are_the_fastest_of_a_grid() -> None:
    tuned = tune(PdConfig(), STEERING, task(), points=64, rounds=3)
    built = PdConfig.model_validate(tuned.parameters).build(STEERING)
    flights = fly(VESSEL, built, torch.full((3,), 30 * DEG), SPREAD, dt=0.05, duration=10.0)
    assert float(flights.overshoot().max()) <= 0.1 * DEG
    assert float(flights.settled(DEG).max()) == pytest.approx(tuned.settling)
    for kp in (2.0, 4.0, 8.0):
        for damping in (0.6, 0.9, 1.2, 1.6):
            other = fly(
                VESSEL,
                PdConfig(kp=kp, damping_time=damping).build(STEERING),
                torch.full((3,), 30 * DEG),
                SPREAD,
                dt=0.05,
                duration=10.0,
            )
            assert (
                float(other.overshoot().max()) > 0.1 * DEG
                or float(other.settled(DEG).max()) >= tuned.settling - 1e-9
            )


def test_integral_action_is_tuned_to_take_a_bias_away() -> None:
    tuned = tune(PidConfig(kp=4.0), STEERING, task(), points=64, rounds=2)
    built = PidConfig.model_validate(tuned.parameters).build(STEERING)
    flights = fly(
        VESSEL,
        built,
        torch.tensor([30 * DEG]),
        torch.tensor([[1.0, 1.0, DEG]]),
        dt=0.05,
        duration=60.0,
    )
    assert abs(float(flights.error[0, -1])) <= 0.2 * DEG


def test_an_impossible_limit_is_said() -> None:
    with pytest.raises(FitError, match="overshoot"):
        tune(PdConfig(damping_time=0.2), STEERING, task(1e-9), points=16, rounds=2)

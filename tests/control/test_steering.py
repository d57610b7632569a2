"""Flights and what is read from them; the time-optimal floor of a rudder of finite rate."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.optimize import linprog

from residnet.control import Policy
from residnet.control.heading.classical import RatedBangBangHeading
from residnet.control.heading.controllers import BangBangConfig, Steering
from residnet.control.heading.vessels import Flights, SteeredPlant, fly
from residnet.physics.vessel import load_vessel

DEG = math.pi / 180
GAIN, TIME = 3.47, 3.94
VESSEL = SteeredPlant(load_vessel("nomoto_oceanos_rate10").build())


def made(error: list[list[float]], dt: float = 0.5) -> Flights:
    heading = torch.zeros(len(error), dtype=torch.float64)
    states = -torch.tensor(error, dtype=torch.float64).unsqueeze(-1)
    return Flights(
        states,
        torch.full((len(error), len(error[0]) - 1, 1), 0.2, dtype=torch.float64),
        heading,
        dt,
        ("psi",),
    )


def test_settling_is_the_last_entry_between_samples() -> None:
    flights = made(
        [
            [3.0, 1.5, 0.5, 0.2, 0.1],
            [3.0, 0.5, -1.5, -0.5, 0.0],
            [0.5, 0.4, 0.3, 0.2, 0.1],
            [3.0, 2.0, 2.0, 2.0, 1.5],
        ]
    )
    assert flights.settled(1.0).tolist() == pytest.approx([0.75, 1.25, 0.0, 2.0])


def test_a_flight_that_breaks_off_never_settles() -> None:
    assert float(made([[3.0, 0.5, math.nan, math.nan]]).settled(1.0)[0]) == 1.5


def test_effort_and_roots_of_mean_squares() -> None:
    flights = made([[3.0, 1.0, -1.0, 1.0, -1.0]])
    assert float(flights.effort()[0]) == pytest.approx(4 * 0.04 * 0.5)
    assert float(flights.rms("psi", 0.5)[0]) == pytest.approx(1.0)
    assert float(flights.rudder_rms()[0]) == pytest.approx(0.2)


def shortest_to_rest(change: float, rate: float, limit: float, dt: float = 0.1) -> float:
    """Least time from rest to rest with the rudder amidships at both ends: linear programmes over
    rudder sequences, halving the horizon.
    """

    def possible(steps: int) -> bool:
        # delta_k piecewise linear between samples; r and psi at the end are linear in it (trapezoid
        # over fine cells)
        lag = np.array([(steps - k) * dt for k in range(steps + 1)])
        to_r = GAIN / TIME * np.exp(-lag / TIME) * dt
        to_psi = GAIN * (1 - np.exp(-lag / TIME)) * dt
        equal = np.vstack([to_r, to_psi, np.eye(steps + 1)[0], np.eye(steps + 1)[-1]])
        change_of = np.diff(np.eye(steps + 1), axis=0)
        result = linprog(
            np.zeros(steps + 1),
            A_ub=np.vstack([change_of, -change_of]),
            b_ub=np.full(2 * steps, rate * dt),
            A_eq=equal,
            b_eq=[0.0, change, 0.0, 0.0],
            bounds=(-limit, limit),
        )
        return bool(result.status == 0)

    low, high = 40, 80
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if possible(middle) else (middle, high)
    return high * dt


def test_the_floor_of_a_slow_rudder_comes_to_rest_in_the_least_time() -> None:
    floor = BangBangConfig().build(Steering(VESSEL, VESSEL.turning(5 * DEG, 60.0), 5 * DEG, 0.01))
    assert isinstance(floor, RatedBangBangHeading)
    flights = fly(
        VESSEL,
        floor,
        torch.tensor([30 * DEG, -30 * DEG]),
        torch.tensor([[1.0, 1.0, 0.0]] * 2),
        dt=0.01,
        duration=10.0,
    )
    least = shortest_to_rest(30 * DEG, 10 * DEG, 5 * DEG)
    # on the way to rest the rudder comes back at its rate: heading K/T rate t^3 / 6 is left a time
    # t before
    early = (0.1 * DEG * 6.0 * TIME / (GAIN * 10 * DEG)) ** (1 / 3)
    assert float(flights.settled(0.1 * DEG).max()) == pytest.approx(least - early, abs=0.15)
    assert float(flights.overshoot().max()) < 0.05 * DEG
    assert torch.allclose(flights.states[0, :, 2], -flights.states[1, :, 2], atol=1e-9)


def test_a_flight_is_what_an_ode_solver_says() -> None:
    """Rudder hard over from the start: it moves at its rate, and the heading follows Nomoto's
    equation.
    """

    class HardOver(Policy):
        def forward(
            self, x: torch.Tensor, reference: torch.Tensor, s: torch.Tensor
        ) -> tuple[torch.Tensor, torch.Tensor]:
            return torch.full_like(reference, 5 * DEG), s

    flights = fly(
        VESSEL,
        HardOver(),
        torch.tensor([1.0]),
        torch.tensor([[0.9, 1.1, 0.0]]),
        dt=0.005,
        duration=3.0,
    )
    slope = 10 * DEG

    def rates(t: float, y: np.ndarray) -> list[float]:
        return [y[1], (0.9 * GAIN * min(slope * t, 5 * DEG) - y[1]) / (1.1 * TIME)]

    truth = solve_ivp(rates, (0.0, 3.0), [0.0, 0.0], rtol=1e-9, atol=1e-12, max_step=0.01).y[:, -1]
    # the rudder moves in steps, which is half a step late
    assert float(flights.state("psi")[0, -1]) == pytest.approx(truth[0], rel=5e-3)
    assert float(flights.state("r")[0, -1]) == pytest.approx(truth[1], rel=5e-3)


def test_the_turn_of_a_slow_vessel_is_waited_for() -> None:
    """Nomoto's model of second order: the area above the answer is T1 + T2 - T3."""
    turning = SteeredPlant(load_vessel("nomoto_mariner_yaw").build()).turning(5 * DEG, 100.0, 0.2)
    assert turning.gain == pytest.approx(0.18499155, rel=0.01)
    assert turning.time == pytest.approx(117.97831 + 7.7630075 - 18.530161, rel=0.02)


def test_a_yaw_rate_that_overshoots_has_the_time_constant_of_a_zigzag() -> None:
    """The Mariner turns far less in a hard turn than about straight ahead."""
    turning = SteeredPlant(load_vessel("mariner").build()).turning(20 * DEG, 60.0, 0.4)
    assert 0.02 < turning.gain < 0.06
    assert 15.0 < turning.time < 40.0


def test_a_vessel_that_starts_at_rest_runs_up_and_has_the_rate_of_its_lagging_rudder() -> None:
    boat = SteeredPlant(load_vessel("example_rudder_boat").build())
    x, w = boat.start(torch.ones(1, dtype=torch.float64))
    speed = float(x[0, boat.column("u")])
    assert speed > 3.0
    assert boat.rate == pytest.approx(25 * DEG)
    variation = torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64)
    for _ in range(50):
        x, variation = boat.model(0.1).step(x, w, variation)
    assert float(x[0, boat.column("u")]) == pytest.approx(speed, rel=1e-4)

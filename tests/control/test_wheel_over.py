"""Wheel-over against turns that are integrated by SciPy, and the legs that change there."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from residnet.control.guidance import LookAhead, WaypointGuidance, WheelOver
from residnet.control.heading.turning import Turning

TURNING = Turning(3.47, 3.94, 3.2)
LIMIT = math.radians(5)
STATE = ("x", "y", "psi", "u", "v", "r")


def turned(change: float) -> np.ndarray:
    """Poses [N, 3] of the turn by full rudder and counter-rudder that ends without yaw at this
    heading.
    """

    def rate(_: float, z: np.ndarray, rudder: float) -> list[float]:
        return [
            TURNING.speed * math.cos(z[2]),
            TURNING.speed * math.sin(z[2]),
            z[3],
            (TURNING.gain * rudder - z[3]) / TURNING.time,
        ]

    def stopped(_: float, z: np.ndarray, *rudder: float) -> float:
        return float(z[3])

    stopped.terminal = True  # type: ignore[attr-defined]
    stopped.direction = -1  # type: ignore[attr-defined]

    def flown(held: float) -> np.ndarray:
        over = solve_ivp(
            rate, (0.0, held), np.zeros(4), args=(LIMIT,), rtol=1e-8, atol=1e-8, max_step=0.1
        )
        back = solve_ivp(
            rate,
            (0.0, 20.0),
            over.y[:, -1],
            args=(-LIMIT,),
            rtol=1e-8,
            atol=1e-8,
            max_step=0.1,
            events=stopped,
        )
        return np.concatenate((over.y.T, back.y.T))

    return flown(brentq(lambda held: flown(held)[-1, 2] - change, 0.1, 20.0, xtol=1e-5))


@pytest.mark.parametrize("degrees", [10.0, 42.0])
def test_a_gentle_turn_begins_where_it_ends_on_the_next_leg(degrees: float) -> None:
    angle = math.radians(degrees)
    end = turned(angle)[-1]
    corner = end[0] - end[1] / math.tan(angle)
    over = WheelOver(TURNING, LIMIT, 10.0)
    assert over(torch.tensor([angle, -angle], dtype=torch.float64)).tolist() == pytest.approx(
        [corner, corner], rel=5e-3
    )


@pytest.mark.parametrize("share", [0.5, 0.9])
def test_a_sharp_turn_still_reaches_into_the_circle(share: float) -> None:
    angle = math.radians(140.0)
    distance = float(
        WheelOver(TURNING, LIMIT, 3.4, share=share)(torch.tensor([angle], dtype=torch.float64))
    )
    track = turned(angle)[:, :2]
    assert np.hypot(track[:, 0] - distance, track[:, 1]).min() == pytest.approx(
        share * 3.4, rel=0.02
    )


def test_straight_on_needs_none_and_a_slow_rudder_needs_half_its_way_more() -> None:
    angles = torch.tensor([0.0, 1.0], dtype=torch.float64)
    quick, slow = (
        WheelOver(TURNING, LIMIT, 3.4, rate=rate)(angles) for rate in (None, LIMIT / 2.0)
    )
    assert float(quick[0]) == 0.0
    assert (slow - quick).tolist() == pytest.approx([3.2, 3.2])


def test_legs_change_at_the_wheel_over_on_the_leg_but_in_the_circle_beside_it() -> None:
    over = WheelOver(TURNING, LIMIT, 3.4)
    guidance = WaypointGuidance([(100.0, 0.0), (100.0, 100.0)], 3.4, LookAhead(10.0), STATE, over)
    before = float(over(torch.tensor([0.5 * math.pi], dtype=torch.float64)))
    assert before > 3.4
    x = torch.zeros(6, 6, dtype=torch.float64)
    # short of it, there, there but aside of the leg, in the circle; and the last way-point has no
    # wheel-over
    x[:, 0] = torch.tensor(
        [99.9 - before, 100.1 - before, 100.1 - before, 97.0, 100.0, 100.1 - before]
    )
    x[:, 1] = torch.tensor([0.0, 0.0, 3.0, 0.0, 96.5, 0.0])
    # there, on the leg, but at a crab angle
    x[5, 2] = 0.15
    s = torch.zeros(6, 3, dtype=torch.float64)
    s[4, 0] = 1.0
    compiled = torch.jit.script(guidance)(x, 0, s)[1]
    _, s = guidance(x, 0, s)
    assert torch.equal(compiled, s)
    assert s[:, 0].tolist() == [0.0, 1.0, 0.0, 1.0, 1.0, 0.0]

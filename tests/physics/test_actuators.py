"""Thrusters: the printed curves (document 003 eqs. (21), (22)), their clipping, saturation and rate
limit.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from kinds import of_kind

from residnet.physics.actuators import Thrusters
from residnet.physics.vessel import load_vessel

N_MAX = 2380.0 / 60.0


@pytest.fixture(scope="module")
def thrusters() -> Thrusters:
    return of_kind(load_vessel("wam_v_cal").actuators.build(), Thrusters)


def thrust_of_one(thrusters: Thrusters, n: torch.Tensor) -> torch.Tensor:
    return thrusters.forces.thrust(n[..., None])[..., 0]


def rpm(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64) / 60.0


def test_curve_is_the_printed_one_in_rpm(thrusters: Thrusters) -> None:
    ahead, astern = np.linspace(45, 2380, 40), np.linspace(-2380, -61, 40)
    np.testing.assert_allclose(
        thrust_of_one(thrusters, rpm(*ahead)), 3.54e-5 * ahead**2 + 0.084 * ahead - 3.798, rtol=1e-4
    )
    np.testing.assert_allclose(
        thrust_of_one(thrusters, rpm(*astern)),
        -1.189e-5 * astern**2 + 0.0707 * astern + 4.331,
        rtol=1e-3,
        atol=1e-3,
    )


def test_full_thrust_of_two_is_what_errata_states(thrusters: Thrusters) -> None:
    tau = thrusters.forces(rpm(2380, 2380))
    np.testing.assert_allclose(tau, [793.3, 0.0, 0.0], atol=0.1)
    np.testing.assert_allclose(thrusters.forces(rpm(-2380, -2380)), [-462.6, 0.0, 0.0], atol=0.1)


def test_dead_band_and_sign(thrusters: Thrusters) -> None:
    """Clipped, the curve is zero from -60.6 to 44.4 rpm and never opposes n (correction W5)."""
    n = torch.linspace(-2380, 2380, 20_001, dtype=torch.float64) / 60.0
    thrust = thrust_of_one(thrusters, n)
    assert bool((thrust * n >= 0).all())
    inside = (n * 60 > -60.0) & (n * 60 < 44.0)
    assert bool((thrust[inside] == 0).all())
    assert bool((thrust[n * 60 > 44.5] > 0).all())
    assert bool((thrust[n * 60 < -60.8] < 0).all())
    # continuous and rising: no jump larger than the steepest slope allows
    rise = thrust.diff()
    assert bool((rise >= 0).all())
    assert float(rise.max()) < 1.05 * float(n[1] - n[0]) * (5.04 + 2 * 0.12744 * N_MAX)


def test_moment_arm_and_side(thrusters: Thrusters) -> None:
    """Port thrust turns to starboard (r > 0) about half the spacing."""
    tau = thrusters.forces(rpm(1200, 0))
    force = 3.54e-5 * 1200**2 + 0.084 * 1200 - 3.798
    np.testing.assert_allclose(tau, [force, 0.0, 1.22 * force], rtol=1e-4)
    np.testing.assert_allclose(
        thrusters.forces(rpm(0, 1200)), [force, 0.0, -1.22 * force], rtol=1e-4
    )


def test_rate_limit(thrusters: Thrusters) -> None:
    """From rest to full in 2380 / 1500 = 1.59 s, a reversal in 3.17 s (correction W7)."""
    dt, n, command = (
        0.01,
        torch.zeros(1, 2, dtype=torch.float64),
        torch.tensor([[N_MAX, -N_MAX]], dtype=torch.float64),
    )
    steps = 0
    while not torch.equal(n, command):
        before, n = n, thrusters.advance(n, command, dt)
        assert bool(((n - before).abs() <= 1500 / 60 * dt + 1e-12).all())
        steps += 1
    assert steps == 159
    reversal = 0
    while not torch.equal(n, -command):
        n = thrusters.advance(n, -command, dt)
        reversal += 1
    assert reversal in (317, 318)

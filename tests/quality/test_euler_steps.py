"""Logs of simulations by Euler's method: half a step is no delay of a clock."""

from __future__ import annotations

import numpy as np
import pytest

from residnet.core.log import Log
from residnet.quality import inspect_log
from residnet.quality.kinematic_findings import POSITION_LIMITS, YAW_LIMITS
from residnet.quality.kinematics import _compute_condition_index


def simulate_boat(*, is_explicit: bool, dt: float, yaw_bias: float = 0.0) -> Log:
    """Simulate a boat without noise whose sway nearly follows its yaw rate.

    Args:
        is_explicit: whether the pose is advanced by the velocities at the start of a step.
        dt: time step in s.
        yaw_bias: bias of the recorded yaw rate in rad/s.
    """
    rng = np.random.default_rng(102)
    state = np.array([0.0, 0.0, 0.0, 4.0, 0.0, 0.0])
    rudder = 0.0
    rows = []
    for k in range(round(400.0 / dt)):
        if k % round(12.0 / dt) == 0:
            rudder = rng.uniform(-0.5, 0.5)
        x, y, psi, u, v, r = state
        rows.append((k * dt, *state, rudder))
        accelerations = np.array(
            [(4.0 - u) / 8.0, (-3.0 * r - v) / 2.0, (0.3 * rudder - r - 1.5 * r * abs(r)) / 3.0]
        )
        velocities = state[3:] + dt * accelerations
        surge, sway, yaw_rate = state[3:] if is_explicit else velocities
        pose = (
            x + dt * (surge * np.cos(psi) - sway * np.sin(psi)),
            y + dt * (surge * np.sin(psi) + sway * np.cos(psi)),
            psi + dt * yaw_rate,
        )
        state = np.array([*pose, *velocities])
    t, *columns = np.array(rows).T
    channels = dict(zip(("x", "y", "psi", "u", "v", "r", "delta"), columns, strict=True))
    return Log("boat", t, channels | {"r": channels["r"] + yaw_bias})


@pytest.mark.parametrize("is_explicit", [True, False])
@pytest.mark.parametrize("dt", [0.25, 1.0])
def test_inspect_log_reports_no_delay_of_half_a_step(is_explicit: bool, dt: float) -> None:
    report = inspect_log(simulate_boat(is_explicit=is_explicit, dt=dt))
    causes = {*POSITION_LIMITS, *YAW_LIMITS}
    assert [finding.text for finding in report.findings if finding.code in causes] == []


def test_inspect_log_finds_a_bias_in_a_simulation() -> None:
    report = inspect_log(simulate_boat(is_explicit=True, dt=0.5, yaw_bias=0.01))
    drift = next(finding for finding in report.findings if finding.code == "yaw_drift")
    assert drift.figures["bias"] == pytest.approx(-0.01, rel=0.02)


@pytest.mark.parametrize("correlation", [0.0, 0.9, 0.999])
def test_condition_index_of_two_columns_follows_from_their_correlation(correlation: float) -> None:
    # a heading delay and a gain of sway are such columns in a zigzag of one period
    first, second = np.eye(5)[:2]
    mixed = correlation * first + np.sqrt(1.0 - correlation**2) * second
    index = _compute_condition_index(np.column_stack((3.0 * first, 0.01 * mixed)))
    assert index == pytest.approx(np.sqrt((1.0 + correlation) / (1.0 - correlation)))

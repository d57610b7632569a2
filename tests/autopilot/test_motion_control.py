"""Reference filter and motion PID against SciPy and by hand; the ferry through the document's
waypoints.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from kinds import of_kind
from scipy.signal import step

from residnet.autopilot import (
    AllocatedPolicy,
    ClosedLoop,
    HullFeedForward,
    MotionPID,
    MotionPIDConfig,
    RecordedReference,
    ReferenceFilter,
    ReferenceFilterConfig,
)
from residnet.core.config import load_config
from residnet.core.errors import ConfigError
from residnet.engine.recorded_plant import RecordedPlantDynamics
from residnet.engine.rollout import Rollout
from residnet.physics.actuators.thrusters import AzimuthThrusters
from residnet.physics.plant import HullPlant
from residnet.physics.vessel import load_vessel

WAYPOINTS = ((0.0, -15.0, -1.5), (15.0, -15.0, 3.0), (15.0, 0.0, 0.0))


def asked(guidance: ReferenceFilter, steps: int, start: torch.Tensor) -> torch.Tensor:
    """References [B, T, 9]."""
    s, out = guidance.initial_state(start), []
    for k in range(steps):
        reference, s = guidance(start, k, s)
        out.append(reference)
    return torch.stack(out, dim=1)


def test_filter_against_its_transfer_function() -> None:
    """(2.15) is (s + W)(s^2 + 2 D W s + W^2) (correction J9)."""
    w, d = 0.4, 0.7
    config = ReferenceFilterConfig(
        waypoints=((10.0, 0.0, 0.0),), interval=40.0, frequency=(w, w, w), damping=(d, d, d)
    )
    x = torch.zeros(1, 6, dtype=torch.float64)
    found = asked(config.build(0.05), 800, x)[0]
    _, y = step(([w**3], np.polymul([1, w], [1, 2 * d * w, w**2])), T=0.05 * np.arange(800))
    np.testing.assert_allclose(found[:, 0], 10 * y, atol=1e-6)
    # straight north: body axes are earth axes
    np.testing.assert_allclose(found[1:-1, 3], (found[2:, 0] - found[:-2, 0]) / 0.1, atol=2e-3)


def test_body_velocity_and_acceleration_belong_to_the_pose() -> None:
    """nu_d and its derivative are those of eta_d seen from the turning vessel (correction J7), by
    differences.
    """
    config = ReferenceFilterConfig(waypoints=WAYPOINTS, interval=10.0, frequency=(0.4, 0.5, 0.6))
    dt = 0.01
    x = torch.tensor([[3.0, 1.0, 0.4, 0, 0, 0]], dtype=torch.float64)
    found = asked(config.build(dt), 3000, x)[0].numpy()
    np.testing.assert_array_equal(found[0], [3.0, 1.0, 0.4, 0, 0, 0, 0, 0, 0])
    eta = found[:, :3]
    nu = found[:, 3:6]
    nu_dot = found[:, 6:]
    slope = (eta[2:] - eta[:-2]) / (2 * dt)
    c, s = np.cos(eta[1:-1, 2]), np.sin(eta[1:-1, 2])
    body = np.stack(
        (c * slope[:, 0] + s * slope[:, 1], c * slope[:, 1] - s * slope[:, 0], slope[:, 2]), axis=1
    )
    inside = np.ones(len(body), dtype=bool)
    # at a new waypoint the third derivative jumps
    inside[[998, 999, 1998, 1999]] = False
    np.testing.assert_allclose(nu[1:-1][inside], body[inside], atol=1e-4)
    np.testing.assert_allclose(
        nu_dot[1:-1][inside], ((nu[2:] - nu[:-2]) / (2 * dt))[inside], atol=2e-4
    )


def test_headings_are_followed_as_written() -> None:
    """0 to 180 deg is clockwise, 135 to -45 deg is not: no wrapping (correction J13)."""
    points = ((0.0, 0.0, np.pi), (0.0, 0.0, 0.75 * np.pi), (0.0, 0.0, -0.25 * np.pi))
    config = ReferenceFilterConfig(waypoints=points, interval=60.0)
    psi = asked(config.build(0.2), 900, torch.zeros(1, 6, dtype=torch.float64))[0, :, 2].numpy()
    assert psi[:300].min() >= 0
    assert psi[299] == pytest.approx(np.pi, abs=0.01)
    turning = psi[603:]
    assert (np.diff(turning)[turning[:-1] > 0] < 0).all()
    assert -0.9 < turning.min() < -0.25 * np.pi
    assert psi[-1] == pytest.approx(-0.25 * np.pi, abs=0.01)


def test_rows_fly_their_own_waypoints_and_bandwidths_and_stay_at_their_last() -> None:
    short = ReferenceFilterConfig(waypoints=WAYPOINTS[:1], interval=10.0, frequency=(0.9, 0.9, 0.9))
    long = ReferenceFilterConfig(waypoints=WAYPOINTS, interval=10.0)
    x = torch.zeros(2, 6, dtype=torch.float64)
    both = asked(ReferenceFilter([short, long], 0.1), 300, x)
    for row, config in enumerate((short, long)):
        alone = asked(config.build(0.1), 300, x[:1])[0]
        torch.testing.assert_close(both[row], alone, rtol=1e-12, atol=1e-12)
    assert both[0, -1, 1] == pytest.approx(-15.0, abs=1e-3)
    assert long.duration == 30.0


def test_waypoints_have_units_in_a_file_and_intervals_of_whole_steps(tmp_path: Path) -> None:
    text = "waypoints: [[15 m, -15, -90 deg]]\ninterval: 1 min\nfrequency: [0.2, 0.2, 0.4]\n"
    file = tmp_path / "guidance.yaml"
    file.write_text(text)
    config = load_config(file, [], ReferenceFilterConfig)
    assert config.waypoints[0] == pytest.approx((15.0, -15.0, -np.pi / 2))
    assert config.interval == 60.0
    with pytest.raises(ConfigError, match="frequency"):
        load_config(file, ["frequency=[0.2, 0, 0.4]"], ReferenceFilterConfig)
    for intervals, dt in (((10.0,), 0.3), ((0.05,), 0.1), ((10.0, 20.0), 0.1)):
        configs = [ReferenceFilterConfig(waypoints=WAYPOINTS, interval=one) for one in intervals]
        with pytest.raises(ConfigError, match="whole number of steps"):
            ReferenceFilter(configs, dt)


GAINS = MotionPIDConfig(
    proportional=(190.0, 200.0, 900.0), integral=(6.0, 7.0, 45.0), derivative=(860.0, 910.0, 2700.0)
)


def test_pid_by_hand() -> None:
    """Two steps: error in the body frame, heading wrapped, the integral used before its update."""
    x = torch.tensor([[1.0, 2.0, 3.0, 0.5, -0.1, 0.02, 7.0]], dtype=torch.float64)
    reference = torch.tensor([[4.0, 1.0, -3.1, 0.6, 0.1, 0.0, 0.3, 0.2, 0.1]], dtype=torch.float64)
    controller = GAINS.build(0.1)
    dt = 0.1
    first, s = controller(x, reference, controller.initial_state(x))
    second, s = controller(x, reference, s)
    c, sn = np.cos(3.0), np.sin(3.0)
    e = np.array([c * 3.0 + sn * -1.0, c * -1.0 - sn * 3.0, -6.1 + 2 * np.pi])
    rest = np.array([190, 200, 900]) * e + np.array([860, 910, 2700]) * [0.1, 0.2, -0.02]
    np.testing.assert_allclose(first[0], rest, rtol=1e-12)
    np.testing.assert_allclose(second[0], rest + np.array([6, 7, 45]) * e * dt, rtol=1e-12)
    np.testing.assert_allclose(s[0], 2 * dt * e, rtol=1e-12)
    hull = ferry("milliampere").hull
    begin = controller.initial_state(x)
    forward = GAINS.build(dt, HullFeedForward(hull))(x, reference, begin)[0] - first
    moved = hull(reference[:, 3:6], forward)
    np.testing.assert_allclose(moved, reference[:, 6:9], rtol=1e-9, atol=1e-12)


def ferry(name: str) -> HullPlant:
    return of_kind(load_vessel(name).build(), HullPlant)


def test_allocated_to_azimuth_thrusters() -> None:
    """The thrusters make the forces that the controller asks for, while they can; its integral
    brings the ferry to the point.
    """
    plant = ferry("milliampere_azimuth")
    assert isinstance(plant.actuators, AzimuthThrusters)
    dt = 0.2
    controller = MotionPID([GAINS], dt, HullFeedForward(ferry("milliampere").hull))
    point = torch.zeros(1, 1, 9, dtype=torch.float64)
    point[0, 0, :3] = torch.tensor([0.5, -0.3, 0.2], dtype=torch.float64)
    x0 = plant.make_initial_state(1)
    allocated = AllocatedPolicy(controller, plant.actuators.allocate)
    begin = torch.zeros(1, 3, dtype=torch.float64)
    asked_for, command = (one(x0, point[:, 0], begin)[0] for one in (controller, allocated))
    made = plant.actuators.force(x0[:, 6:], command, x0[:, 3:6])
    torch.testing.assert_close(made, asked_for, rtol=1e-9, atol=1e-9)
    w = torch.zeros(1, 600, len(plant.input_names), dtype=torch.float64)
    w[..., plant.input_names.index("force_north")] = 40.0
    loop = ClosedLoop(allocated, RecordedReference(point))
    with torch.no_grad():
        states, _, _ = Rollout(RecordedPlantDynamics(plant, dt), loop)(x0, w, x0[:, :0])
    torch.testing.assert_close(states[0, -1, :3], point[0, 0, :3], atol=0.02, rtol=0)

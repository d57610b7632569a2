"""Velocities of vessels that roll and pitch, projected on the horizontal plane."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from residnet.io.drafting.motion_regression import RawTable
from residnet.io.drafting.vertical import project_on_horizontal

T = np.arange(0.0, 60.0, 0.05)


def simulate(tilt: float) -> tuple[Rotation, np.ndarray, np.ndarray]:
    """Return attitude, velocities along the axes of the vessel [T, 3] and position [T, 3]."""
    yaw = 0.3 * T
    angles = np.stack((yaw, tilt * np.sin(0.7 * T), tilt * np.cos(0.5 * T)), axis=1)
    attitude = Rotation.from_euler("ZYX", angles)
    body = np.stack((1.0 + 0.2 * np.sin(T), 0.3 * np.cos(0.4 * T), 0.4 * np.sin(0.9 * T)), axis=1)
    position = np.cumsum(attitude.apply(body), axis=0) * (T[1] - T[0])
    return attitude, body, position


NAMES = {"z": "depth", "phi": "roll [rad]", "theta": "pitch [rad]"}


def make_log(attitude: Rotation, velocity: np.ndarray, position: np.ndarray) -> RawTable:
    """Return a log with roll and pitch in rad, depth and velocities [T, 3]."""
    _, pitch, roll = attitude.as_euler("ZYX").T
    columns = {"phi": roll, "theta": pitch, "z": position[:, 2]}
    return RawTable(T, columns | dict(zip(("u", "v", "w"), velocity.T, strict=True)))


@pytest.mark.parametrize("tilt", [0.4, 0.01])
def test_velocities_of_a_tilted_vessel_are_projected(tilt: float) -> None:
    attitude, body, position = simulate(tilt)
    log = make_log(attitude, body, position)
    projected = project_on_horizontal(log, NAMES)
    if tilt < 0.1:
        assert projected is log
        return
    yaw = attitude.as_euler("ZYX")[:, 0]
    expected = Rotation.from_euler("Z", -yaw[:, None]).apply(attitude.apply(body))
    for column, name in enumerate(("u", "v")):
        np.testing.assert_allclose(projected.columns[name], expected[:, column], atol=1e-9)


def test_velocities_in_the_world_frame_are_not_projected() -> None:
    attitude, body, position = simulate(0.4)
    log = make_log(attitude, attitude.apply(body), position)
    projected = project_on_horizontal(log, NAMES)
    for name in ("u", "v"):
        np.testing.assert_array_equal(projected.columns[name], log.columns[name])


def test_velocities_are_projected_by_angles_in_degrees() -> None:
    attitude, body, position = simulate(0.4)
    log = make_log(attitude, body, position)
    in_degrees = {name: np.degrees(log.columns[name]) for name in ("phi", "theta")}
    names = {"z": "depth_m", "phi": "roll_deg", "theta": "pitch_deg"}
    projected = project_on_horizontal(RawTable(T, log.columns | in_degrees), names)
    yaw = attitude.as_euler("ZYX")[:, 0]
    expected = Rotation.from_euler("Z", -yaw[:, None]).apply(attitude.apply(body))
    np.testing.assert_allclose(projected.columns["u"], expected[:, 0], atol=1e-9)
    np.testing.assert_allclose(projected.columns["v"], expected[:, 1], atol=1e-9)

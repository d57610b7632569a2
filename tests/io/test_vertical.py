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


@pytest.mark.parametrize(("tilt", "has_heave"), [(0.4, True), (0.4, False), (0.01, True)])
def test_velocities_of_a_tilted_vessel_are_projected(tilt: float, *, has_heave: bool) -> None:
    attitude, body, position = simulate(tilt)
    quaternion = dict(zip(("qx", "qy", "qz", "qw"), attitude.as_quat().T, strict=True))
    log = RawTable(T, {**quaternion, "u": body[:, 0], "v": body[:, 1]})
    table = {"position_z": position[:, 2]} | ({"linear_z": body[:, 2]} if has_heave else {})
    (projected,) = project_on_horizontal([*table], [table], [log], {})
    if tilt < 0.1:
        assert projected is log
        return
    yaw = attitude.as_euler("ZYX")[:, 0]
    expected = Rotation.from_euler("Z", -yaw[:, None]).apply(attitude.apply(body))
    for column, name in enumerate(("u", "v")):
        # without heave velocity, the depth is differentiated
        error = np.abs(projected.columns[name] - expected[:, column])[5:-5].max()
        assert error < (1e-9 if has_heave else 0.02)


def test_velocities_in_the_world_frame_are_not_projected() -> None:
    attitude, body, position = simulate(0.4)
    world = attitude.apply(body)
    quaternion = dict(zip(("qx", "qy", "qz", "qw"), attitude.as_quat().T, strict=True))
    log = RawTable(T, {**quaternion, "u": world[:, 0], "v": world[:, 1]})
    table = {"position_z": position[:, 2], "linear_z": world[:, 2]}
    (projected,) = project_on_horizontal([*table], [table], [log], {})
    assert projected is log


def test_velocities_are_projected_by_angles_in_degrees() -> None:
    attitude, body, position = simulate(0.4)
    yaw, pitch, roll = attitude.as_euler("ZYX").T
    tilt = {"phi": np.degrees(roll), "theta": np.degrees(pitch)}
    log = RawTable(T, {**tilt, "u": body[:, 0], "v": body[:, 1]})
    table = {"depth_m": position[:, 2], "heave_mps": body[:, 2]}
    names = {"phi": "roll_deg", "theta": "pitch_deg"}
    (projected,) = project_on_horizontal([*table], [table], [log], names)
    expected = Rotation.from_euler("Z", -yaw[:, None]).apply(attitude.apply(body))
    np.testing.assert_allclose(projected.columns["u"], expected[:, 0], atol=1e-9)
    np.testing.assert_allclose(projected.columns["v"], expected[:, 1], atol=1e-9)

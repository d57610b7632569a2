"""Rudder, propeller and fixed thrusters: signs, limits, momentum theory, and a whole boat from its
file.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from kinds import of_kind

from residnet.core.config import validate
from residnet.physics.actuators import RudderPropellerConfig, Thrusters, ThrustersConfig
from residnet.physics.actuators.base import SteeredActuators
from residnet.physics.hull import FossenConfig
from residnet.physics.vessel import load_vessel, vessel_files

BOAT = vessel_files()["example_rudder_boat"]
BASE: dict[str, Any] = {
    "kind": "rudder_propeller",
    "source": "made",
    "density": 1000.0,
    "rudder": {"area": 0.2, "aspect_ratio": 2.0, "x": -3.0, "limit": 0.6, "straightening": 0.0},
    "propeller": {
        "diameter": 0.5,
        "n_max": 20.0,
        "forward": [0.0, 0.0, 5.0],
        "reverse": [0.0, 0.0, -3.0],
    },
}


def merged(**changes: dict[str, Any]) -> SteeredActuators:
    content = {
        key: BASE[key] | changes.get(key, {}) if isinstance(BASE[key], dict) else BASE[key]
        for key in BASE
    }
    config: RudderPropellerConfig = validate(content, RudderPropellerConfig, "here")
    return config.build()


def force(
    unit: SteeredActuators, delta: float, n: float, nu: tuple[float, float, float]
) -> np.ndarray:
    command, motion = (
        torch.tensor([[delta, n]], dtype=torch.float64),
        torch.tensor([nu], dtype=torch.float64),
    )
    return unit.force(command[:, :0], command, motion)[0].numpy()


def test_a_rudder_outside_the_race_is_the_closed_form() -> None:
    unit = merged()
    slope = 6.13 * 2.0 / 4.25
    normal = 0.5 * 1000 * 0.2 * slope * np.sin(0.3) * 4.0**2
    thrust = 5.0 * 10.0**2
    expected = [thrust - normal * np.sin(0.3), -normal * np.cos(0.3), 3.0 * normal * np.cos(0.3)]
    np.testing.assert_allclose(force(unit, 0.3, 10.0, (4.0, 0.0, 0.0)), expected, rtol=1e-12)
    # to starboard: r grows; astern it turns the other way
    assert (
        force(unit, 0.3, 10.0, (4.0, 0.0, 0.0))[2]
        > 0
        > force(unit, 0.3, -10.0, (-4.0, 0.0, 0.0))[2]
    )


def test_the_race_steers_at_rest() -> None:
    """U_R^2 = 2 T / (rho A_p) behind an actuator disc at standstill; none of it outside the race or
    when backing.
    """
    unit = merged(rudder={"race_share": 1.0})
    thrust = 5.0 * 15.0**2
    square = 2 * thrust / (1000 * np.pi * 0.5**2 / 4)
    normal = 0.5 * 1000 * 0.2 * 6.13 * 2.0 / 4.25 * np.sin(0.2) * square
    np.testing.assert_allclose(
        force(unit, 0.2, 15.0, (0, 0, 0))[1:],
        [-normal * np.cos(0.2), 3 * normal * np.cos(0.2)],
        rtol=1e-12,
    )
    assert np.abs(force(merged(), 0.2, 15.0, (0, 0, 0))[1:]).max() < 1e-9
    assert np.abs(force(unit, 0.2, -15.0, (0, 0, 0))[1:]).max() < 1e-9


def test_a_rudder_amidships_damps_sway_and_yaw() -> None:
    unit = merged(rudder={"straightening": 1.0})
    assert force(unit, 0.0, 5.0, (4.0, 0.5, 0.0))[1] < 0
    assert force(unit, 0.0, 5.0, (4.0, 0.0, 0.3))[2] < 0


def test_thrust_falls_with_speed_and_saturates() -> None:
    unit = merged(propeller={"advance_loss": 6.0, "thrust_deduction": 0.1})
    assert force(unit, 0, 10, (3.0, 0, 0))[0] == pytest.approx(0.9 * (500 - 6 * 10 * 3))
    np.testing.assert_array_equal(
        force(unit, 0.0, 1000.0, (1.0, 0, 0)), force(unit, 0.0, 20.0, (1.0, 0, 0))
    )
    np.testing.assert_array_equal(
        force(unit, 3.0, 10.0, (1.0, 0, 0)), force(unit, 0.6, 10.0, (1.0, 0, 0))
    )


def test_demands() -> None:
    unit = merged()
    command = unit.demand(
        torch.tensor([0.5, -2.0], dtype=torch.float64),
        torch.tensor([1.5, -0.5], dtype=torch.float64),
    )
    np.testing.assert_allclose(command, [[0.6, 10.0], [-0.3, -20.0]])


def thrusters(*units: dict[str, Any]) -> Thrusters:
    curve = {"n_max": 10.0, "forward": [0.0, 0.0, 2.0], "reverse": [0.0, 0.0, -1.0]}
    config: ThrustersConfig = validate(
        {"kind": "thrusters", "source": "made", "thrusters": [curve | unit for unit in units]},
        ThrustersConfig,
        "here",
    )
    return config.build()


TWIN = ({"name": "port", "x": -2.0, "y": -1.0}, {"name": "stbd", "x": -2.0, "y": 1.0})


def test_fixed_thrusters_push_where_they_stand() -> None:
    unit = thrusters(*TWIN, {"name": "bow", "x": 2.5, "angle": "90 deg"})
    assert unit.commands == ("cmd_port", "cmd_stbd", "cmd_bow")
    n = torch.tensor(
        [[4.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 4.0], [0.0, 0.0, -4.0]], dtype=torch.float64
    )
    expected = [[32, 0, 32], [32, 0, -32], [0, 32, 80], [0, -16, -40]]
    np.testing.assert_allclose(unit.force(n[:, :0], n, torch.zeros(4, 3)), expected, atol=1e-12)
    command = unit.demand(
        torch.tensor(0.5, dtype=torch.float64), torch.tensor(0.2, dtype=torch.float64)
    )
    np.testing.assert_allclose(command, [7.0, 3.0, 2.0], atol=1e-12)


def test_two_of_them_are_the_differential_thrusters() -> None:
    known = load_vessel("wam_v_cal")
    assert isinstance(known, FossenConfig)
    twin = of_kind(known.actuators.build(), Thrusters)
    shared = {
        "forward": known.actuators.forward,
        "reverse": known.actuators.reverse,
        "n_max": "2380 rpm",
        "n_rate": "1500 rpm/s",
    }
    unit = thrusters(
        *(
            {"name": name, "x": -2, "y": side} | shared
            for name, side in (("port", -1.22), ("stbd", 1.22))
        )
    )
    rng = torch.Generator().manual_seed(0)
    a, command = 60 * torch.rand(2, 50, 2, generator=rng, dtype=torch.float64) - 30
    torch.testing.assert_close(
        unit.force(a, command, a), twin.force(a, command, a), rtol=1e-12, atol=1e-9
    )
    torch.testing.assert_close(
        unit.advance(a, command, 0.1), twin.advance(a, command, 0.1), rtol=0, atol=1e-12
    )
    drive, steer = 2 * torch.rand(2, 50, generator=rng, dtype=torch.float64) - 1
    torch.testing.assert_close(
        unit.demand(drive, steer), twin.demand(drive, steer), rtol=1e-12, atol=1e-12
    )

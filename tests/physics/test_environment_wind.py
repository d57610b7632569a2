"""Wind on the hull: signs, symmetry, and both forms of coefficients against each other."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from residnet.core.config import load_config, validate
from residnet.core.errors import ConfigError
from residnet.physics.environment import (
    WindLoadConfig,
    WindLoadsConfig,
)
from residnet.physics.hull import FossenConfig
from residnet.physics.vessel import load_vessel, vessel_files

AREAS: dict[str, Any] = {
    "frontal_area": 3.0,
    "lateral_area": 6.0,
    "length": 5.0,
    "centre_height": 0.8,
    "source": "made",
}
SYMMETRIC = AREAS | {"kind": "symmetric", "c_x": 0.7, "c_y": 0.8, "c_n": 0.1}
ANGLES = np.linspace(0, np.pi, 181)
TABLE = AREAS | {
    "kind": "table",
    "angle": ANGLES.tolist(),
    "C_X": (-0.7 * np.cos(ANGLES)).tolist(),
    "C_Y": (-0.8 * np.sin(ANGLES)).round(12).tolist(),
    "C_N": (-0.1 * np.sin(2 * ANGLES)).round(12).tolist(),
}


def loads(content: dict[str, Any]) -> WindLoadConfig:
    config: WindLoadConfig = validate(content, WindLoadsConfig, "here")
    return config


BOTH = [pytest.param(SYMMETRIC, id="symmetric"), pytest.param(TABLE, id="table")]


def blow(wind: WindLoadConfig, speed: float, degrees: float) -> np.ndarray:
    """Forces of air that comes from an angle off the bow (positive from starboard) on a vessel at
    rest.
    """
    angle = torch.tensor(np.radians(degrees), dtype=torch.float64)
    return wind.loads(-speed * torch.cos(angle), -speed * torch.sin(angle)).numpy()


@pytest.mark.parametrize("content", BOTH)
def test_head_and_following_wind_only_push_along(content: dict[str, Any]) -> None:
    wind = loads(content)
    drag = 0.5 * 1.225 * 10.0**2 * 3.0 * 0.7
    np.testing.assert_allclose(blow(wind, 10, 0), [-drag, 0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(blow(wind, 10, 180), [drag, 0, 0, 0], atol=1e-9)


@pytest.mark.parametrize("content", BOTH)
def test_signs_from_starboard(content: dict[str, Any]) -> None:
    """Pushed and heeled to port; wind on the bow turns it away, wind on the quarter turns it up."""
    wind = loads(content)
    side = 0.5 * 1.225 * 10.0**2 * 6.0 * 0.8
    np.testing.assert_allclose(blow(wind, 10, 90), [0, -side, -0.8 * side, 0], atol=1e-9)
    bow, quarter = blow(wind, 10, 45), blow(wind, 10, 135)
    assert bow[3] == pytest.approx(-0.5 * 1.225 * 100 * 6 * 5 * 0.1)
    assert quarter[3] == pytest.approx(-bow[3])
    assert bow[0] < 0 < quarter[0]


@pytest.mark.parametrize("content", BOTH)
def test_port_mirrors_starboard_and_force_grows_with_the_square(content: dict[str, Any]) -> None:
    wind = loads(content)
    for angle in (10.0, 63.0, 120.0, 171.0):
        np.testing.assert_allclose(
            blow(wind, 8, -angle), blow(wind, 8, angle) * [1, -1, -1, -1], atol=1e-9
        )
        np.testing.assert_allclose(blow(wind, 16, angle), 4 * blow(wind, 8, angle), rtol=1e-9)
    np.testing.assert_allclose(
        wind.loads(torch.zeros(3), torch.zeros(3)), np.zeros((3, 4)), atol=1e-5
    )


def test_a_fine_table_of_the_symmetric_form_is_the_symmetric_form() -> None:
    rng = np.random.default_rng(0)
    air = torch.from_numpy(rng.normal(size=(2, 300)) * 8)
    # linear between degrees: the error of a chord
    torch.testing.assert_close(
        loads(TABLE).loads(*air),
        loads(SYMMETRIC).loads(*air),
        rtol=0,
        atol=2e-4 * 0.5 * 1.225 * 600 * 30,
    )


@pytest.mark.parametrize("content", BOTH)
def test_gradients(content: dict[str, Any]) -> None:
    along = torch.tensor([-5.0, 3.21, 0.4], dtype=torch.float64, requires_grad=True)
    across = torch.tensor([2.13, -4.4, 6.7], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(loads(content).loads, (along, across))
    calm = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    loads(content).loads(calm, calm).sum().backward()
    assert bool(torch.isfinite(calm.grad).all())  # type: ignore[arg-type]


def windy(*extra: str) -> FossenConfig:
    section = (
        "wind={kind: symmetric, frontal_area: 3, lateral_area: 6, length: 5, c_x: 0.7, c_y: 0.8,"
        " c_n: 0.1, source: made}"
    )
    return load_config(vessel_files()["wam_v_cal"], [section, *extra], FossenConfig)


def test_a_plant_feels_the_wind_relative_to_itself() -> None:
    """Running before the wind at its own speed it feels none; heading and wind turn together."""
    plant = windy().build()
    assert plant.inputs[-2:] == ("wind_speed", "wind_dir")
    still = load_vessel("wam_v_cal").build()
    assert "wind_speed" not in still.inputs
    x = torch.zeros(1, 8, dtype=torch.float64)
    x[:, 2], x[:, 3] = 0.6, 2.0
    w = torch.zeros(1, len(plant.inputs), dtype=torch.float64)
    w[:, -2], w[:, -1] = 2.0, 0.6 + np.pi
    torch.testing.assert_close(plant.rate(x, w), still.rate(x, w[:, :-2]), rtol=0, atol=1e-8)
    w[:, -1] = 0.6
    head = 0.5 * 1.225 * 4.0**2 * 3 * 0.7
    force = (plant.rate(x, w) - still.rate(x, w[:, :-2]))[0, 3:6] @ plant.hull.mass.T
    np.testing.assert_allclose(force, [-head, 0, 0], atol=1e-8)


@pytest.mark.parametrize(
    ("content", "change", "message"),
    [
        (SYMMETRIC, {"frontal_area": "3 m"}, "m\\^2"),
        (TABLE, {"C_Y": (0.8 * np.sin(ANGLES)).round(12).tolist()}, "pushes to port"),
        (TABLE, {"C_X": [1.0] * 181}, "pushes aft"),
        (TABLE, {"C_N": [0.0, 0.0]}, "2 values for 181"),
        (TABLE, {"C_N": [0.1] * 181}, "mirror"),
        (TABLE, {"angle": [0.0, 1.0, 2.0]}, "180 deg"),
    ],
)
def test_wrong_coefficients_are_one_line(
    content: dict[str, Any], change: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        validate(content | change, WindLoadsConfig, "here")
    assert "\n" not in str(caught.value)

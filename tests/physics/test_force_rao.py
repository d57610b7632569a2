"""First-order wave loads from WAMIT files."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from residnet.core.errors import ConfigError
from residnet.physics.environment_config import ForceRaoConfig, HullBoxConfig, WavesConfig
from residnet.physics.force_rao import read_wamit_excitation

LENGTH = 10.0
SPECIFIC_WEIGHT = 1025.0 * 9.81
BOX = HullBoxConfig(length=30.0, breadth=8.0, draught=2.0)


def _box_response(omega: float, beta_deg: float) -> dict[int, complex]:
    """Return the Froude-Krylov loads of a box by the mode of WAMIT, from the pressure integral.

    Axes and phase of WAMIT: pressure rho g exp(k z + i (omega t - k x cos beta - k y sin beta)).
    """
    k = omega**2 / 9.81
    beta = math.radians(beta_deg)
    x = (np.arange(600) + 0.5) / 600 * BOX.length - BOX.length / 2
    y = (np.arange(300) + 0.5) / 300 * BOX.breadth - BOX.breadth / 2
    z = -(np.arange(300) + 0.5) / 300 * BOX.draught

    def wave(x: np.ndarray | float, y: np.ndarray | float) -> np.ndarray:
        return np.asarray(np.exp(-1j * k * (x * math.cos(beta) + y * math.sin(beta))))

    decay = float(np.exp(k * z).mean()) * BOX.draught
    arm = float((z * np.exp(k * z)).mean()) * BOX.draught
    # pressure acts inwards on the bow (x = L/2), the stern and both sides
    ends = wave(-BOX.length / 2, y) - wave(BOX.length / 2, y)
    sides = wave(x, -BOX.breadth / 2) - wave(x, BOX.breadth / 2)
    bottom = wave(x[:, None], y[None, :]) * math.exp(-k * BOX.draught)
    area = BOX.length * BOX.breadth
    return {
        1: ends.mean() * BOX.breadth * decay,
        2: sides.mean() * BOX.length * decay,
        # roll about x is y F_z - z F_y
        4: (y[None, :] * bottom).mean() * area - sides.mean() * BOX.length * arm,
        # yaw about z is x F_y - y F_x
        6: (x * sides).mean() * BOX.length * decay - (y * ends).mean() * BOX.breadth * decay,
    }


def _write_table(path: Path, directions: list[float], header: bool = False) -> Path:
    lines = ["PER BETA I MOD PHA RE IM"] if header else []
    for omega in np.linspace(0.25, 4.0, 120):
        for beta in directions:
            for mode, force in _box_response(omega, beta).items():
                value = force / LENGTH ** (2 if mode < 4 else 3)
                lines.append(
                    f"{2 * math.pi / omega:.8E} {beta:.3E} {mode} {abs(value):.8E}"
                    f" {math.degrees(np.angle(value)):.8E} {value.real:.8E} {value.imag:.8E}"
                )
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize(
    "directions", [[15.0 * i for i in range(13)], [15.0 * i for i in range(24)]]
)
def test_table_of_a_box_gives_the_loads_of_the_closed_form(
    tmp_path: Path, directions: list[float]
) -> None:
    path = _write_table(tmp_path / "box.3", directions, header=True)
    settings = {"significant_height": 1.0, "peak_period": 6.0, "direction": 0.7}
    table = WavesConfig(**settings, force_rao=ForceRaoConfig(file=path, unit_length=LENGTH))
    box = WavesConfig(**settings, hull=BOX)
    loads = []
    for waves in (table, box):
        sea = waves.build(3, np.random.default_rng(0))
        north = torch.tensor([0.0, 20.0, -7.0], dtype=torch.float64)
        psi = torch.tensor([0.0, 1.9, -2.2], dtype=torch.float64)
        loads.append(
            torch.stack([sea(north, 2 * north, psi, t) for t in np.arange(0.0, 30.0, 0.5)])
        )
    scale = loads[1].square().mean((0, 1)).sqrt()
    error = (loads[0] - loads[1]).square().mean((0, 1)).sqrt() / scale
    assert float(error.max()) < 0.02


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("8 0 1 1 0 1\n", "row 1: expected the 7 numbers"),
        ("8 0 1 1 0 1 0\n", "1 wave periods, expected at least 2"),
        ("8 0 1 1 0 1 0\n9 0 1 1 0 1 0\n", "no row for period 9 s, direction 0 deg, mode 2"),
        ("8 0 1 1 0 1 0\n8 0 1 1 0 2 0\n", "row 2: mode 1 at period 8 s"),
    ],
)
def test_invalid_tables_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "hull.3"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=message):
        read_wamit_excitation(path, LENGTH, SPECIFIC_WEIGHT)


def test_uneven_directions_and_a_short_table_are_refused(tmp_path: Path) -> None:
    path = _write_table(tmp_path / "uneven.3", [0.0, 20.0, 90.0])
    with pytest.raises(ConfigError, match="expected equal steps from 0 deg"):
        read_wamit_excitation(path, LENGTH, SPECIFIC_WEIGHT)
    path = _write_table(tmp_path / "short.3", [0.0, 90.0, 180.0])
    waves = WavesConfig(
        significant_height=1.0,
        peak_period=30.0,
        direction=0.0,
        force_rao=ForceRaoConfig(file=path, unit_length=LENGTH),
    )
    with pytest.raises(ConfigError, match="extend the table or change the peak period"):
        waves.build(1, np.random.default_rng(0))
    with pytest.raises(ValueError, match="either hull"):
        WavesConfig(significant_height=1.0, peak_period=6.0, direction=0.0)

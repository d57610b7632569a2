"""First-order wave loads from WAMIT files."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from residnet.core.config import validate_config
from residnet.core.errors import ConfigError
from residnet.manoeuvres.trials import simulate_trials
from residnet.manoeuvres.trials_config import SimulatedTrials
from residnet.physics.environment_config import ForceRaoConfig, HullBoxConfig, WavesConfig
from residnet.physics.force_rao import read_wamit_excitation
from residnet.tasks.simulate.config import SimulateConfig

LENGTH = 10.0
SPECIFIC_WEIGHT = 1025.0 * 9.81
BOX = HullBoxConfig(length=30.0, breadth=8.0, draught=2.0)
SEA: dict[str, Any] = {"significant_height": 1.0, "peak_period": 6.0, "direction": 0.7}


def _box_response(omega: np.ndarray, beta_deg: np.ndarray) -> np.ndarray:
    """Return the Froude-Krylov loads of a box over rho g in WAMIT's modes 1, 2, 4, 6 [F, D, 4].

    Axes and phase of WAMIT: pressure rho g exp(k z + i (omega t - k x cos beta - k y sin beta)),
    integrated over the walls and the bottom by Gauss-Legendre quadrature.
    """
    nodes, weights = np.polynomial.legendre.leggauss(40)
    x = nodes * BOX.length / 2
    y = nodes * BOX.breadth / 2
    z = (nodes - 1.0) * BOX.draught / 2
    k = (omega**2 / 9.81)[:, None]
    beta = np.radians(beta_deg)
    along = k * np.cos(beta)
    across = k * np.sin(beta)
    wave_x = np.exp(-1j * along[..., None] * x)
    wave_y = np.exp(-1j * across[..., None] * y)
    # integrals along each edge of the box
    sum_x = wave_x @ weights * BOX.length / 2
    sum_y = wave_y @ weights * BOX.breadth / 2
    moment_x = (wave_x * x) @ weights * BOX.length / 2
    moment_y = (wave_y * y) @ weights * BOX.breadth / 2
    decay = np.exp(k[..., None] * z) @ weights * BOX.draught / 2
    arm = (np.exp(k[..., None] * z) * z) @ weights * BOX.draught / 2
    # pressure acts inwards on the bow (x = L/2), the stern and both sides
    ends = np.exp(0.5j * along * BOX.length) - np.exp(-0.5j * along * BOX.length)
    sides = np.exp(0.5j * across * BOX.breadth) - np.exp(-0.5j * across * BOX.breadth)
    roll_bottom = sum_x * moment_y * np.exp(-k * BOX.draught)
    loads = [
        ends * sum_y * decay,
        sides * sum_x * decay,
        # roll about x is y F_z - z F_y
        roll_bottom - sides * sum_x * arm,
        # yaw about z is x F_y - y F_x
        sides * moment_x * decay - ends * moment_y * decay,
    ]
    return np.stack(loads, axis=-1)


def _write_table(
    path: Path, directions: np.ndarray, n_frequencies: int = 240, header: bool = False
) -> Path:
    omega = np.linspace(0.25, 4.2, n_frequencies)
    response = _box_response(omega, directions)
    lines = ["PER BETA I MOD PHA RE IM"] if header else []
    for i, frequency in enumerate(omega):
        for j, direction in enumerate(directions):
            for k, mode in enumerate((1, 2, 4, 6)):
                value = response[i, j, k] / LENGTH ** (2 if mode < 4 else 3)
                lines.append(
                    f"{2 * math.pi / frequency:.10E} {direction:.3E} {mode} {abs(value):.10E}"
                    f" {math.degrees(np.angle(value)):.8E} {value.real:.10E} {value.imag:.10E}"
                )
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def _table_error(
    path: Path, omega: np.ndarray, beta_deg: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return errors and exact loads over rho g of a table, body axes, [F, D, 4]."""
    table = read_wamit_excitation(path, LENGTH, SPECIFIC_WEIGHT)
    cosine, sine = table.fourier_coefficients(omega)
    # clockwise angles of body axes are the negative of WAMIT's
    angles = -np.radians(beta_deg)[:, None] * np.arange(cosine.shape[-1])
    loads = cosine @ np.cos(angles).T + sine @ np.sin(angles).T
    # x forward stays; y and z change their sign, and with them sway force and yaw moment
    exact = _box_response(omega, beta_deg) * (1.0, -1.0, 1.0, -1.0)
    return np.swapaxes(loads, 1, 2) / SPECIFIC_WEIGHT - exact, exact


@pytest.mark.parametrize("range_deg", [180.0, 345.0])
def test_read_wamit_excitation_equals_pressure_integral_at_nodes(
    tmp_path: Path, range_deg: float
) -> None:
    """Unit length, axes, phase and the mirror of the directions, for each mode by itself."""
    directions = np.arange(0.0, range_deg + 1.0, 15.0)
    path = _write_table(tmp_path / "box.3", directions, 80, header=True)
    error, exact = _table_error(path, np.linspace(0.25, 4.2, 80), 15.0 * np.arange(24))
    scale = np.abs(exact).max(axis=(0, 1))
    np.testing.assert_array_less(np.abs(error).max(axis=(0, 1)), 1e-8 * scale)


def test_fourier_coefficients_converge_with_the_steps_of_the_table(tmp_path: Path) -> None:
    """The error is of second order in the frequency, and in the direction it is one of aliasing:
    orders beyond half the number of directions, which occur above k L / 2 of about this order.
    """
    random = np.random.default_rng(0)
    beta_deg = random.uniform(-180.0, 180.0, 50)

    def relative_error(step_deg: float, n_frequencies: int, omega: np.ndarray) -> np.ndarray:
        directions = np.arange(0.0, 180.1, step_deg)
        path = _write_table(tmp_path / "box.3", directions, n_frequencies)
        error, exact = _table_error(path, omega, beta_deg)
        squares = [np.abs(values**2).mean(axis=(0, 1)) for values in (error, exact)]
        return np.asarray(np.sqrt(squares[0] / squares[1]))

    # k L / 2 is 3.4 at 1.5 rad/s and 17 at 3.3 rad/s; 15 deg have orders up to 12, 6 deg up to 30
    long_waves = np.linspace(0.5, 1.5, 40)
    short_waves = np.linspace(2.8, 3.3, 40)
    coarse, fine = (relative_error(15.0, n, long_waves) for n in (61, 121))
    np.testing.assert_allclose(coarse / fine, 4.0, rtol=0.1)
    assert fine.max() < 1e-3
    assert relative_error(15.0, 481, short_waves).min() > 0.1
    assert relative_error(6.0, 481, short_waves).max() < 2e-3


@pytest.mark.parametrize("range_deg", [180.0, 355.0])
def test_waves_of_a_table_equal_the_closed_form_of_a_box(tmp_path: Path, range_deg: float) -> None:
    """In steps of 15 deg, sway is wrong by 3.3 % and yaw by 2.9 %: waves shorter than a third of
    the hull need orders above 12 in the direction. In steps of 5 deg only the interpolation in
    frequency remains.
    """
    path = _write_table(tmp_path / "box.3", np.arange(0.0, range_deg + 1.0, 5.0), header=True)
    table = WavesConfig(**SEA, force_rao=ForceRaoConfig(file=path, unit_length=LENGTH))
    box = WavesConfig(**SEA, hull=BOX)
    loads = []
    for waves in (table, box):
        sea = waves.build(3, np.random.default_rng(0))
        north = torch.tensor([0.0, 20.0, -7.0], dtype=torch.float64)
        psi = torch.tensor([0.0, 1.9, -2.2], dtype=torch.float64)
        loads.append(
            torch.stack([sea(north, 2 * north, psi, t) for t in np.arange(0.0, 30.0, 0.5)])
        )
        if waves is table:
            # a compiled free run computes the same loads, also at other positions and headings
            traced = torch.jit.trace(sea, (north, 2 * north, psi, torch.tensor(1.5)))
            torch.testing.assert_close(
                traced(-north, north, psi + 1.0, torch.tensor(4.0)),
                sea(-north, north, psi + 1.0, 4.0),
            )
    scale = loads[1].square().mean((0, 1)).sqrt()
    error = (loads[0] - loads[1]).square().mean((0, 1)).sqrt() / scale
    assert float(error.max()) < 1e-3


def test_waves_build_refuses_coarse_directions(tmp_path: Path) -> None:
    path = _write_table(tmp_path / "box.3", np.arange(0.0, 181.0, 30.0))
    config = ForceRaoConfig(file=path, unit_length=LENGTH)
    with pytest.raises(ConfigError, match=r"steps of 30 deg do not resolve .* in steps of 15 deg"):
        WavesConfig(**SEA, force_rao=config).build(1, np.random.default_rng(0))
    # the same table resolves waves longer than the hull
    long_waves = SEA | {"peak_period": 16.0}
    WavesConfig(**long_waves, force_rao=config).build(1, np.random.default_rng(0))


def _trials(waves: dict[str, Any]) -> dict[str, Any]:
    return {
        "kind": "simulated",
        "vessel": "patrol_p06",
        "duration": 20,
        "step": 0.1,
        "substeps": 1,
        "trials": [{"kind": "constant", "drive": [0.4, 0.6], "steer": [0.3]}],
        "identification": {},
        "validation": {},
        "disturbance": {"waves": SEA | waves},
    }


def test_simulate_trials_in_waves_of_a_table(tmp_path: Path) -> None:
    """The compiled plant moves in the loads of the table as in those of the box."""
    path = _write_table(tmp_path / "box.3", np.arange(0.0, 181.0, 5.0))
    logs_by_hull = []
    for waves in (
        {"force_rao": {"file": str(path), "unit_length": LENGTH}},
        {"hull": BOX.model_dump()},
    ):
        config = validate_config(_trials(waves), SimulatedTrials, "here")
        logs_by_hull.append(
            [run.true_log for run in simulate_trials(config.draw_manoeuvres(), config)]
        )
    for log, reference in zip(*logs_by_hull, strict=True):
        for channel in ("u", "v", "r", "phi"):
            deviation = np.abs(log[channel] - reference[channel]).max()
            assert deviation < 2e-3 * np.ptp(reference[channel])


def test_simulate_run_records_the_checksum_of_the_table(tmp_path: Path) -> None:
    path = _write_table(tmp_path / "box.3", np.arange(0.0, 181.0, 10.0), 80)
    waves = {"force_rao": {"file": str(path), "unit_length": LENGTH}}
    content = {"task": "simulate", "name": "waves", "data": _trials(waves)}
    task = validate_config(content, SimulateConfig, "here")
    folder = tmp_path / "run"
    task.run(output_folder=folder, report=False)
    recorded = json.loads((folder / "provenance.json").read_text())["inputs"]
    assert list(recorded) == [str(path)]
    # an invalid table is refused by the check of the config, before any simulation
    path.write_text("8 0 1 1 0 1\n", encoding="utf-8")
    with pytest.raises(ConfigError, match="row 1: expected the 7 numbers"):
        validate_config(content, SimulateConfig, "here")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("8 0 1 1 0 1\n", "row 1: expected the 7 numbers"),
        ("8 0 1 1 0 1 0\n", "1 wave periods, expected at least 2"),
        ("8 0 1 1 0 1 0\n9 0 1 1 0 1 0\n", "no row for period 9 s, direction 0 deg, mode 2"),
        ("8 0 1 1 0 1 0\n8 0 1 1 0 2 0\n", "row 2: mode 1 at period 8 s"),
    ],
)
def test_read_wamit_excitation_refuses_invalid_tables(
    tmp_path: Path, text: str, message: str
) -> None:
    path = tmp_path / "hull.3"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=message):
        read_wamit_excitation(path, LENGTH, SPECIFIC_WEIGHT)


def test_read_wamit_excitation_refuses_uneven_and_short_tables(tmp_path: Path) -> None:
    path = _write_table(tmp_path / "uneven.3", np.array([0.0, 20.0, 90.0]))
    with pytest.raises(ConfigError, match="expected equal steps from 0 deg"):
        read_wamit_excitation(path, LENGTH, SPECIFIC_WEIGHT)
    path = _write_table(tmp_path / "short.3", np.array([0.0, 90.0, 180.0]))
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

"""Derivatives of known models, their standard errors by simulation, and their scaling."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from residnet.baselines.regressors_config import RegressorsConfig
from residnet.core.errors import UsageError
from residnet.core.samples import Samples
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.evaluation.derivatives import DerivativesFile, compute_derivatives
from residnet.physics.signals_config import SignalsConfig
from residnet.physics.similarity import Particulars, estimate_added_mass

SHIP = Particulars(
    length=7.0, speed=1.2, beam=1.27, draught=0.46, mass=3270.0, centre_of_gravity=0.24
)
TERMS = ("u", "v", "r", "n", "delta", "v^3", "v^2 r", "u v", "v|v|")
# derivatives of the force, SI, in the sway and yaw equations; the speed enters by u v
FORCES = {
    "Y": {"v": -300.0, "r": 900.0, "delta": -150.0, "v^3": -4000.0, "u v": -200.0},
    "N": {"v": -700.0, "r": -4000.0, "delta": 500.0, "v^2 r": -9000.0, "u v": -300.0},
    "X": {"u": -60.0, "n": 8.0},
}


def mass_matrix() -> np.ndarray:
    added = estimate_added_mass(SHIP)
    assert added is not None
    moment = SHIP.mass * SHIP.centre_of_gravity
    inertia = SHIP.mass * ((SHIP.gyradius * SHIP.length) ** 2 + SHIP.centre_of_gravity**2)
    return np.array(
        [
            [SHIP.mass + added.surge, 0.0, 0.0],
            [0.0, SHIP.mass + added.sway, moment + added.sway_yaw],
            [0.0, moment + added.yaw_sway, inertia + added.yaw],
        ]
    )


def centripetal() -> np.ndarray:
    """Coefficients [3, J] of C_RB(nu) nu in the terms: m U r, about the speed U."""
    table = np.zeros((3, len(TERMS)))
    table[1, TERMS.index("r")] = SHIP.mass * SHIP.speed
    table[2, TERMS.index("r")] = SHIP.mass * SHIP.centre_of_gravity * SHIP.speed
    return table


def theta_of(forces: dict[str, dict[str, float]]) -> torch.Tensor:
    table = np.array([[forces[axis].get(term, 0.0) for term in TERMS] for axis in "XYN"])
    return torch.from_numpy(np.linalg.solve(mass_matrix(), table - centripetal()))


def model_of(theta: torch.Tensor) -> tuple[ModelSpec, HybridDynamics]:
    spec = ModelSpec(
        name="baseline",
        role="baseline",
        signals=SignalsConfig(inputs=("n", "delta")),
        baseline=RegressorsConfig(terms=TERMS),
        dt=0.1,
        integrator="rk4",
        low=(0.8, -0.2, -0.1, 5.0, -0.5),
        high=(1.5, 0.2, 0.1, 12.0, 0.5),
    )
    model = spec.build()
    with torch.no_grad():
        model.baseline.theta.copy_(theta)
    return spec, model


def derive(theta: torch.Tensor | None = None, **settings: Any) -> DerivativesFile:
    spec, model = model_of(theta_of(FORCES) if theta is None else theta)
    particulars = settings.pop("particulars", SHIP)
    return compute_derivatives(spec, model, particulars, **settings)


def values(table: DerivativesFile) -> dict[str, float]:
    return {row.name: row.value for row in table.rows}


def test_compute_derivatives_of_a_known_force() -> None:
    found = values(derive(order=3))
    # u v contributes U to the first order
    assert found["Y_v"] == pytest.approx(-300.0 - 200.0 * SHIP.speed)
    assert found["N_v"] == pytest.approx(-700.0 - 300.0 * SHIP.speed)
    assert found["Y_uv"] == pytest.approx(-200.0)
    assert found["Y_r"] == pytest.approx(900.0)
    assert found["N_r"] == pytest.approx(-4000.0)
    assert found["N_delta"] == pytest.approx(500.0)
    assert found["Y_vvv"] == pytest.approx(-4000.0)
    assert found["N_vvr"] == pytest.approx(-9000.0)
    assert "Y_vvr" not in found, "a coefficient of zero is not listed"


def test_compute_derivatives_prime_values_are_forces_over_units() -> None:
    table = derive()
    row = next(row for row in table.rows if row.name == "N_r")
    unit = 0.5 * 1000.0 * SHIP.length**4 * SHIP.speed
    assert row.prime_i == pytest.approx(row.value / unit)
    assert row.prime_ii == pytest.approx(row.value / unit * SHIP.length / SHIP.draught)
    assert row.unit == "kg m^2 s^-1"


def test_compute_derivatives_operating_point_balances_resistance() -> None:
    table = derive()
    assert table.operating_point["n"] == pytest.approx(60.0 * SHIP.speed / 8.0)
    assert table.operating_point["delta"] == 0.0
    assert table.surge_imbalance == pytest.approx(0.0, abs=1e-12)


def test_compute_derivatives_scale_keeps_prime_values() -> None:
    model = derive()
    ship = derive(scale=50.0, density_ratio=1.025)
    for row, full_row in zip(model.rows, ship.rows, strict=True):
        assert full_row.prime_i == pytest.approx(row.prime_i, rel=1e-12)
        assert full_row.bis == pytest.approx(row.bis, rel=1e-12)
    assert values(ship)["Y_v"] == pytest.approx(values(model)["Y_v"] * 1.025 * 50.0**2.5)
    assert ship.mass_matrix is not None
    assert model.mass_matrix is not None
    assert ship.mass_matrix[2][2] == pytest.approx(model.mass_matrix[2][2] * 1.025 * 50.0**5)


def test_compute_derivatives_scale_follows_froude_law() -> None:
    """The full-scale forces of scaled motion are those of the model, scaled by Froude's law."""
    scale = 50.0
    model = derive(order=3)
    ship = derive(order=3, scale=scale)
    rng = np.random.default_rng(0)
    motion = {name: rng.normal() * 0.1 for name in ("u", "v", "r", "n", "delta")}
    factors = {"u": scale**0.5, "v": scale**0.5, "r": scale**-0.5, "n": scale**-0.5, "delta": 1.0}

    def force(table: DerivativesFile, by: dict[str, float]) -> np.ndarray:
        total = dict.fromkeys("XYN", 0.0)
        for row in table.rows:
            total[row.axis] += row.value * math.prod(by[name] for name in row.variables)
        return np.array([*total.values()])

    scaled_motion = {name: value * factors[name] for name, value in motion.items()}
    np.testing.assert_allclose(
        force(ship, scaled_motion), force(model, motion) * scale ** np.array([3, 3, 4]), rtol=1e-10
    )


def test_compute_derivatives_without_masses_are_of_accelerations() -> None:
    table = derive(particulars=Particulars(length=7.0, speed=1.2))
    theta = theta_of(FORCES)
    found = values(table)
    assert table.quantity == "acceleration"
    assert table.mass_matrix is None
    assert found["Y_delta/m"] == pytest.approx(float(theta[1, TERMS.index("delta")]))
    assert "Give mass, beam and draught" in " ".join(table.remarks)


def test_compute_derivatives_intervals_cover_the_truth() -> None:
    truth = values(derive())
    rng = np.random.default_rng(3)
    config = RegressorsConfig(terms=TERMS)
    n_covered = 0
    n_intervals = 0
    for _ in range(20):
        spec, model = model_of(theta_of(FORCES))
        low = np.array(spec.low)
        high = np.array(spec.high)
        z = torch.from_numpy(rng.uniform(low, high, (1200, 5)))
        with torch.no_grad():
            target = model.baseline(z) + 0.002 * torch.from_numpy(rng.normal(size=(1200, 3)))
        names = model.signals.names
        group = torch.arange(1200) // 30
        samples = Samples(z, target, group, group * 0.1, ("random",) * 40, names)
        solution = config.fit_solutions(model.baseline, samples)[0]
        model.baseline.load_state_dict(solution.state, strict=False)
        assert solution.covariance is not None
        free = model.baseline.free_indices()
        covariance = torch.block_diag(*solution.covariance)[free][:, free].tolist()
        for row in compute_derivatives(spec, model, SHIP, covariance=covariance).rows:
            if row.name in truth:
                assert row.ci95 is not None
                n_covered += row.ci95[0] <= truth[row.name] <= row.ci95[1]
                n_intervals += 1
    # binomial: 0.95 with a standard deviation of 0.014
    assert 0.90 <= n_covered / n_intervals <= 0.99


def test_compute_derivatives_correlation_equals_propagated_covariance() -> None:
    theta = theta_of(FORCES)
    spec, model = model_of(theta)
    free = model.baseline.free_indices().tolist()
    # a covariance of rank four, so that four differences give the covariance of the derivatives
    factor = np.random.default_rng(1).normal(size=(len(free), 4)) * 1e-3
    covariance = factor @ factor.T
    table = compute_derivatives(spec, model, SHIP, covariance=covariance.tolist())
    assert table.correlation is not None
    names = [*table.correlation]
    assert {"Y_v", "Y_r", "N_v", "N_r", "N_delta"} <= set(names)
    # the derivatives are linear in the coefficients, so that differences are exact
    before = values(table)
    changes = np.zeros((len(names), factor.shape[1]))
    for j, direction in enumerate(factor.T):
        changed = theta.flatten().clone()
        changed[free] += torch.from_numpy(direction)
        after = values(derive(changed.reshape(theta.shape)))
        changes[:, j] = [after[name] - before[name] for name in names]
    propagated = changes @ changes.T
    deviation = np.sqrt(np.diag(propagated))
    expected = propagated / np.outer(deviation, deviation)
    assert np.abs(expected - np.eye(len(names))).max() > 0.3
    np.testing.assert_allclose([*table.correlation.values()], expected, atol=1e-4)


def test_compute_derivatives_remarks_speed_outside_training_range() -> None:
    table = derive(particulars=Particulars(length=7.0, speed=3.0))
    assert "outside the training range" in table.remarks[0]


@pytest.mark.parametrize(
    ("key", "value"), [("order", 4), ("scale", 0.0), ("density_ratio", float("nan"))]
)
def test_compute_derivatives_refuses_invalid_settings(key: str, value: float) -> None:
    settings: dict[str, Any] = {key: value}
    with pytest.raises(UsageError, match=key):
        derive(**settings)


def test_compute_derivatives_refuses_covariance_of_another_size() -> None:
    with pytest.raises(UsageError, match="covariance"):
        derive(covariance=[[1.0]])


def test_derivatives_command_writes_derivatives_of_a_run(
    command: Any, tiny_run: Path, tmp_path: Path
) -> None:
    file = tmp_path / "derivatives.json"
    words = ("--length", "4.88 m", "--speed", "1.2 m/s", "--out", file)
    result = command("derivatives", tiny_run, *words)
    assert result.code == 0, result.err
    table = DerivativesFile.read(file)
    assert {"N_v/m", "N_r/m"} <= {row.name for row in table.rows}
    assert all(row.standard_error is not None for row in table.rows)
    refused = command("derivatives", tiny_run, "--length", "4.88 kg", "--speed", "1 m/s")
    assert refused.code == 2
    assert "length" in refused.err

"""Derivatives identified from a simulated Mariner next to those of its published coefficients."""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from made_samples import sampled

from residnet.baselines.base import ParametricBaseline
from residnet.baselines.regressors_config import RegressorsConfig
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.evaluation.derivatives import compute_derivatives
from residnet.identification.fitter import _free_covariance
from residnet.physics.plant import HullPlant, Plant
from residnet.physics.signals_config import SignalsConfig
from residnet.physics.similarity import Particulars
from residnet.physics.vessel import load_vessel

SHIP = Particulars(length=160.93, speed=7.7175, density=1025.0)
LOW = np.array([7.1, -0.6, -0.008, -0.35])
HIGH = np.array([8.335, 0.6, 0.008, 0.35])
# third-order Taylor series (Abkowitz 1964) without terms that port/starboard symmetry excludes
SURGE = (
    "1", "u", "u^2", "u^3", "v^2", "r^2", "v r", "delta^2", "u delta^2", "u^2 delta^2", "v delta",
    "u v delta",
)  # fmt: skip
TURN = (
    "1", "u", "u^2", "v", "r", "delta", "v^3", "v^2 r", "u v", "u r", "delta^3", "u delta",
    "u^2 delta", "v delta^2", "v^2 delta", "u^2 v", "u^2 r", "v r^2", "r^3", "r delta^2",
    "r^2 delta", "v r delta", "u delta^3", "u v^3",
)  # fmt: skip


@cache
def mariner() -> Plant:
    plant = load_vessel("mariner").build()
    assert isinstance(plant, HullPlant)
    return plant.without_environment()


def accelerations(z: torch.Tensor) -> torch.Tensor:
    """Accelerations of the ship [B, 3] at channels u, v, r, delta [B, 4]."""
    plant = mariner()
    x = plant.make_initial_state(len(z))
    names = list(plant.state_names)
    columns = dict(zip(("u", "v", "r", "delta"), z.T, strict=True))
    x = torch.stack([columns.get(name, x[:, i]) for i, name in enumerate(names)], dim=1)
    rate = plant.derivative(x, z[:, 3:])
    return torch.stack([rate[:, names.index(name)] for name in ("u", "v", "r")], dim=1)


def test_identified_derivatives_cover_those_of_the_published_coefficients() -> None:
    names = ("u", "v", "r", "delta")
    origin = torch.tensor([SHIP.speed, 0.0, 0.0, 0.0], dtype=torch.float64)
    # central differences [4, 3]: the accelerations are smooth
    steps = torch.diag(torch.from_numpy(1e-4 * (HIGH - LOW)))
    differences = accelerations(origin + steps) - accelerations(origin - steps)
    truth = (differences / (2.0 * steps.diagonal()[:, None])).T
    covered = []
    for seed in range(6):
        generator = np.random.default_rng(seed)
        z = torch.from_numpy(generator.uniform(LOW, HIGH, size=(1500, 4)))
        exact = accelerations(z).detach()
        noise = torch.from_numpy(generator.standard_normal(exact.shape)) * 0.1 * exact.std(0)
        config = RegressorsConfig(terms={"u": SURGE, "v": TURN, "r": TURN})
        spec = ModelSpec(
            name="baseline",
            role="baseline",
            signals=SignalsConfig(inputs=("delta",)),
            baseline=config,
            dt=1.0,
            integrator="rk4",
            low=tuple(LOW),
            high=tuple(HIGH),
        )
        model = spec.build()
        assert isinstance(model, HybridDynamics)
        baseline = model.baseline
        assert isinstance(baseline, ParametricBaseline)
        samples = sampled(z, exact + noise, names, groups=300)
        (solution,) = config.fit_solutions(baseline, samples)
        model.load_state_dict({"baseline.theta": solution.state["theta"]}, strict=False)
        covariance = _free_covariance(baseline, solution)
        assert covariance is not None
        table = compute_derivatives(spec, model, SHIP, covariance=covariance.tolist())
        rows = {row.name: row for row in table.rows}
        for i, axis in enumerate("XYN"):
            for j, variable in enumerate(names):
                row = rows.get(f"{axis}_{variable}/m")
                # surge is even in v, r and delta: these derivatives are exactly zero
                if row is None or (axis == "X" and variable != "u"):
                    continue
                assert row.ci95 is not None
                covered.append(row.ci95[0] <= float(truth[i, j]) <= row.ci95[1])
                prime = float(truth[i, j]) * _unit(row.prime_i, row.value)
                assert row.prime_i is not None
                assert abs(row.prime_i - prime) < 0.3 * abs(prime) + 3.0 * (row.prime_i_error or 0)
    assert len(covered) >= 48
    assert np.mean(covered) >= 0.9


def _unit(prime: float | None, value: float) -> float:
    assert prime is not None
    return prime / value

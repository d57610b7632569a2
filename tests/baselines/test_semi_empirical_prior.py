"""Semi-empirical derivatives as prior of regressors: few logs follow it, many logs leave it."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
import torch
from made_samples import sampled

from residnet.baselines.regressors import RegressorBaseline
from residnet.baselines.regressors_config import RegressorsConfig
from residnet.physics.similarity import Particulars, estimate_lateral_dynamics

NAMES = ("u", "v", "r", "delta")
SHIP = Particulars(length=7.0, speed=1.18, beam=1.27, draught=0.46, mass=3270.0)
TERMS: dict[Literal["u", "v", "r", "w", "p", "q"], tuple[str, ...]] = {
    "u": ("1", "u|u|", "v r"),
    "v": ("v", "r", "u v", "u r", "u|u| delta"),
    "r": ("v", "r", "u v", "u r", "u|u| delta"),
}


def make_truth(error: float) -> torch.Tensor:
    """Return coefficients [2, 5] of sway and yaw whose derivatives differ from the regressions."""
    dynamics = np.array(estimate_lateral_dynamics(SHIP)) * (1.0 + error)
    rudder = np.array([[-0.02], [0.02]])
    zeros = np.zeros((2, 2))
    return torch.from_numpy(np.hstack((zeros, dynamics / SHIP.speed, rudder)))


def fit(truth: torch.Tensor, n_samples: int, noise: float, *, has_prior: bool) -> torch.Tensor:
    """Return the derivatives [2, 2] of sway and yaw by v and r at the service speed."""
    generator = np.random.default_rng(3)
    r = generator.uniform(-0.06, 0.06, n_samples)
    # sway follows from yaw: their separate effects are hardly identifiable
    v = -2.5 * r + 0.004 * generator.standard_normal(n_samples)
    u = generator.uniform(1.0, 1.25, n_samples)
    delta = generator.uniform(-0.5, 0.5, n_samples)
    z = torch.from_numpy(np.column_stack((u, v, r, delta)))
    phi = torch.from_numpy(np.column_stack((v, r, u * v, u * r, u * u * delta)))
    lateral = phi @ truth.T
    target = torch.cat((0.0 * lateral[:, :1], lateral), dim=1)
    target += noise * torch.from_numpy(generator.standard_normal(target.shape))
    config = RegressorsConfig(terms=TERMS, ridge=1e-8, particulars=SHIP if has_prior else None)
    baseline = config.build(NAMES)
    assert isinstance(baseline, RegressorBaseline)
    samples = sampled(z, target, NAMES, groups=max(n_samples // 20, 4))
    (solution,) = config.fit_solutions(baseline, samples)
    theta = solution.state["theta"]
    columns = {term: k for k, term in enumerate(baseline.library.terms)}
    v_rates = theta[1:, columns["v"]] + SHIP.speed * theta[1:, columns["u v"]]
    r_rates = theta[1:, columns["r"]] + SHIP.speed * theta[1:, columns["u r"]]
    return torch.stack((v_rates, r_rates), dim=1)


def relative_error(estimate: torch.Tensor, truth: torch.Tensor) -> float:
    expected = SHIP.speed * truth[:, 2:4]
    return float(((estimate - expected) / expected).abs().max())


def test_few_noisy_samples_are_better_with_the_prior() -> None:
    truth = make_truth(0.1)
    without = relative_error(fit(truth, 80, 2e-3, has_prior=False), truth)
    with_prior = relative_error(fit(truth, 80, 2e-3, has_prior=True), truth)
    assert with_prior < 0.6 * without


def test_many_samples_leave_a_wrong_prior() -> None:
    truth = make_truth(1.0)
    assert relative_error(fit(truth, 20_000, 2e-4, has_prior=True), truth) < 0.05


def test_the_posterior_is_between_least_squares_and_the_regressions_in_yaw_by_sway() -> None:
    truth = make_truth(0.3)
    prior = torch.tensor(estimate_lateral_dynamics(SHIP), dtype=torch.float64)
    least_squares = fit(truth, 200, 1e-3, has_prior=False)
    posterior = fit(truth, 200, 1e-3, has_prior=True)
    # yaw by v is the least identifiable derivative
    assert (posterior - prior).abs()[1, 0] < (least_squares - prior).abs()[1, 0]


def test_particulars_without_a_beam_are_refused() -> None:
    with pytest.raises(ValueError, match="need beam, draught and mass"):
        RegressorsConfig(particulars=Particulars(length=7.0, speed=1.2))

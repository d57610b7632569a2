"""Nomoto's models: parameters of known lags, their errors, step responses in closed form, what a
refit may move.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch
from made_samples import sampled

from residnet.baselines.regressors import RegressorBaseline
from residnet.baselines.steering_config import NomotoBaselineConfig, NomotoSideslipBaselineConfig
from residnet.core.errors import FitError
from residnet.core.samples import Samples
from residnet.dynamics.hybrid import HybridDynamics
from residnet.engine.rollout import Rollout
from residnet.heads.base import ZeroHead
from residnet.physics.signals_config import SignalsConfig

NAMES = ("u", "v", "r", "n", "delta")
LAGS = {"T_u": 8.0, "K_u": 0.09, "b_u": -0.02, "T": 4.0, "K": 0.3, "b": 0.01}
SLIP = {"T_beta": 3.0, "K_beta": 5.0, "b_beta": 0.02}


def made(noise: float = 0.0, count: int = 600, groups: int = 12, seed: int = 0) -> Samples:
    rng = np.random.default_rng(seed)
    z = rng.normal(size=(count, 5)) * [0.3, 0.05, 0.05, 3.0, 0.3] + [0.6, 0, 0, 8, 0]
    u, v, r, n, delta = z.T
    surge = (-u + LAGS["K_u"] * n + LAGS["b_u"]) / LAGS["T_u"]
    sway = (-v - SLIP["K_beta"] * u * r + SLIP["b_beta"] * u) / SLIP["T_beta"]
    yaw = (-r + LAGS["K"] * delta + LAGS["b"]) / LAGS["T"]
    target = np.stack((surge, sway, yaw), axis=1)
    target += noise * rng.normal(size=target.shape) * [0.05, 0.02, 0.02]
    return sampled(z, target, NAMES, groups=groups)


def parameters(config: Any, samples: Samples) -> dict[str, Any]:
    table = config.fit_preferred(config.build(samples.names), samples)
    return {entry.term: entry for entry in table if entry.ratio is not None}


@pytest.mark.parametrize(
    ("config", "truth"),
    [(NomotoSideslipBaselineConfig(), LAGS | SLIP), (NomotoBaselineConfig(), LAGS)],
)
def test_parameters_of_known_lags_are_exact(config: Any, truth: dict[str, float]) -> None:
    found = {name: entry.value for name, entry in parameters(config, made()).items()}
    assert found == pytest.approx(truth, rel=1e-9)


def test_errors_of_parameters_are_their_spread() -> None:
    """T, K and b of many repetitions spread as the standard errors of one say: ratios need the
    coefficients' covariance.
    """
    runs = [
        parameters(NomotoSideslipBaselineConfig(), made(1.0, seed=seed, groups=40))
        for seed in range(60)
    ]
    for name in LAGS | SLIP:
        values = np.array([run[name].value for run in runs])
        claimed = np.sqrt(np.mean([run[name].standard_error ** 2 for run in runs]))
        assert 0.7 < claimed / values.std() < 1.4, name


def hybrid(config: NomotoBaselineConfig | NomotoSideslipBaselineConfig) -> HybridDynamics:
    signals = SignalsConfig(inputs=("n", "delta")).build()
    baseline = config.build(signals.names)
    config.fit_preferred(baseline, made())
    return HybridDynamics(signals, baseline, ZeroHead(), 0.05, "rk4")


def test_step_response_in_closed_form() -> None:
    """r = (K delta + b)(1 - exp(-t/T)); u likewise; side slip at constant speed follows r through
    its own lag.
    """
    model = hybrid(NomotoSideslipBaselineConfig())
    n = 8.0
    speed = LAGS["K_u"] * n + LAGS["b_u"]
    w = torch.tensor([n, 0.2], dtype=torch.float64).expand(1, 400, 2)
    x0 = torch.tensor([[0, 0, 0, speed, speed * SLIP["b_beta"], 0.0]], dtype=torch.float64)
    with torch.no_grad():
        states = Rollout(model)(x0, w, x0[:, :0])[0][0].numpy()
    t = 0.05 * np.arange(401)
    steady = LAGS["K"] * 0.2 + LAGS["b"]
    slow = LAGS["T"]
    fast = SLIP["T_beta"]
    r = steady * (1 - np.exp(-t / slow))
    lagged = 1 - (slow * np.exp(-t / slow) - fast * np.exp(-t / fast)) / (slow - fast)
    v = speed * (SLIP["b_beta"] - SLIP["K_beta"] * steady * lagged)
    np.testing.assert_allclose(states[:, 3], speed, rtol=1e-9)
    np.testing.assert_allclose(states[:, 5], r, atol=1e-8)
    np.testing.assert_allclose(states[:, 4], v, atol=1e-8)


def test_first_order_model_lets_sway_die_out_with_t() -> None:
    model = hybrid(NomotoBaselineConfig())
    x0 = torch.tensor([[0, 0, 0, 0.5, 0.1, 0.02]], dtype=torch.float64)
    with torch.no_grad():
        states = Rollout(model)(x0, torch.zeros(1, 200, 2, dtype=torch.float64), x0[:, :0])[0][0]
    assert float(states[-1, 4]) == pytest.approx(0.1 * math.exp(-10 / LAGS["T"]), rel=1e-6)


def test_a_refit_may_not_move_what_nothing_determines() -> None:
    """The decay of sway is no observation: a refit would make it grow where sway is left
    unexplained.
    """
    baseline = NomotoBaselineConfig().build(NAMES)
    terms = baseline.library.terms
    size = baseline.library.n_terms
    movable = {(i // size, terms[i % size]) for i in baseline.free_indices().tolist()}
    assert movable == {(0, "u"), (0, "n"), (0, "1"), (2, "r"), (2, "delta"), (2, "1")}
    assert len(NomotoSideslipBaselineConfig().build(NAMES).free_indices()) == 9


def test_parameters_follow_moved_coefficients() -> None:
    config = NomotoBaselineConfig()
    baseline = config.build(NAMES)
    table = config.fit_preferred(baseline, made())
    assert isinstance(baseline, RegressorBaseline)
    terms = baseline.library.terms
    with torch.no_grad():
        baseline.theta[2, terms.index("r")] = -0.5
        baseline.theta[2, terms.index("delta")] = 0.4
    errors = torch.full((baseline.free_indices().numel(),), 0.125, dtype=torch.float64)
    restated = baseline.refresh_table(table, errors)
    after = {(c.axis, c.term): c.value for c in restated}
    assert after["r_dot", "T"] == pytest.approx(2.0)
    assert after["r_dot", "K"] == pytest.approx(0.8)
    assert after["r_dot", "r"] == -0.5
    before = [c.standard_error for c in table if c.ratio is not None]
    assert [c.standard_error for c in restated if c.ratio is not None] == before
    assert [c.standard_error for c in restated if (c.axis, c.term) == ("r_dot", "r")] == [0.125]


def test_other_channels_and_manoeuvres() -> None:
    names = ("u", "v", "r", "tau_x", "tau_n")
    samples = dataclasses.replace(made(), names=names, kinds=("turning", "zigzag") * 6)
    spoiled = samples.target.clone()
    spoiled[samples.group % 2 == 0] = 99.0
    config = NomotoBaselineConfig(drive="tau_x", steer="tau_n", manoeuvres=("zigzag",))
    found = parameters(config, samples.with_target(spoiled))
    assert {name: entry.value for name, entry in found.items()} == pytest.approx(LAGS, rel=1e-9)


def test_what_does_not_settle_or_is_not_there_is_an_error() -> None:
    samples = made()
    unstable = samples.target.clone()
    unstable[:, 2] += samples.channel("r")
    with pytest.raises(FitError, match=r"needs a stable r, .* use a baseline"):
        parameters(NomotoBaselineConfig(), samples.with_target(unstable))
    with pytest.raises(FitError, match="turning"):
        parameters(NomotoBaselineConfig(manoeuvres=("turning",)), samples)

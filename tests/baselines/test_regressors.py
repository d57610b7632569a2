"""Baselines linear in their coefficients: exact on noise-free samples of a known model."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from made_samples import sampled

from residnet.baselines.given import StillConfig
from residnet.baselines.regressors import RegressorBaseline, RegressorsConfig
from residnet.core.config import validate
from residnet.core.errors import ConfigError, FitError
from residnet.core.samples import Samples

NAMES = ("u", "v", "r", "tau_x", "tau_n")
TRUTH = {
    "u": {"u": -0.5, "u|u|": -0.23, "v r": 1.58, "tau_x": 0.0028},
    "v": {"v": -0.44, "|u|v": -0.27, "u r": -0.63},
    "r": {"v": 0.1, "r": -0.71, "r|r|": -1.35, "tau_n": 7.9e-4, "1": 0.02},
}


def accelerations(z: np.ndarray) -> np.ndarray:
    u, v, r, tau_x, tau_n = z.T
    return np.stack(
        (
            -0.5 * u - 0.23 * u * abs(u) + 1.58 * v * r + 0.0028 * tau_x,
            -0.44 * v - 0.27 * abs(u) * v - 0.63 * u * r,
            0.1 * v - 0.71 * r - 1.35 * r * abs(r) + 7.9e-4 * tau_n + 0.02,
        ),
        axis=1,
    )


def made(noise: float = 0.0, count: int = 400, groups: int = 8) -> Samples:
    rng = np.random.default_rng(0)
    z = rng.normal(size=(count, 5)) * [1, 0.3, 0.3, 300, 200]
    target = accelerations(z) + noise * rng.normal(size=(count, 3))
    kinds = ["zigzag" if g % 2 else "constant" for g in range(groups)]
    return sampled(z, target, NAMES, groups=groups, kinds=kinds)


def test_exact_coefficients_from_noise_free_samples() -> None:
    config = RegressorsConfig.model_validate(
        {"terms": {axis: [*row] for axis, row in TRUTH.items()}}
    )
    baseline = config.build(NAMES)
    table = config.fit(baseline, made())
    assert [(entry.axis, entry.term) for entry in table] == [
        (f"{axis}_dot", term) for axis, row in TRUTH.items() for term in row
    ]
    for entry in table:
        assert entry.value == pytest.approx(TRUTH[entry.axis[0]][entry.term], rel=1e-10)
        assert entry.error < 1e-10 * max(abs(entry.value), 1.0)
    z = np.random.default_rng(1).normal(size=(2, 30, 5)) * [1, 0.3, 0.3, 300, 200]
    out = baseline(torch.from_numpy(z))
    np.testing.assert_allclose(
        out.reshape(-1, 3), accelerations(z.reshape(-1, 5)), rtol=1e-9, atol=1e-12
    )
    assert baseline(torch.from_numpy(z).float()).dtype == torch.float32


def test_terms_of_all_axes_and_the_linear_default() -> None:
    assert RegressorsConfig().build(NAMES).library.terms == ("1", *NAMES)
    config = RegressorsConfig(
        terms=("u", "u|u|", "v r", "tau_x", "v", "|u|v", "u r", "r", "r|r|", "tau_n", "1")
    )
    baseline = config.build(NAMES)
    for entry in config.fit(baseline, made()):
        assert entry.value == pytest.approx(TRUTH[entry.axis[0]].get(entry.term, 0.0), abs=1e-10)


def test_an_axis_uses_its_own_terms_only() -> None:
    baseline = RegressorsConfig(terms={"u": ("u",), "v": ("v",), "r": ("u", "r")}).build(NAMES)
    with torch.no_grad():
        baseline.theta.fill_(1.0)
    z = torch.tensor([[2.0, 3.0, 5.0, 0.0, 0.0]], dtype=torch.float64)
    assert baseline(z).tolist() == [[2.0, 3.0, 7.0]]


def test_standard_errors_cover_the_truth() -> None:
    config = RegressorsConfig.model_validate(
        {"terms": {axis: [*row] for axis, row in TRUTH.items()}}
    )
    table = config.fit(config.build(NAMES), made(noise=0.05, count=4000, groups=40))
    score = [(entry.value - TRUTH[entry.axis[0]][entry.term]) / entry.error for entry in table]
    assert max(map(abs, score)) < 4
    assert 0.5 < np.sqrt(np.mean(np.square(score))) < 1.6


def test_only_the_chosen_manoeuvres() -> None:
    samples = made()
    spoiled = samples.target.clone()
    spoiled[(samples.group % 2) == 0] = 99.0
    terms = {axis: tuple(row) for axis, row in TRUTH.items()}
    config = RegressorsConfig.model_validate(
        {"kind": "regressors", "terms": terms, "manoeuvres": ("zigzag",)}
    )
    for entry in config.fit(config.build(NAMES), samples.with_target(spoiled)):
        assert entry.value == pytest.approx(TRUTH[entry.axis[0]][entry.term], rel=1e-9)
    other = RegressorsConfig(manoeuvres=("turning",))
    with pytest.raises(FitError, match=r"turning.*kinds in the data: \['constant', 'zigzag'\]"):
        other.fit(other.build(NAMES), samples)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"terms": {"u": ["u"], "v": ["v"]}}, "all of u, v, r"),
        ({"ridge": -1.0}, "greater than or equal to 0"),
        ({"terms": ["u"], "order": 2}, "order"),
    ],
)
def test_wrong_configs(config: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        validate({"kind": "regressors", **config}, RegressorsConfig, "here")


def test_an_unknown_channel_is_a_config_error() -> None:
    with pytest.raises(ConfigError, match="no channel 'tau_y'"):
        RegressorsConfig(terms=("u", "tau_y")).build(NAMES)


def test_still_knows_nothing() -> None:
    baseline = StillConfig().build(NAMES)
    assert StillConfig().fit(baseline, made()) == []
    assert torch.equal(baseline(torch.randn(4, 7, 5)), torch.zeros(4, 7, 3))


@pytest.mark.parametrize("bounded", [False, True])
def test_derivatives_of_a_model_along_directions(bounded: bool) -> None:
    """By differences, inside the range in which the model is as fitted and far outside it."""
    baseline = RegressorBaseline([[*row] for row in TRUTH.values()], NAMES, bounded=bounded)
    torch.manual_seed(1)
    baseline.theta.data.normal_()
    if bounded:
        assert baseline.bound is not None
        baseline.bound.calibrate(made())
    z = torch.randn(40, 5, dtype=torch.float64) * torch.tensor([3.0, 0.9, 0.9, 900.0, 600.0])
    ahead = torch.randn(3, 40, 5, dtype=torch.float64)
    about = (baseline(z + 1e-6 * ahead) - baseline(z - 1e-6 * ahead)) / 2e-6
    torch.testing.assert_close(baseline.along(z, ahead), about, rtol=1e-6, atol=1e-6)
    if bounded:
        assert not torch.equal(baseline.bound.held(z), z)

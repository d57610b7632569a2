"""PLSR and ridge from moments against scikit-learn and explicit refits, and what they refuse."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from made_samples import NAMES, made, sampled
from sklearn.cross_decomposition import PLSRegression
from sklearn.linear_model import Ridge

from residnet.core.errors import FitError
from residnet.core.samples import Samples
from residnet.heads.base import ClosedFormHead
from residnet.heads.basis import BasisHead
from residnet.heads.kernel import KernelConfig
from residnet.heads.linear import PlsrConfig, RidgeConfig
from residnet.regression.shrinkage import pls_path

KINDS = [PlsrConfig, RidgeConfig]
N3, N5 = {"folds": 3}, {"folds": 5}


def calibrated(config: Any, samples: Samples | None = None) -> BasisHead:
    samples = samples or made()
    head = config.build(NAMES)
    assert isinstance(head, BasisHead)
    head.calibrate(samples)
    return head


def answer(head: ClosedFormHead, samples: Samples | None = None) -> np.ndarray:
    z = (samples or made()).z
    return np.asarray(head(z, z[:, :0])[0])


def reference(kind: Any, setting: float, x: np.ndarray, y: np.ndarray, new: np.ndarray) -> Any:
    """Predictions of scikit-learn: columns of X scaled to unit variance, those of Y centred."""
    if kind is PlsrConfig:
        scale = x.std(0, ddof=1)
        model: Any = PLSRegression(int(setting), scale=False, tol=1e-28, max_iter=10_000)
    else:
        scale = x.std(0)
        model = Ridge(alpha=setting * len(x), solver="svd")
    return model.fit(x / scale, y).predict(new / scale)


def test_full_order_is_ordinary_least_squares() -> None:
    for order, reached in ((22, 22), (100, 23)):
        head = calibrated(PlsrConfig(order=order))
        assert head.solve(made())["order"] == reached
    x, y = head.basis(made().z).numpy(), made().target.numpy()
    joined = np.concatenate((np.ones((len(x), 1)), x), axis=1)
    truth = joined @ np.linalg.lstsq(joined, y, rcond=None)[0]
    np.testing.assert_allclose(answer(head), truth, atol=1e-8)


def test_a_rank_deficient_basis_ends_the_path_early() -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(size=(100, 3)) @ rng.normal(size=(3, 6))
    y = rng.normal(size=(100, 2))
    x, y = x - x.mean(0), y - y.mean(0)
    path = pls_path(torch.from_numpy(x.T @ x), torch.from_numpy(x.T @ y), 6)
    assert 3 <= len(path) <= 6
    np.testing.assert_allclose(
        x @ path[2].numpy(), x @ np.linalg.lstsq(x, y, rcond=None)[0], atol=1e-9
    )
    assert bool(torch.isfinite(path).all())
    np.testing.assert_allclose(x @ path[-1].numpy(), x @ path[2].numpy(), atol=1e-6)


@pytest.mark.parametrize(
    ("config", "settings"),
    [
        (PlsrConfig(folds=4, max_order=6), range(1, 7)),
        (RidgeConfig(folds=4, penalties=(1e-6, 1e-3, 0.3, 100.0)), (1e-6, 1e-3, 0.3, 100.0)),
    ],
)
def test_cross_validation_equals_explicit_refits(config: Any, settings: Any) -> None:
    samples = made()
    target = samples.target.clone()
    # of one axis nothing can be learned: it takes its own penalty
    target[:, 1] = torch.randn(len(target), generator=torch.Generator().manual_seed(0)).double()
    samples = samples.with_target(target)
    head = calibrated(config, samples)
    notes = head.solve(samples)
    x, y = head.basis(samples.z).numpy(), samples.target.numpy()
    fold = np.unique(samples.group.numpy(), return_inverse=True)[1] % 4
    error = np.zeros((len(settings), 3))
    for f in range(4):
        own, rest = fold == f, fold != f
        for i, setting in enumerate(settings):
            predicted = reference(type(config), setting, x[rest], y[rest], x[own])
            error[i] += ((predicted - y[own]) ** 2).sum(0) / len(x)
    if isinstance(config, PlsrConfig):
        share = (error / y.var(0)).mean(1)
        np.testing.assert_allclose(notes["cross_validated_share"], share, rtol=1e-7)
        assert notes["order"] == int(np.argmin(share)) + 1
    else:
        np.testing.assert_allclose(notes["cross_validated_error"], error, rtol=1e-9)
        assert notes["penalty"] == [settings[i] for i in error.argmin(0)]
        assert notes["penalty"][1] == 100.0 > notes["penalty"][0]


@pytest.mark.parametrize("kind", [*KINDS, KernelConfig])
def test_few_manoeuvres_make_fewer_folds_unless_they_are_named(kind: Any) -> None:
    samples = made()
    few = samples.where(samples.group < 3)
    usual, three, five = (kind(**settings).build(NAMES) for settings in ({}, N3, N5))
    for head in (usual, three, five):
        head.calibrate(few)
    for head in (usual, three):
        head.solve(few)
    for name, value in three.state_dict().items():
        torch.testing.assert_close(usual.state_dict()[name], value, rtol=0, atol=0)
    with pytest.raises(FitError, match="5 folds need as many manoeuvres, the training data have 3"):
        five.solve(few)


def test_named_terms_and_features() -> None:
    head = calibrated(PlsrConfig(features=("u", "r"), terms=("u|u|", "u r", "r|r|"), order=3))
    z = made().z
    u, r = (z[:, i] / z[:, i].std(correction=0) for i in (0, 2))
    wanted = torch.stack((u * u.abs(), u * r, r * r.abs()), dim=1)
    np.testing.assert_allclose(head.basis(z), wanted, rtol=1e-12)
    assert list(head.library.terms) == ["u|u|", "u r", "r|r|"]


def test_free_runs_are_offered_every_order_and_none() -> None:
    """First the cross-validated order, then orders from one to the highest, each scikit-learn's,
    and a residual of zero.
    """
    head, samples = calibrated(PlsrConfig()), made()
    found = head.solutions(samples)
    orders = [solution.choice["order"] for solution in found]
    assert orders[0] == int(np.argmin(found[0].notes["cross_validated_share"])) + 1
    assert orders[1:9] == [1, 2, 3, 4, 5, 6, 7, 8]
    assert orders[-2:] == [23, 0]
    x, y = head.basis(samples.z).numpy(), samples.target.numpy()
    for solution, order in list(zip(found, orders, strict=True))[:9]:
        head.load_state_dict(solution.state, strict=False)
        truth = reference(PlsrConfig, order, x, y, x)
        np.testing.assert_allclose(answer(head), truth, atol=1e-8 * y.std())
    head.load_state_dict(found[-1].state, strict=False)
    assert not answer(head).any()


def test_free_runs_are_offered_one_penalty_for_all_axes_and_none() -> None:
    penalties = (1e-6, 1e-2, 1.0)
    head, samples = calibrated(RidgeConfig(penalties=penalties)), made()
    found = head.solutions(samples)
    assert [solution.choice["penalty"] for solution in found[1:]] == [
        *([penalty] * 3 for penalty in penalties),
        [],
    ]
    x, y = head.basis(samples.z).numpy(), samples.target.numpy()
    for solution, penalty in zip(found[1:], penalties, strict=False):
        head.load_state_dict(solution.state, strict=False)
        truth = reference(RidgeConfig, penalty, x, y, x)
        np.testing.assert_allclose(answer(head), truth, atol=1e-10)
    single = calibrated(RidgeConfig(penalties=penalties, choose="one_step")).solutions(samples)
    assert [solution.choice for solution in single] == [found[0].choice]
    assert len(calibrated(PlsrConfig(order=3)).solutions(samples)) == 1
    assert len(calibrated(PlsrConfig(choose="one_step")).solutions(samples)) == 1


def test_a_residual_of_nothing_is_left_out() -> None:
    head, samples = calibrated(PlsrConfig()), made()
    notes = head.solve(samples.with_target(torch.zeros_like(samples.target)))
    assert notes["order"] == 0
    assert not answer(head).any()


@pytest.mark.parametrize("kind", KINDS)
def test_columns_that_say_nothing_get_nothing(kind: Any) -> None:
    """A constant and a doubled column: no coefficient for the one, the same prediction without the
    other; NaN and few samples are errors.
    """
    random = torch.Generator().manual_seed(1)
    z = torch.randn(400, 5, generator=random, dtype=torch.float64)
    z[:, 3] = 0.1
    target = z[:, :3] @ torch.randn(3, 3, generator=random, dtype=torch.float64)
    of = sampled(z, target, NAMES, groups=10)

    def solved(terms: tuple[str, ...], samples: Samples = of) -> tuple[BasisHead, np.ndarray]:
        head = calibrated(kind(terms=terms, choose="one_step"), samples)
        head.solve(samples)
        return head, answer(head, samples)

    _, plain = solved(("u", "v", "r"))
    head, with_constant = solved(("u", "v", "r", "tau_x", "tau_x^2"))
    assert not bool(head.coefficients[3:].any())
    np.testing.assert_allclose(with_constant, plain, rtol=0, atol=1e-6)
    head, doubled = solved(("u", "v", "r", "u v", "v u"))
    assert float(head.coefficients.abs().max()) < 10
    np.testing.assert_allclose(doubled, plain, rtol=0, atol=1e-5)
    spoiled = z.clone()
    spoiled[7, 0] = torch.nan
    with pytest.raises(FitError, match="channel 'u' is not finite at sample 7"):
        solved(("v", "u"), replace(of, z=spoiled))
    with pytest.raises(FitError, match="10 samples do not determine 23 basis functions"):
        solved((), of.where(torch.arange(400) % 40 == 0))
    with pytest.raises(FitError, match="one run or segment only"):
        solved(("u",), sampled(z, target, NAMES))

"""PLSR from moments against scikit-learn's NIPALS at convergence, and explicit refits."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from made_samples import NAMES, made
from sklearn.cross_decomposition import PLSRegression

from residnet.core.errors import FitError
from residnet.heads.base import ClosedFormHead
from residnet.heads.basis import BasisHead
from residnet.heads.kernel import KernelConfig
from residnet.heads.linear import PlsrConfig, PlsrHead, RidgeConfig
from residnet.regression.shrinkage import pls_path


def sklearn_fit(x: np.ndarray, y: np.ndarray, order: int) -> PLSRegression:
    return PLSRegression(order, scale=False, tol=1e-28, max_iter=10_000).fit(x, y)


def basis(head: BasisHead, z: torch.Tensor) -> np.ndarray:
    return head.basis(z).numpy()


def fitted(**config: object) -> tuple[PlsrHead, dict[str, Any]]:
    samples = made()
    head = PlsrConfig.model_validate({"kind": "plsr", **config}).build(NAMES)
    assert isinstance(head, PlsrHead)
    head.calibrate(samples)
    return head, head.solve(samples)


@pytest.mark.parametrize("order", [1, 2, 3, 5, 8, 13, 20])
def test_equals_scikit_learn(order: int) -> None:
    """Columns of X scaled to unit variance, those of Y only centred."""
    head, notes = fitted(order=order)
    assert notes["order"] == order
    samples = made()
    x, y = basis(head, samples.z), samples.target.numpy()
    scale = x.std(0, ddof=1)
    truth = sklearn_fit(x / scale, y, order)
    coefficients = truth.coef_.T / scale[:, None]
    np.testing.assert_allclose(
        head.coefficients, coefficients, atol=1e-8 * np.abs(coefficients).max()
    )
    predicted = head(samples.z, samples.z[:, :0])[0].numpy()
    np.testing.assert_allclose(predicted, truth.predict(x / scale), atol=1e-8 * y.std())


def test_full_order_is_ordinary_least_squares() -> None:
    head, notes = fitted(order=22)
    assert notes["order"] == head.library.count - 1 == 22
    head, notes = fitted(order=100)
    assert notes["order"] == head.library.count
    samples = made()
    x, y = basis(head, samples.z), samples.target.numpy()
    joined = np.concatenate((np.ones((len(x), 1)), x), axis=1)
    truth = joined @ np.linalg.lstsq(joined, y, rcond=None)[0]
    np.testing.assert_allclose(head(samples.z, samples.z[:, :0])[0], truth, atol=1e-8)


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


def test_cross_validation_equals_explicit_refits() -> None:
    head, notes = fitted(folds=4, max_order=6)
    samples = made()
    x, y, group = basis(head, samples.z), samples.target.numpy(), samples.group.numpy()
    fold = np.unique(group, return_inverse=True)[1] % 4
    error = np.zeros((6, 3))
    for f in range(4):
        own, rest = fold == f, fold != f
        scale = x[rest].std(0, ddof=1)
        for order in range(1, 7):
            predicted = sklearn_fit(x[rest] / scale, y[rest], order).predict(x[own] / scale)
            error[order - 1] += ((predicted - y[own]) ** 2).sum(0)
    share = (error / len(x) / y.var(0)).mean(1)
    np.testing.assert_allclose(notes["cross_validated_share"], share, rtol=1e-7)
    assert notes["order"] == int(np.argmin(share)) + 1


def test_too_little_data_is_refused() -> None:
    samples = made()
    few = samples.where(samples.group < 3)
    head = PlsrConfig(folds=5).build(NAMES)
    head.calibrate(few)
    with pytest.raises(FitError, match="5 folds need as many manoeuvres, the training data have 3"):
        head.solve(few)
    short = samples.where(torch.arange(len(samples)) % 40 == 0)
    with pytest.raises(FitError, match="15 samples do not determine 23 basis functions"):
        head.solve(short)


@pytest.mark.parametrize("kind", [PlsrConfig, RidgeConfig, KernelConfig])
def test_few_manoeuvres_make_fewer_folds(
    kind: type[PlsrConfig] | type[RidgeConfig] | type[KernelConfig],
) -> None:
    samples = made()
    few = samples.where(samples.group < 3)
    usual, three = kind().build(NAMES), kind(folds=3).build(NAMES)
    for head in (usual, three):
        assert isinstance(head, ClosedFormHead)
        head.calibrate(few)
        head.solve(few)
    for name, value in three.state_dict().items():
        torch.testing.assert_close(usual.state_dict()[name], value, rtol=0, atol=0)


def test_named_terms_and_features() -> None:
    head = PlsrConfig(features=("u", "r"), terms=("u|u|", "u r", "r|r|"), order=3).build(NAMES)
    assert isinstance(head, PlsrHead)
    samples = made()
    head.calibrate(samples)
    head.solve(samples)
    u, r = (
        samples.z[:, 0] / samples.z[:, 0].std(correction=0),
        samples.z[:, 2] / samples.z[:, 2].std(correction=0),
    )
    np.testing.assert_allclose(
        head.basis(samples.z), torch.stack((u * u.abs(), u * r, r * r.abs()), dim=1), rtol=1e-12
    )
    assert list(head.library.terms) == ["u|u|", "u r", "r|r|"]


def test_free_runs_are_offered_every_order_and_none() -> None:
    """First the cross-validated order, then orders from one to the highest, each scikit-learn's,
    and a residual of zero.
    """
    samples = made()
    head = PlsrConfig().build(NAMES)
    assert isinstance(head, PlsrHead)
    head.calibrate(samples)
    found = head.solutions(samples)
    orders = [solution.choice["order"] for solution in found]
    assert orders[0] == int(np.argmin(found[0].notes["cross_validated_share"])) + 1
    assert orders[1:9] == [1, 2, 3, 4, 5, 6, 7, 8]
    assert orders[-2:] == [23, 0]
    x, y = basis(head, samples.z), samples.target.numpy()
    scale = x.std(0, ddof=1)
    for solution, order in list(zip(found, orders, strict=True))[:9]:
        head.load_state_dict(solution.state, strict=False)
        predicted = head(samples.z, samples.z[:, :0])[0].numpy()
        np.testing.assert_allclose(
            predicted, sklearn_fit(x / scale, y, order).predict(x / scale), atol=1e-8 * y.std()
        )
    head.load_state_dict(found[-1].state, strict=False)
    assert float(head(samples.z, samples.z[:, :0])[0].abs().max()) == 0.0


@pytest.mark.parametrize("config", [{"order": 3}, {"choose": "one_step"}])
def test_what_is_settled_is_not_offered(config: dict[str, object]) -> None:
    samples = made()
    head = PlsrConfig.model_validate({"kind": "plsr", **config}).build(NAMES)
    head.calibrate(samples)
    assert len(head.solutions(samples)) == 1


def test_a_residual_of_nothing_is_left_out() -> None:
    samples = made()
    head = PlsrConfig().build(NAMES)
    head.calibrate(samples)
    notes = head.solve(samples.with_target(torch.zeros_like(samples.target)))
    assert notes["order"] == 0
    assert float(head(samples.z, samples.z[:, :0])[0].abs().max()) == 0.0

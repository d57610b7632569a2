"""Ridge from moments against scikit-learn, and its cross-validation against explicit refits."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from made_samples import NAMES, made
from sklearn.linear_model import Ridge

from residnet.heads.linear import RidgeConfig, RidgeHead


def fitted(penalties: tuple[float, ...], folds: int = 5) -> tuple[RidgeHead, dict[str, Any]]:
    head = RidgeConfig(penalties=penalties, folds=folds).build(NAMES)
    assert isinstance(head, RidgeHead)
    head.calibrate(made())
    return head, head.solve(made())


def standardised(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return x / x.std(0), x.std(0)


@pytest.mark.parametrize("penalty", [1e-6, 1e-3, 0.1, 1.0, 10.0])
def test_equals_scikit_learn(penalty: float) -> None:
    head, notes = fitted((penalty,))
    assert notes["penalty"] == [penalty] * 3
    samples = made()
    x, y = head.basis(samples.z).numpy(), samples.target.numpy()
    scaled, scale = standardised(x)
    truth = Ridge(alpha=penalty * len(x), solver="svd").fit(scaled, y)
    coefficients = truth.coef_.T / scale[:, None]
    np.testing.assert_allclose(
        head.coefficients, coefficients, atol=1e-10 * np.abs(coefficients).max()
    )
    np.testing.assert_allclose(
        head(samples.z, samples.z[:, :0])[0], truth.predict(scaled), atol=1e-10
    )


def test_cross_validation_equals_explicit_refits() -> None:
    penalties = (1e-6, 1e-3, 1e-2, 0.3)
    head, notes = fitted(penalties, folds=4)
    samples = made()
    x, y = head.basis(samples.z).numpy(), samples.target.numpy()
    fold = np.unique(samples.group.numpy(), return_inverse=True)[1] % 4
    error = np.zeros((4, 3))
    for f in range(4):
        own, rest = fold == f, fold != f
        scaled, scale = standardised(x[rest])
        for i, penalty in enumerate(penalties):
            predicted = (
                Ridge(alpha=penalty * rest.sum(), solver="svd")
                .fit(scaled, y[rest])
                .predict(x[own] / scale)
            )
            error[i] += ((predicted - y[own]) ** 2).sum(0)
    np.testing.assert_allclose(notes["cross_validated_error"], error / len(x), rtol=1e-9)
    assert notes["penalty"] == [penalties[i] for i in error.argmin(0)]


def test_each_axis_takes_its_own_penalty() -> None:
    samples = made()
    target = samples.target.clone()
    target[:, 1] = torch.randn(
        len(samples), generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    head = RidgeConfig(penalties=(1e-6, 100.0)).build(NAMES)
    head.calibrate(samples)
    assert head.solve(samples.with_target(target))["penalty"] == [1e-6, 100.0, 1e-6]


def test_a_constant_basis_function_does_no_harm() -> None:
    head = RidgeConfig(terms=("u", "1", "v"), penalties=(1e-8,)).build(NAMES)
    assert isinstance(head, RidgeHead)
    samples = made()
    head.calibrate(samples)
    head.solve(samples)
    assert bool(torch.isfinite(head.coefficients).all())
    joined = np.concatenate((np.ones((len(samples), 1)), samples.z[:, :2].numpy()), axis=1)
    truth = joined @ np.linalg.lstsq(joined, samples.target.numpy(), rcond=None)[0]
    np.testing.assert_allclose(head(samples.z, samples.z[:, :0])[0], truth, atol=1e-6)


def test_free_runs_are_offered_one_penalty_for_all_axes_and_none() -> None:
    penalties = (1e-6, 1e-2, 1.0)
    samples = made()
    head = RidgeConfig(penalties=penalties).build(NAMES)
    head.calibrate(samples)
    found = head.solutions(samples)
    assert [solution.choice["penalty"] for solution in found[1:]] == [
        [penalty] * 3 for penalty in penalties
    ] + [[]]
    for solution, penalty in zip(found[1:], penalties, strict=False):
        alone, _ = fitted((penalty,))
        torch.testing.assert_close(solution.state["coefficients"], alone.coefficients)
        torch.testing.assert_close(solution.state["intercept"], alone.intercept)
    head.load_state_dict(found[-1].state, strict=False)
    assert float(head(samples.z, samples.z[:, :0])[0].abs().max()) == 0.0
    single = RidgeConfig(penalties=penalties, choose="one_step").build(NAMES)
    single.calibrate(samples)
    assert [solution.choice for solution in single.solutions(samples)] == [found[0].choice]

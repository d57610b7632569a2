"""Regressions of forces: PLSR against NIPALS of scikit-learn, the others against
scikit-learn, and what they refuse.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from pydantic import TypeAdapter
from sklearn.cross_decomposition import PLSRegression
from sklearn.linear_model import LinearRegression, Ridge

from residnet.core.errors import FitError
from residnet.documents.jervan2020.residual import Fit, Regression, RegressionConfig

TERMS = tuple("abcdef")


def made(n: int = 240, noise: float = 0.1, seed: int = 0) -> Regression:
    """Correlated columns of unlike scales, six folds; the outputs depend on four of the six."""
    random = np.random.default_rng(seed)
    latent = random.normal(size=(n, 4))
    x = (latent @ random.normal(size=(4, 6)) + 0.3 * random.normal(size=(n, 6))) * [
        1,
        10,
        0.1,
        1,
        5,
        0.5,
    ] + [0, 3, 1, 0, -2, 0]
    y = (
        x[:, :4] @ (random.normal(size=(4, 3)) / np.array([1, 10, 0.1, 1])[:, None])
        + noise * random.normal(size=(n, 3))
        + [1, 2, 3]
    )
    fold = torch.arange(n) * 6 // n
    test = tuple(torch.from_numpy(part[:60]) for part in (x, y))
    x_t = torch.from_numpy(x)
    return Regression(TERMS, x_t, torch.from_numpy(y), x_t.std(0), fold, (test[0], test[1]))


def fitted(data: Regression, **config: Any) -> Fit:
    return TypeAdapter(RegressionConfig).validate_python(config).fit(data)


def test_the_kernel_algorithm_equals_nipals_of_scikit_learn() -> None:
    data = made()
    for order in (1, 3, 6):
        other = PLSRegression(order, tol=1e-24, max_iter=20_000).fit(data.x.numpy(), data.y.numpy())
        mine = fitted(data, kind="plsr", order=order)
        np.testing.assert_allclose(
            mine.predict(data.x).numpy(), other.predict(data.x.numpy()), rtol=1e-6, atol=1e-7
        )


def test_errors_over_the_order_are_those_of_scikit_learn_with_folds_left_out() -> None:
    data = made()
    e, f, *_, std_y = data.standardised
    assert data.test is not None
    left_out, test = fitted(data, kind="plsr", order=2).orders.values()
    assert left_out.shape == test.shape == (6, 3)
    errors = []
    for fold in range(6):
        out = (data.fold == fold).numpy()
        other = PLSRegression(3, scale=False, tol=1e-24, max_iter=20_000)
        other.fit(e.numpy()[~out], f.numpy()[~out])
        errors.append((f.numpy()[out] - other.predict(e.numpy()[out])) * std_y.numpy())
    np.testing.assert_allclose(
        left_out[2].numpy(), np.square(np.concatenate(errors)).mean(0), rtol=1e-6
    )
    x, y = data.test
    model = fitted(data, kind="plsr", order=3)
    np.testing.assert_allclose(test[2], (y - model.predict(x)).square().mean(0), rtol=1e-6)
    assert not fitted(data, kind="ridge").orders


def test_full_order_is_least_squares() -> None:
    data = made()
    reference = LinearRegression().fit(data.x.numpy(), data.y.numpy())
    for config in ({"kind": "plsr", "order": 6}, {"kind": "ols"}):
        np.testing.assert_allclose(
            fitted(data, **config).coefficients.numpy(), reference.coef_.T, rtol=1e-7, atol=1e-9
        )
        np.testing.assert_allclose(
            fitted(data, **config).intercept.numpy(), reference.intercept_, rtol=1e-7
        )


def test_ridge_is_scikit_learns() -> None:
    data = made()
    e, f, *_ = data.standardised
    reference = Ridge(alpha=0.01 * len(e), fit_intercept=False).fit(e.numpy(), f.numpy())
    np.testing.assert_allclose(
        fitted(data, kind="ridge", penalty=0.01).pre.numpy(), reference.coef_.T, rtol=1e-8
    )


@pytest.mark.parametrize("kind", ["plsr", "surface", "ridge", "lasso", "elastic_net"])
def test_what_is_chosen_predicts_unseen_data(kind: str) -> None:
    found, unseen = fitted(made(noise=0.3), kind=kind), made(noise=0.3, seed=0)
    left = (unseen.y - found.predict(unseen.x)).var(0) / unseen.y.var(0)
    assert float(left.max()) < 0.2


def test_the_documents_own_choice_is_at_least_as_good_on_the_half_that_it_saw() -> None:
    data = made(noise=1.0)
    assert data.test is not None

    def error(choose: str) -> torch.Tensor:
        assert data.test is not None
        return (
            (data.test[1] - fitted(data, kind="surface", choose=choose).predict(data.test[0]))
            .square()
            .mean(0)
        )

    assert bool((error("test") <= error("least") + 1e-9).all())


def test_collinear_columns_are_named() -> None:
    data = made()
    x = data.x.clone()
    x[:, 4] = 2 * x[:, 1] + 1
    with pytest.raises(FitError, match="b, e are collinear"):
        fitted(Regression(TERMS, x, data.y, x.std(0), data.fold), kind="ols")


@pytest.mark.parametrize("apart", [0.0, 1e-13, 1e-9])
@pytest.mark.parametrize(
    "config",
    [
        {"kind": "plsr", "order": 8},
        {"kind": "surface", "choose": "least"},
        {"kind": "surface"},
        {"kind": "ridge"},
        {"kind": "lasso"},
    ],
    ids=lambda config: "_".join(map(str, config.values())),
)
def test_collinear_columns_make_no_garbage(config: dict[str, Any], apart: float) -> None:
    """Two columns that are others, or all but: coefficients stay of the size that they have without
    them, and so do the predictions.
    """
    data = made()
    noise = apart * torch.from_numpy(np.random.default_rng(1).normal(size=(len(data.x), 2)))
    more = torch.stack((data.x[:, 0], data.x[:, 1] / 10 - data.x[:, 2]), dim=1) + noise
    x = torch.cat((data.x, more), dim=1)
    both = Regression((*TERMS, "a_again", "of_b_and_c"), x, data.y, x.std(0), data.fold)
    plain, found = (
        fitted(Regression(TERMS, data.x, data.y, data.scale, data.fold), kind="ols"),
        fitted(both, **config),
    )
    assert float(found.coefficients.abs().max()) < 5 * float(plain.coefficients.abs().max())
    left = (plain.predict(data.x) - data.y).std(0)
    assert bool(((found.predict(x) - data.y).std(0) < 1.5 * left).all())


def test_clear_errors() -> None:
    data = made()
    spoiled = data.x.clone()
    spoiled[7, 2] = torch.nan
    with pytest.raises(FitError, match="'c' is not finite at sample 7"):
        Regression(TERMS, spoiled, data.y, data.scale, data.fold)
    with pytest.raises(FitError, match="5 samples do not determine 6"):
        Regression(TERMS, data.x[:5], data.y[:5], data.scale, data.fold[:5])
    single = Regression(TERMS, data.x, data.y, data.scale, torch.zeros_like(data.fold))
    for kind in ("plsr", "surface", "ridge", "lasso"):
        with pytest.raises(FitError, match="one run or segment only"):
            fitted(single, kind=kind)
    assert fitted(single, kind="plsr", order=2).notes["order"] == 2

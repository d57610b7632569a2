"""Regressions of forces on scaled columns against scikit-learn, and what they refuse."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from sklearn.cross_decomposition import PLSRegression
from sklearn.linear_model import LinearRegression, Ridge

from residnet.core.errors import FitError
from residnet.studies.jervan2020.residual import (
    ForceRegressionData,
    RegressionConfig,
    RegressionFit,
)

TERMS = tuple("abcdef")


def made(n: int = 240, noise: float = 0.1, seed: int = 0) -> ForceRegressionData:
    """Correlated columns of unlike scales, six folds; the outputs depend on four of the six."""
    random = np.random.default_rng(seed)
    size = np.array([1, 10, 0.1, 1, 5, 0.5])
    mixed = random.normal(size=(n, 4)) @ random.normal(size=(4, 6))
    x = (mixed + 0.3 * random.normal(size=(n, 6))) * size + [0, 3, 1, 0, -2, 0]
    y = x[:, :4] @ (random.normal(size=(4, 3)) / size[:4, None]) + [1, 2, 3]
    y = y + noise * random.normal(size=(n, 3))
    fold = torch.arange(n) * 6 // n
    x_t, y_t = torch.from_numpy(x), torch.from_numpy(y)
    return ForceRegressionData(TERMS, x_t, y_t, x_t.std(0), fold, (x_t[:60], y_t[:60]))


def fitted(data: ForceRegressionData, **config: Any) -> RegressionFit:
    return RegressionConfig.model_validate(config).fit(data)


def test_coefficients_are_those_of_scikit_learn() -> None:
    data = made()
    x, y = data.x.numpy(), data.y.numpy()
    for order in (1, 3, 6):
        other = PLSRegression(order, tol=1e-24, max_iter=20_000).fit(x, y)
        mine = fitted(data, kind="plsr", order=order).predict(data.x).numpy()
        np.testing.assert_allclose(mine, other.predict(x), rtol=1e-6, atol=1e-7)
    line = LinearRegression().fit(x, y)
    for found in (fitted(data, kind="plsr", order=6), fitted(data, kind="ols")):
        np.testing.assert_allclose(found.coefficients.numpy(), line.coef_.T, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(found.intercept.numpy(), line.intercept_, rtol=1e-7)
    e, f, *_ = (part.numpy() for part in data.standardised)
    found = fitted(data, kind="ridge")
    shrunk = Ridge(alpha=found.notes["penalty"] * len(e), fit_intercept=False).fit(e, f)
    np.testing.assert_allclose(found.scaled_coefficients.numpy(), shrunk.coef_.T, rtol=1e-6)


def test_errors_over_the_order_are_those_of_scikit_learn_with_folds_left_out() -> None:
    data = made()
    e, f, *_, std_y = (part.numpy() for part in data.standardised)
    assert data.test is not None
    left_out, test = fitted(data, kind="plsr", order=2).errors_by_order.values()
    assert left_out.shape == test.shape == (6, 3)
    errors = []
    for fold in range(6):
        out = (data.fold == fold).numpy()
        other = PLSRegression(3, scale=False, tol=1e-24, max_iter=20_000).fit(e[~out], f[~out])
        errors.append((f[out] - other.predict(e[out])) * std_y)
    wanted = np.square(np.concatenate(errors)).mean(0)
    np.testing.assert_allclose(left_out[2].numpy(), wanted, rtol=1e-6)
    x, y = data.test
    model = fitted(data, kind="plsr", order=3)
    np.testing.assert_allclose(test[2], (y - model.predict(x)).square().mean(0), rtol=1e-6)
    assert not fitted(data, kind="ridge").errors_by_order


@pytest.mark.parametrize("kind", ["plsr", "surface", "ridge", "lasso", "elastic_net"])
@pytest.mark.parametrize("apart", [None, 0.0, 1e-9])
def test_what_is_chosen_predicts_and_collinear_columns_make_no_garbage(
    kind: str, apart: float | None
) -> None:
    """Two more columns that are others, or all but: the coefficients keep their size."""
    data = made(noise=0.3)
    terms = TERMS
    x = data.x
    plain = fitted(data, kind="ols")
    if apart is not None:
        noise = apart * torch.from_numpy(np.random.default_rng(1).normal(size=(len(x), 2)))
        more = torch.stack((x[:, 0], x[:, 1] / 10 - x[:, 2]), dim=1) + noise
        x = torch.cat((x, more), dim=1)
        terms = (*TERMS, "a_again", "of_b_and_c")
    found = fitted(ForceRegressionData(terms, x, data.y, x.std(0), data.fold), kind=kind)
    assert float(found.coefficients.abs().max()) < 5 * float(plain.coefficients.abs().max())
    left = (plain.predict(data.x) - data.y).std(0)
    assert bool(((found.predict(x) - data.y).std(0) < 1.5 * left).all())


def test_the_documents_own_choice_is_at_least_as_good_on_the_half_that_it_saw() -> None:
    data = made(noise=1.0)
    assert data.test is not None
    x, y = data.test
    found = [fitted(data, kind="surface", choose=choose) for choose in ("test", "least")]
    own, least = ((y - one.predict(x)).square().mean(0) for one in found)
    assert bool((own <= least + 1e-9).all())


def test_what_cannot_be_fitted_is_refused() -> None:
    data = made()
    spoiled = data.x.clone()
    double = data.x.clone()
    spoiled[7, 2] = torch.nan
    with pytest.raises(FitError, match="'c' is not finite at sample 7"):
        ForceRegressionData(TERMS, spoiled, data.y, data.scale, data.fold)
    with pytest.raises(FitError, match="5 samples do not determine 6"):
        ForceRegressionData(TERMS, data.x[:5], data.y[:5], data.scale, data.fold[:5])
    double[:, 4] = 2 * double[:, 1] + 1
    with pytest.raises(FitError, match="b, e are collinear"):
        fitted(ForceRegressionData(TERMS, double, data.y, double.std(0), data.fold), kind="ols")
    single = ForceRegressionData(TERMS, data.x, data.y, data.scale, torch.zeros_like(data.fold))
    for kind in ("plsr", "surface", "ridge", "lasso"):
        with pytest.raises(FitError, match="at least two runs"):
            fitted(single, kind=kind)
    assert fitted(single, kind="plsr", order=2).notes["order"] == 2

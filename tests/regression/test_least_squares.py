"""Least squares: coefficients, conditions and errors against NumPy and scikit-learn in closed form,
and what is refused.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from sklearn.linear_model import Ridge

from residnet.core.errors import FitError
from residnet.regression.estimator import Solution
from residnet.regression.least_squares import LeastSquares

NAMES = ("a", "b", "c")


def solve(x: np.ndarray, y: np.ndarray, groups: int = 1, ridge: float = 0.0) -> Solution:
    group = torch.arange(len(x)) * groups // len(x)
    given = (torch.from_numpy(x), torch.from_numpy(y), group)
    (found,) = LeastSquares((ridge,)).fit(*given, names=NAMES)
    return found


def problem(count: int) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(count)
    x = random.normal(size=(count, 3)) * [1.0, 30.0, 0.02] + [0.5, 0.0, 0.0]
    return x, random.normal(size=(count, 2))


def test_ridge_is_a_share_of_each_column_s_energy() -> None:
    x, y = problem(200)
    fit = solve(x, y, 5, ridge=0.3)
    size = np.sqrt((x**2).mean(0))
    truth = Ridge(alpha=0.3 * 200, fit_intercept=False, tol=1e-14).fit(x / size, y).coef_ / size
    np.testing.assert_allclose(fit.coefficients, truth.T, rtol=1e-10)


@pytest.mark.parametrize("groups", [1, 7])
def test_coefficients_and_errors_in_closed_form(groups: int) -> None:
    """The textbook's with one manoeuvre; of clusters (X'X)^-1 sum_g X_g'e_g e_g'X_g (X'X)^-1 G / (G
    - 1), in the columns' own units.
    """
    x, y = problem(210)
    fit = solve(x, y, groups)
    wanted = np.linalg.lstsq(x, y, rcond=None)[0]
    np.testing.assert_allclose(fit.coefficients, wanted, rtol=1e-10)
    scaled = x / np.sqrt((x**2).mean(0))
    assert fit.notes["condition"] == pytest.approx(np.linalg.cond(scaled), rel=1e-9)
    bread = np.linalg.inv(x.T @ x)
    for k, e in enumerate((y - x @ wanted).T):
        scores = (x * e[:, None]).reshape(groups, -1, 3).sum(1)
        meat = scores.T @ scores * groups / max(groups - 1, 1)
        covariance = bread @ meat @ bread if groups > 1 else e @ e / 207 * bread
        np.testing.assert_allclose(fit.errors[:, k], np.sqrt(np.diag(covariance)), rtol=1e-9)


NOISE = np.random.default_rng(5).normal(size=(60, 3))


@pytest.mark.parametrize(
    ("x", "message"),
    [
        (np.ones((3, 3)), "3 samples do not determine 3 coefficients"),
        (NOISE * [1, 0, 1], "regressor 'b' is zero in all 60 samples"),
        (NOISE[:, [0, 1, 1]] * [1, 1, 3], r"'(b' and 'c|c' and 'b)'"),
    ],
)
def test_what_the_data_do_not_determine_is_refused(x: np.ndarray, message: str) -> None:
    with pytest.raises(FitError, match=message) as caught:
        solve(x, NOISE[: len(x), :1])
    assert "\n" not in str(caught.value)

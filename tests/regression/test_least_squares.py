"""Least squares: coefficients against NumPy and scikit-learn, standard errors against a Monte
Carlo, and what is refused.
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


def solve(
    x: torch.Tensor,
    y: torch.Tensor,
    group: torch.Tensor,
    *,
    names: tuple[str, ...],
    ridge: float = 0.0,
) -> Solution:
    (found,) = LeastSquares((ridge,)).fit(x, y, group, names=names)
    return found


def problem(groups: int, per: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    x = rng.normal(size=(groups * per, 3)) * [1.0, 30.0, 0.02] + [0.5, 0.0, 0.0]
    return x, np.repeat(np.arange(groups), per)


def test_coefficients_are_the_least_squares_ones() -> None:
    rng = np.random.default_rng(0)
    x, group = problem(5, 40, rng)
    y = rng.normal(size=(200, 2))
    fit = solve(torch.from_numpy(x), torch.from_numpy(y), torch.from_numpy(group), names=NAMES)
    np.testing.assert_allclose(fit.coefficients, np.linalg.lstsq(x, y, rcond=None)[0], rtol=1e-10)
    scaled = x / np.sqrt((x**2).mean(0))
    assert fit.notes["condition"] == pytest.approx(np.linalg.cond(scaled), rel=1e-9)


def test_ridge_is_a_share_of_each_column_s_energy() -> None:
    rng = np.random.default_rng(1)
    x, group = problem(5, 40, rng)
    y = rng.normal(size=(200, 1))
    fit = solve(
        torch.from_numpy(x), torch.from_numpy(y), torch.from_numpy(group), names=NAMES, ridge=0.3
    )
    size = np.sqrt((x**2).mean(0))
    truth = (
        Ridge(alpha=0.3 * 200, fit_intercept=False, tol=1e-14).fit(x / size, y).coef_.ravel() / size
    )
    np.testing.assert_allclose(fit.coefficients[:, 0], truth, rtol=1e-10)


def test_textbook_errors_with_one_manoeuvre() -> None:
    rng = np.random.default_rng(2)
    x, _ = problem(1, 80, rng)
    y = x @ [[1.0], [-2.0], [3.0]] + 0.1 * rng.normal(size=(80, 1))
    fit = solve(
        torch.from_numpy(x), torch.from_numpy(y), torch.zeros(80, dtype=torch.long), names=NAMES
    )
    residual = y[:, 0] - x @ np.linalg.lstsq(x, y[:, 0], rcond=None)[0]
    covariance = residual @ residual / 77 * np.linalg.inv(x.T @ x)
    np.testing.assert_allclose(fit.errors[:, 0], np.sqrt(np.diag(covariance)), rtol=1e-9)


def test_cluster_errors_in_closed_form() -> None:
    """(X'X)^-1 sum_g X_g'e_g e_g'X_g (X'X)^-1 G / (G - 1), in the columns' own units."""
    rng = np.random.default_rng(3)
    x, group = problem(7, 30, rng)
    y = rng.normal(size=(210, 2))
    fit = solve(torch.from_numpy(x), torch.from_numpy(y), torch.from_numpy(group), names=NAMES)
    bread = np.linalg.inv(x.T @ x)
    for k in range(2):
        e = y[:, k] - x @ np.linalg.lstsq(x, y[:, k], rcond=None)[0]
        scores = np.stack([x[group == g].T @ e[group == g] for g in range(7)])
        covariance = bread @ (scores.T @ scores) @ bread * 7 / 6
        np.testing.assert_allclose(fit.errors[:, k], np.sqrt(np.diag(covariance)), rtol=1e-9)


def test_errors_hold_for_correlated_residuals() -> None:
    """Monte Carlo: residuals with a memory of 50 samples; the claimed error is the scatter, where
    the textbook's is several times too small.
    """
    rng = np.random.default_rng(4)
    groups, per, runs = 40, 200, 150
    keep = np.exp(-1 / 50)
    t = np.arange(per) / 20
    x = np.concatenate(
        [
            np.stack((np.sin(0.3 * t + p), np.cos(0.2 * t + q)), axis=1)
            for p, q in rng.uniform(0, 6, size=(groups, 2))
        ]
    )
    group = torch.from_numpy(np.repeat(np.arange(groups), per))
    found, claimed, textbook = [], [], []
    for _ in range(runs):
        noise = np.empty((per, groups))
        noise[0] = rng.normal(size=groups)
        for k in range(1, per):
            noise[k] = keep * noise[k - 1] + np.sqrt(1 - keep**2) * rng.normal(size=groups)
        y = torch.from_numpy((x @ [1.0, -0.5] + noise.T.reshape(-1))[:, None])
        fit = solve(torch.from_numpy(x), y, group, names=("s", "c"))
        found.append(fit.coefficients[:, 0].numpy())
        claimed.append(fit.errors[:, 0].numpy())
        textbook.append(
            solve(torch.from_numpy(x), y, torch.zeros_like(group), names=("s", "c"))
            .errors[:, 0]
            .numpy()
        )
    scatter = np.std(found, axis=0)
    np.testing.assert_allclose(
        np.mean(found, axis=0), [1.0, -0.5], atol=4 * scatter.max() / np.sqrt(runs)
    )
    np.testing.assert_allclose(np.mean(claimed, axis=0), scatter, rtol=0.2)
    assert bool((np.mean(textbook, axis=0) < 0.4 * scatter).all())


@pytest.mark.parametrize(
    ("x", "message"),
    [
        (np.ones((3, 3)), "3 samples do not determine 3 coefficients"),
        (
            np.random.default_rng(5).normal(size=(50, 3)) * [1, 0, 1],
            "regressor 'b' is zero in all 50 samples",
        ),
    ],
)
def test_what_the_data_do_not_determine_is_refused(x: np.ndarray, message: str) -> None:
    with pytest.raises(FitError, match=message) as caught:
        solve(
            torch.from_numpy(x),
            torch.randn(len(x), 1, dtype=torch.float64),
            torch.zeros(len(x), dtype=torch.long),
            names=NAMES,
        )
    assert "\n" not in str(caught.value)


def test_collinear_regressors_are_named() -> None:
    z = np.random.default_rng(8).normal(size=(60, 2))
    x = np.stack((z[:, 0], z[:, 1], 3 * z[:, 1]), axis=1)
    with pytest.raises(FitError, match=r"'(b' and 'c|c' and 'b)'"):
        solve(
            torch.from_numpy(x),
            torch.randn(60, 1, dtype=torch.float64),
            torch.zeros(60, dtype=torch.long),
            names=NAMES,
        )

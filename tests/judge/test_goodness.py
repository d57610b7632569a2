"""Measures of fit against hand computation; pairs of models."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from made_series import autoregressive
from sklearn.metrics import r2_score

from residnet.judge.goodness import OneStep, measures, noise_variance, paired, table


def test_measures_are_the_corrected_equations() -> None:
    random = np.random.default_rng(0)
    target = random.normal(size=50) + 3
    residual = 0.3 * random.normal(size=50)
    rss, m, d = float((residual**2).sum()), 50, 4
    variance = noise_variance(residual, d)
    assert variance == pytest.approx(rss / 45)
    found = measures(residual, target, d, variance)
    r2 = r2_score(target, target - residual)
    assert found["rmse"] == pytest.approx(math.sqrt(rss / m))
    assert found["r2"] == pytest.approx(r2)
    assert found["r2_adjusted"] == pytest.approx(1 - (1 - r2) * 49 / 45)
    assert found["cp"] == pytest.approx((rss + 2 * d * variance) / m)
    assert found["aic"] == pytest.approx((rss + 2 * d * variance) / (m * variance))
    assert found["bic"] == pytest.approx((rss + math.log(m) * d * variance) / (m * variance))
    # with the model's own variance AIC says no more than d: why the richest model's is used
    assert found["aic"] == pytest.approx((m - d - 1 + 2 * d) / m)


def test_without_enough_samples_or_noise_there_is_no_measure() -> None:
    short = measures(np.ones(5), np.arange(5.0), 5, noise_variance(np.ones(5), 2))
    assert short["r2_adjusted"] is None
    assert noise_variance(np.ones(5), 5) == math.inf
    exact = measures(np.zeros(5), np.ones(5), 1, 0.0)
    assert (exact["r2"], exact["aic"], exact["bic"]) == (None, None, None)


def test_criteria_choose_the_true_polynomial() -> None:
    """Of nested least-squares fits, BIC has its least value at the true degree; the residual sum of
    squares never rises.
    """
    random = np.random.default_rng(1)
    x = np.linspace(-1, 1, 400)
    y = 1 + x - 2 * x**3 + 0.3 * random.normal(size=400)
    models = []
    for degree in range(1, 9):
        fit = np.polynomial.Polynomial.fit(x, y, degree)
        models.append(
            OneStep(
                f"p{degree}", "head", [degree] * 3, [np.repeat((y - fit(x))[:, None], 3, axis=1)]
            )
        )
    rows = [
        row
        for row in table(models, [np.repeat(y[:, None], 3, axis=1)], 0.1)
        if row["axis"] == "u_dot"
    ]
    assert min(rows, key=lambda row: row["bic"])["model"] == "p3"
    assert all(b["rmse"] <= a["rmse"] + 1e-12 for a, b in itertools.pairwise(rows))
    assert all(row["white_p"] > 1e-3 for row in rows[2:])
    assert rows[0]["white_p"] < 1e-3


def test_pairs_tell_correlated_models_apart_that_their_own_intervals_do_not() -> None:
    shared = autoregressive(0.9, 1, 3000, seed=7)[0]
    better, worse = 0.97 * shared, shared
    found = paired([better], [worse], "worse")
    assert found["mae"] == pytest.approx(-0.03 * np.abs(shared).mean())
    assert found["ratio"] == pytest.approx(0.97)
    assert found["excludes_zero"]
    rows = table(
        [
            OneStep(n, "head", [0] * 3, [np.repeat(s[:, None], 3, axis=1)], "worse")
            for n, s in (("better", better), ("worse", worse))
        ],
        [shared[:, None].repeat(3, 1)],
        0.1,
    )
    low, high = rows[0]["mae_ci95"]
    assert low < rows[1]["mae"] < high
    assert rows[0]["mae_ci95"][0] < rows[0]["mae_ci95_independent"][0]
    assert rows[0]["effective"] < 0.2 * rows[0]["samples"]
    same = paired([shared], [np.roll(autoregressive(0.9, 1, 3000, seed=8)[0], 1)], "other")
    assert not same["excludes_zero"]

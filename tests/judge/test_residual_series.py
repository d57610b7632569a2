"""Correlated residuals: autocovariances and whiteness from their definitions, block lengths from
theory, intervals by their coverage.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from made_series import autoregressive, coverage
from scipy import stats

from residnet.judge.goodness import (
    autocovariance,
    block_interval,
    independent_interval,
    ljung_box,
    memory,
)


def test_autocovariance_is_its_definition_and_does_not_cross_pieces() -> None:
    pieces = [np.array([1.0, 2.0, 4.0, 1.0]), np.array([3.0, -1.0])]
    mean = np.concatenate(pieces).mean()
    expected = [
        sum(float((p[k:] - mean) @ (p[: len(p) - k] - mean)) for p in pieces if len(p) > k) / 6
        for k in range(4)
    ]
    np.testing.assert_allclose(autocovariance(pieces, 3), expected, atol=1e-12)


def test_ljung_box_is_its_definition_and_fair_on_white_noise() -> None:
    x = autoregressive(0.3, 1, 200, seed=1)[0]
    centred = x - x.mean()
    rho = [float(centred[k:] @ centred[:-k]) / float(centred @ centred) for k in range(1, 6)]
    expected = 200 * 202 * sum(value**2 / (200 - k) for k, value in enumerate(rho, start=1))
    statistic, chance = ljung_box([x], 5)
    assert statistic == pytest.approx(expected)
    assert chance == pytest.approx(stats.chi2.sf(expected, 5))
    chances = [ljung_box([row], 20)[1] for row in autoregressive(0.0, 400, 1000, seed=2)]
    assert stats.kstest(chances, "uniform").pvalue > 0.01
    assert ljung_box([autoregressive(0.5, 1, 1000, seed=3)[0]], 20)[1] < 1e-20


@pytest.mark.parametrize("phi", [0.5, 0.8])
def test_block_length_and_effective_size_come_near_those_of_the_process(phi: float) -> None:
    """For an AR(1): long-run variance (1 + phi) / (1 - phi), optimal block (3/2 (2 phi / (1 -
    phi^2))^2 n)^(1/3).
    """
    n = 5000
    found = [memory([row]) for row in autoregressive(phi, 60, n, seed=4)]
    optimal = (1.5 * (2 * phi / (1 - phi**2)) ** 2 * n) ** (1 / 3)
    assert np.median([m.block for m in found]) == pytest.approx(optimal, rel=0.15)
    assert np.median([m.variance for m in found]) == pytest.approx((1 + phi) / (1 - phi), rel=0.1)
    assert np.median([m.effective for m in found]) == pytest.approx(
        n * (1 - phi) / (1 + phi), rel=0.1
    )


@pytest.mark.parametrize(("phi", "least"), [(0.0, 0.90), (0.8, 0.90), (0.95, 0.85)])
def test_intervals_cover(phi: float, least: float) -> None:
    """The interval of independent samples fails what moving blocks hold."""
    found = coverage(phi, 120, 1000, seed=11)
    assert found["mae"] >= least
    assert found["mean"] >= least
    assert phi == 0.0 or found["mae independent"] < least - 0.15


def test_pieces_count_like_one_series_and_are_not_crossed() -> None:
    rows = autoregressive(0.8, 20, 200, seed=5)
    pieces, joined = block_interval(list(rows)), block_interval([rows.ravel()])
    assert pieces.mean == pytest.approx(joined.mean)
    assert pieces.high - pieces.low == pytest.approx(joined.high - joined.low, rel=0.25)
    # constant pieces at different levels: a block that crossed would make values between
    low = block_interval([np.full(50, -1.0), np.full(50, 1.0)])
    assert low.low < 0 < low.high


def test_many_blocks_are_not_drawn_but_give_the_same_width() -> None:
    x = autoregressive(0.0, 1, 20_000, seed=6)[0]
    found, (low, high) = block_interval([x]), independent_interval(x)
    assert found.high - found.low == pytest.approx(high - low, rel=0.08)
    assert found.mean == pytest.approx(x.mean())


def test_a_series_too_short_has_no_bounds_and_a_constant_one_no_width() -> None:
    assert block_interval([np.array([1.0])]).high == math.inf
    constant = block_interval([np.full(100, 2.0)])
    assert (constant.low, constant.mean, constant.high) == (2.0, 2.0, 2.0)


def test_the_printed_interval_is_the_textbook_one() -> None:
    x = np.array([1.0, 2.0, 4.0, 7.0])
    low, high = independent_interval(x)
    expected = stats.t.interval(0.95, 3, loc=x.mean(), scale=stats.sem(x))
    assert (low, high) == pytest.approx(expected)

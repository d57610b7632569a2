"""Measures of one-step fit by hand, correlated residuals by definition, repeated stretches."""

from __future__ import annotations

import math

import numpy as np
import pytest
from made_logs import made
from made_series import autoregressive
from scipy import stats
from sklearn.metrics import r2_score

from residnet.evaluation.goodness import (
    FitMeasures,
    OneStepResiduals,
    assess_repeatability,
    block_bootstrap_interval,
    build_goodness_table,
    compute_autocovariance,
    compute_command_mismatch,
    estimate_noise_variance,
    estimate_serial_dependence,
    find_pairs,
    goodness_of_fit_measures,
    independent_confidence_interval,
    ljung_box_test,
    paired_mae_difference,
)
from residnet.evaluation.protocol import WindowProtocol
from residnet.preprocessing.prepare import PreparedLog


def test_measures_are_the_corrected_equations() -> None:
    random = np.random.default_rng(0)
    target = random.normal(size=50) + 3
    residual = 0.3 * random.normal(size=50)
    rss, m, d = float((residual**2).sum()), 50, 4
    variance = estimate_noise_variance(residual, d)
    assert variance == pytest.approx(rss / 45)
    r2 = r2_score(target, target - residual)
    assert goodness_of_fit_measures(residual, target, d, variance) == pytest.approx(
        FitMeasures(
            rmse=math.sqrt(rss / m),
            r2=r2,
            r2_adjusted=1 - (1 - r2) * 49 / 45,
            cp=(rss + 2 * d * variance) / m,
            aic=(rss + 2 * d * variance) / (m * variance),
            bic=(rss + math.log(m) * d * variance) / (m * variance),
        )
    )


def test_without_enough_samples_or_noise_there_is_no_measure() -> None:
    short = goodness_of_fit_measures(
        np.ones(5), np.arange(5.0), 5, estimate_noise_variance(np.ones(5), 2)
    )
    assert short.r2_adjusted is None
    assert estimate_noise_variance(np.ones(5), 5) == math.inf
    exact = goodness_of_fit_measures(np.zeros(5), np.ones(5), 1, 0.0)
    assert (exact.r2, exact.aic, exact.bic) == (None, None, None)


def test_pairs_tell_correlated_models_apart_that_their_own_intervals_do_not() -> None:
    shared = autoregressive(0.9, 1, 3000, seed=7)[0]
    better = 0.97 * shared
    worse = shared
    found = paired_mae_difference([better], [worse], "worse")
    assert found.mae == pytest.approx(-0.03 * np.abs(shared).mean())
    assert found.ratio == pytest.approx(0.97)
    assert found.excludes_zero
    models = [
        OneStepResiduals(name, "head", [size] * 3, [np.repeat(one[:, None], 3, axis=1)], "worse")
        for name, one, size in (("better", better, 0), ("worse", worse, 9))
    ]
    rows = build_goodness_table(models, [shared[:, None].repeat(3, 1)], 0.1)
    interval = rows[0].mae_ci95
    independent_interval = rows[0].mae_ci95_independent
    assert interval is not None
    assert independent_interval is not None
    low, high = interval
    assert low < rows[1].mae < high
    assert low < independent_interval[0]
    assert rows[0].effective < 0.2 * rows[0].samples
    assert rows[0].white_p < 1e-3
    # the noise is that of the model which leaves the least
    aic = goodness_of_fit_measures(worse, shared, 9, estimate_noise_variance(better, 0)).aic
    assert rows[1].aic == pytest.approx(aic)
    same = paired_mae_difference(
        [shared], [np.roll(autoregressive(0.9, 1, 3000, seed=8)[0], 1)], "other"
    )
    assert not same.excludes_zero


def test_autocovariance_is_its_definition_and_does_not_cross_pieces() -> None:
    pieces = [np.array([1.0, 2.0, 4.0, 1.0]), np.array([3.0, -1.0])]
    mean = np.concatenate(pieces).mean()
    expected = [
        sum(float((p[k:] - mean) @ (p[: len(p) - k] - mean)) for p in pieces if len(p) > k) / 6
        for k in range(4)
    ]
    np.testing.assert_allclose(compute_autocovariance(pieces, 3), expected, atol=1e-12)


def test_ljung_box_is_its_definition() -> None:
    x = autoregressive(0.3, 1, 200, seed=1)[0]
    centred = x - x.mean()
    rho = [float(centred[k:] @ centred[:-k]) / float(centred @ centred) for k in range(1, 6)]
    expected = 200 * 202 * sum(value**2 / (200 - k) for k, value in enumerate(rho, start=1))
    statistic, chance = ljung_box_test([x], 5)
    assert statistic == pytest.approx(expected)
    assert chance == pytest.approx(stats.chi2.sf(expected, 5))


def test_block_length_and_effective_size_come_near_those_of_the_process() -> None:
    """For an AR(1): long-run variance (1 + phi) / (1 - phi), optimal block (3/2 (2 phi / (1 -
    phi^2))^2 n)^(1/3).
    """
    n, phi = 5000, 0.8
    found = [estimate_serial_dependence([row]) for row in autoregressive(phi, 60, n, seed=4)]
    optimal = (1.5 * (2 * phi / (1 - phi**2)) ** 2 * n) ** (1 / 3)
    ratio = (1 + phi) / (1 - phi)
    assert np.median([m.block_length for m in found]) == pytest.approx(optimal, rel=0.15)
    assert np.median([m.variance for m in found]) == pytest.approx(ratio, rel=0.1)
    assert np.median([m.effective_size for m in found]) == pytest.approx(n / ratio, rel=0.1)


def test_blocks_hold_the_mean_of_correlated_samples_and_single_samples_do_not() -> None:
    rows = np.abs(autoregressive(0.8, 120, 1000, seed=11))
    spans = [
        (found.lower, found.upper) for found in (block_bootstrap_interval([row]) for row in rows)
    ]
    both = np.array([spans, [independent_confidence_interval(row) for row in rows]])
    truth = math.sqrt(2 / math.pi)
    in_blocks, alone = ((both[..., 0] <= truth) & (truth <= both[..., 1])).mean(axis=1)
    assert in_blocks >= 0.90
    assert alone < 0.75


def test_pieces_count_like_one_series_and_are_not_crossed() -> None:
    rows = autoregressive(0.8, 20, 200, seed=5)
    pieces = block_bootstrap_interval(list(rows))
    joined = block_bootstrap_interval([rows.ravel()])
    assert pieces.mean == pytest.approx(joined.mean)
    assert pieces.upper - pieces.lower == pytest.approx(joined.upper - joined.lower, rel=0.25)
    # constant pieces at different levels: a block that crossed would make values between
    low = block_bootstrap_interval([np.full(50, -1.0), np.full(50, 1.0)])
    assert low.lower < 0 < low.upper


def test_many_blocks_are_not_drawn_but_give_the_textbook_interval() -> None:
    x = autoregressive(0.0, 1, 20_000, seed=6)[0]
    found = block_bootstrap_interval([x])
    (low, high) = independent_confidence_interval(x)
    expected = stats.t.interval(0.95, len(x) - 1, loc=x.mean(), scale=stats.sem(x))
    assert (low, high) == pytest.approx(expected)
    assert found.upper - found.lower == pytest.approx(high - low, rel=0.08)
    assert found.mean == pytest.approx(x.mean())


def test_a_series_too_short_has_no_bounds_and_a_constant_one_no_width() -> None:
    assert block_bootstrap_interval([np.array([1.0])]).upper == math.inf
    constant = block_bootstrap_interval([np.full(100, 2.0)])
    assert (constant.lower, constant.mean, constant.upper) == (2.0, 2.0, 2.0)


STEP = 0.1
PROTOCOL = WindowProtocol(length=10.0, first=5.0)
SCALES = {"u": 0.1, "v": 0.05, "r": 0.02}


def pairs_of(*logs: PreparedLog) -> int:
    """How many stretches repeat a window under two commanded inputs."""
    return assess_repeatability(PROTOCOL, logs, 2, SCALES, STEP).pairs


def commands(seed: int, count: int) -> np.ndarray:
    """Random steps of revolutions and rudder, [T, 2]."""
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform([5, -0.6], [15, 0.6], (count // 20 + 1, 2)), 20, axis=0)[:count]


def states(count: int, heading: float = 0.0) -> np.ndarray:
    """A straight run at 1 m/s."""
    s = STEP * np.arange(1.0, count + 1)
    still = np.zeros(count)
    ahead = (s * np.cos(heading), s * np.sin(heading), still + heading, still + 1.0)
    return np.stack((*ahead, still, still), axis=1)


def test_mismatch_equals_a_loop() -> None:
    rng = np.random.default_rng(0)
    given = rng.normal(5, 2, (17, 2))
    series = rng.normal(5, 2, (90, 2))
    plain = [np.sqrt(((series[k : k + 17] - given) ** 2).mean(0)).max() for k in range(90 - 17 + 1)]
    np.testing.assert_allclose(compute_command_mismatch(given, series), plain, rtol=1e-9)
    assert compute_command_mismatch(series, given).shape == (0,)


def test_a_repeated_run_is_found_and_its_difference_measured() -> None:
    w = commands(0, 160)
    shifted = np.concatenate((commands(1, 40), w))
    first = made(states(160), STEP, w=w, name="first", kind="turning")
    second = states(200, heading=0.8)
    # the repeat starts 4 s later in the second log and differs from the 5th second on
    late = np.arange(200) >= 40 + 50 + 50
    second[late, 3:] += np.array([0.02, 0.01, 0.004])
    logs = [first, made(second, STEP, w=shifted, name="second", kind="turning")]
    (pair,) = find_pairs(PROTOCOL, logs, 2, np.array([0.1, 0.05, 0.02]), STEP)
    # without commands nothing says that two runs were to be the same
    assert not list(find_pairs(PROTOCOL, logs, 0, np.array([0.1, 0.05, 0.02]), STEP))
    assert (pair.window.log_index, pair.window.start, pair.repeat_log, pair.repeat_start) == (
        0,
        50,
        1,
        90,
    )
    assert pair.mismatch == pytest.approx(0, abs=1e-6)
    found = assess_repeatability(PROTOCOL, logs, 2, SCALES, STEP)
    share = np.sqrt(51 / 101)
    assert (found.pairs, found.logs) == (1, 2)
    assert [found.by_channel[name] for name in "uvr"] == pytest.approx(
        [0.02 * share, 0.01 * share, 0.004 * share]
    )
    assert found.nrmse == pytest.approx(0.2 * share)
    # both run 10 m ahead, whatever their heading
    assert found.position == pytest.approx(0, abs=1e-9)
    assert found.manoeuvres["turning"].pairs == 1


def test_other_commands_another_start_or_a_break_are_no_repeat() -> None:
    w = commands(0, 160)
    first = made(states(160), STEP, w=w)
    for column in (0, 1):
        for share, pairs in ((0.04, 1), (0.06, 0)):
            other = w.copy()
            # the range over all logs is wider by the share itself
            other[:, column] += share * np.ptp(w, axis=0)[column]
            assert pairs_of(first, made(states(160), STEP, w=other)) == pairs
    for offset, pairs in ((0.024, 1), (0.026, 0)):
        y = states(160)
        y[:, 3] += offset
        assert pairs_of(first, made(y, STEP, w=w)) == pairs
    # what nobody commands may differ
    calm, windy = (np.c_[w, np.full(160, wind)] for wind in (0.0, 50.0))
    assert pairs_of(made(states(160), STEP, w=calm), made(states(160), STEP, w=windy)) == 1
    broken = made(states(160), STEP, w=w, piece=np.repeat([0, 1], [100, 60]))
    found = assess_repeatability(PROTOCOL, [first, broken], 2, SCALES, STEP)
    assert found.pairs == found.logs == 0
    assert found.by_channel == {}


def test_a_log_repeats_itself_only_after_the_window() -> None:
    once = commands(3, 160)
    log = made(np.tile(states(1), (320, 1)), STEP, w=np.concatenate((once, once)))
    pairs = find_pairs(PROTOCOL, [log], 2, np.array([0.1, 0.05, 0.02]), STEP)
    assert [pair.repeat_start for pair in pairs if pair.window.start == 50] == [210]

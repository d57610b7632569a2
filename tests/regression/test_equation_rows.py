"""Rows of the weak form against sums written out and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from residnet.core.errors import ConfigError, FitError
from residnet.regression.equation_rows import (
    RegressionRows,
    WeakRows,
    effective_correlation_length,
    label_regular_segments,
    median_time_step,
)


def record() -> RegressionRows:
    random = np.random.default_rng(0)
    stretch = np.repeat([0, 1, 2], [100, 20, 80])
    return RegressionRows(random.normal(size=(200, 2)), random.normal(size=(200, 1)), stretch)


def test_windows_are_weighted_sums_within_stretches() -> None:
    sampled = record()
    rows = WeakRows(window=2.5, every=0.2).build_rows(sampled, 0.1)
    place = -1 + 2 * np.arange(1, 26) / 26
    weight = (1 - place**2) ** 2
    weight /= weight.sum()
    # stretches of 100, 20 and 80 samples: the second is shorter than a window
    starts = [*range(0, 76, 5), *range(120, 176, 5)]
    for found, given in ((rows.x, sampled.x), (rows.y, sampled.y)):
        expected = [weight @ given[k : k + 25] for k in starts]
        np.testing.assert_allclose(found, expected, atol=1e-14)
    assert rows.segment.tolist() == [2 * (k >= 120) for k in starts]


def test_windows_over_central_differences_are_integrals_by_parts() -> None:
    """Sum of w x_dot over a window equals minus the sum of the weights' own differences times x: no
    derivative of the record is left.
    """
    step = 0.1
    size = 30
    x = np.random.default_rng(1).normal(size=100)
    rate = (x[2:] - x[:-2]) / (2 * step)
    rows = WeakRows(window=size * step, every=1 / size).build_rows(
        RegressionRows(np.ones((98, 1)), rate[:, None], np.zeros(98, dtype=int)), step
    )
    place = np.linspace(-1, 1, size + 2)
    weight = np.concatenate(([0.0, 0.0], (1 - place[1:-1] ** 2) ** 2, [0.0, 0.0]))
    weight /= weight.sum()
    slope = (weight[2:] - weight[:-2]) / (2 * step)
    by_parts = [-(slope @ x[k : k + size + 2]) for k in range(len(rows.y))]
    np.testing.assert_allclose(rows.y[:, 0], by_parts, atol=1e-12)


def test_correlation_time_of_known_noise() -> None:
    random = np.random.default_rng(0)
    white = random.normal(size=(20000, 1))
    assert effective_correlation_length(white)[0] == pytest.approx(1.0, abs=0.1)
    for phi in (0.5, 0.9):
        noise = lfilter([1.0], [1.0, -phi], random.normal(size=(20000, 2)), axis=0)
        np.testing.assert_allclose(
            effective_correlation_length(noise), (1 + phi) / (1 - phi), rtol=0.15
        )
    # samples that take turns say more than independent ones; nothing below one is claimed
    assert effective_correlation_length(np.tile([[1.0], [-1.0]], (500, 1)))[0] == 1.0


def test_stretches_end_at_gaps_and_manoeuvres() -> None:
    t = np.array([0.0, 0.1, 0.2, 0.5, 0.6, 0.0, 0.1])
    group = np.array([0, 0, 0, 0, 0, 1, 1])
    assert median_time_step(group, t) == pytest.approx(0.1)
    assert label_regular_segments(group, t, 0.1).tolist() == [0, 0, 0, 1, 1, 2, 2]


def test_what_cannot_be_done_is_one_line() -> None:
    sampled = record()
    with pytest.raises(FitError, match=r"weak form: .* 19 s"):
        WeakRows(window=19.0).build_rows(sampled, 0.1)
    with pytest.raises(ConfigError, match=r"a window of 0\.2 s has 2 samples"):
        WeakRows(window=0.2).build_rows(sampled, 0.1)
    with pytest.raises(FitError, match="no manoeuvre has two samples"):
        median_time_step(np.array([0, 1, 2]), np.zeros(3))

"""Derivatives against closed forms and SciPy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.signal import savgol_filter

from residnet.core.config import validate_config
from residnet.core.errors import ConfigError
from residnet.preprocessing.derivatives import (
    DerivativeConfig,
    DerivativeRule,
    ForwardDifference,
    SavitzkyGolay,
)

STEP = 0.1
T = STEP * np.arange(200)
NOISE = np.random.default_rng(0).normal(size=(200, 3))
ONE = np.zeros(200, dtype=int)
RULES: list[tuple[DerivativeRule, int, np.ndarray, np.ndarray, list[int]]] = [
    (
        SavitzkyGolay(window=1.5, order=3),
        15,
        savgol_filter(NOISE, 15, 3, axis=0),
        savgol_filter(NOISE, 15, 3, deriv=1, delta=STEP, axis=0),
        [],
    ),
    (ForwardDifference(), 2, NOISE, np.diff(NOISE, axis=0, append=np.nan) / STEP, [199]),
]


@pytest.mark.parametrize(("rule", "shortest", "smooth", "rate", "invalid"), RULES)
def test_derivative_rules_return_expected_values(
    rule: DerivativeRule, shortest: int, smooth: np.ndarray, rate: np.ndarray, invalid: list[int]
) -> None:
    found = rule.derive(NOISE, STEP, ONE)
    assert np.flatnonzero(~found[2]).tolist() == invalid
    for got, expected in zip(found, (smooth, rate), strict=False):
        np.testing.assert_allclose(got[found[2]], expected[found[2]], rtol=0, atol=1e-10)
        assert np.isnan(got[~found[2]]).all()
    # pieces do not see each other, and samples of none have nothing
    pieces = np.repeat([0, 1, -1, 7, -1, 2], [60, 50, 1, 30, 9, 50])
    whole = rule.derive(NOISE, STEP, pieces)
    for number in (0, 1, 7, 2):
        at = pieces == number
        alone = rule.derive(NOISE[at], STEP, np.zeros(at.sum(), dtype=int))
        for a, b in zip(whole, alone, strict=True):
            np.testing.assert_allclose(a[at], b, rtol=0, atol=1e-12)
    assert not whole[2][pieces < 0].any()
    # a missing value splits its piece
    values = NOISE.copy()
    values[100, 1] = np.nan
    split = rule.derive(NOISE, STEP, np.repeat([0, -1, 1], [100, 1, 99]))
    for a, b in zip(rule.derive(values, STEP, ONE), split, strict=True):
        np.testing.assert_array_equal(a, b)
    assert rule.derive(NOISE[:shortest], STEP, ONE[:shortest])[2].any()
    assert not rule.derive(NOISE[: shortest - 1], STEP, ONE[: shortest - 1])[2].any()


def test_savitzky_golay_is_exact_for_polynomials() -> None:
    values = np.stack([1.0 + 2.0 * T - 0.3 * T**2, T**2], axis=1)
    pieces = np.repeat([0, -1, 1], [90, 20, 90])
    smooth, rate, valid = SavitzkyGolay(window=2.05, order=2).derive(values, STEP, pieces)
    np.testing.assert_array_equal(valid, pieces >= 0)
    np.testing.assert_allclose(smooth[valid], values[valid], atol=1e-9)
    slope = np.stack([2.0 - 0.6 * T, 2.0 * T], axis=1)
    np.testing.assert_allclose(rate[valid], slope[valid], atol=1e-8)
    for window, samples in ((1.5, 15), (1.4, 15), (2.05, 21), (0.3, 3)):
        assert SavitzkyGolay(window=window, order=1).n_window_samples(STEP) == samples


@pytest.mark.parametrize(
    ("config", "words"),
    [
        ({"kind": "savitzky_golay", "window": "0.2 s", "order": 3}, "set window to 0.5 s or"),
        ({"kind": "savitzky_golay", "window": -1}, "window"),
        ({"kind": "central"}, "central"),
    ],
)
def test_derivative_config_refuses_invalid_values(config: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        validate_config(config, DerivativeConfig, "test").derive(NOISE, STEP, ONE)
    assert SavitzkyGolay(window=0.5, order=3).derive(NOISE, STEP, ONE)[2].all()

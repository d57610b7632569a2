"""Derivatives against closed forms and SciPy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.signal import butter, filtfilt, savgol_filter

from residnet.core.config import validate
from residnet.core.errors import ConfigError
from residnet.data.derivatives import (
    BackwardDifference,
    Butterworth,
    Derivative,
    DerivativeConfig,
    ForwardDifference,
    SavitzkyGolay,
)

STEP = 0.1
T = STEP * np.arange(200)
NOISE = np.random.default_rng(0).normal(size=(200, 3))
ONE = np.zeros(200, dtype=int)
RULES: list[Derivative] = [
    SavitzkyGolay(window=1.5, order=2),
    BackwardDifference(),
    ForwardDifference(),
    Butterworth(cutoff=1.0),
]


def test_savitzky_golay_is_scipys_on_one_piece() -> None:
    smooth, rate, valid = SavitzkyGolay(window=1.5, order=3).derive(NOISE, STEP, ONE)
    np.testing.assert_allclose(smooth, savgol_filter(NOISE, 15, 3, axis=0), rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        rate, savgol_filter(NOISE, 15, 3, deriv=1, delta=STEP, axis=0), rtol=0, atol=1e-11
    )
    assert valid.all()


def test_savitzky_golay_is_exact_for_polynomials_up_to_the_edges() -> None:
    values = np.stack([1.0 + 2.0 * T - 0.3 * T**2, T**2], axis=1)
    pieces = np.repeat([0, -1, 1], [90, 20, 90])
    smooth, rate, valid = SavitzkyGolay(window=2.05, order=2).derive(values, STEP, pieces)
    np.testing.assert_array_equal(valid, pieces >= 0)
    np.testing.assert_allclose(smooth[valid], values[valid], atol=1e-9)
    np.testing.assert_allclose(
        rate[valid], np.stack([2.0 - 0.6 * T, 2.0 * T], axis=1)[valid], atol=1e-8
    )
    assert np.isnan(rate[~valid]).all()


@pytest.mark.parametrize(("window", "samples"), [(1.5, 15), (1.4, 15), (2.05, 21), (0.3, 3)])
def test_windows_are_rounded_up_to_odd_numbers(window: float, samples: int) -> None:
    assert SavitzkyGolay(window=window, order=1).samples(STEP) == samples


def test_differences() -> None:
    values = (T**2)[:, None]
    _, back, back_valid = BackwardDifference().derive(values, STEP, ONE)
    _, ahead, ahead_valid = ForwardDifference().derive(values, STEP, ONE)
    np.testing.assert_allclose(back[1:, 0], 2.0 * T[1:] - STEP, atol=1e-9)
    np.testing.assert_allclose(ahead[:-1, 0], 2.0 * T[:-1] + STEP, atol=1e-9)
    assert np.flatnonzero(~back_valid).tolist() == [0]
    assert np.flatnonzero(~ahead_valid).tolist() == [199]


def test_butterworth_is_document_000s() -> None:
    # "0.1" of document 000 is a share of the Nyquist frequency (correction H27): 0.5 Hz at 10 Hz
    smooth, rate, valid = Butterworth(cutoff=0.5).derive(NOISE, STEP, ONE)
    expected = filtfilt(*butter(2, 0.1), NOISE, axis=0)
    np.testing.assert_allclose(smooth[:-1], expected[:-1], atol=1e-10)
    np.testing.assert_allclose(rate[:-1], np.diff(expected, axis=0) / STEP, atol=1e-9)
    assert np.flatnonzero(~valid).tolist() == [199]


def test_butterworth_halves_a_sine_at_its_cutoff_without_delay() -> None:
    t = 0.01 * np.arange(20000)
    wave = np.sin(2.0 * np.pi * 0.5 * t)
    smooth, _, _ = Butterworth(cutoff=0.5).derive(wave[:, None], 0.01, np.zeros(t.size, dtype=int))
    np.testing.assert_allclose(smooth[5000:15000, 0], 0.5 * wave[5000:15000], atol=1e-3)


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.kind)
def test_pieces_do_not_see_each_other(rule: Derivative) -> None:
    pieces = np.repeat([0, 1, -1, 7, -1, 2], [60, 50, 1, 30, 9, 50])
    whole = rule.derive(NOISE, STEP, pieces)
    for number in (0, 1, 7, 2):
        at = pieces == number
        alone = rule.derive(NOISE[at], STEP, np.zeros(at.sum(), dtype=int))
        for a, b in zip(whole, alone, strict=True):
            np.testing.assert_allclose(a[at], b, rtol=0, atol=1e-12)
    assert not whole[2][pieces < 0].any()


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.kind)
def test_a_missing_value_splits_its_piece(rule: Derivative) -> None:
    values = NOISE.copy()
    values[100, 1] = np.nan
    got = rule.derive(values, STEP, ONE)
    pieces = np.repeat([0, -1, 1], [100, 1, 99])
    for a, b in zip(got, rule.derive(NOISE, STEP, pieces), strict=True):
        np.testing.assert_array_equal(a, b)
    assert np.isfinite(got[1][got[2]]).all()


@pytest.mark.parametrize(
    ("rule", "enough"),
    list(zip(RULES, (15, 2, 2, 11), strict=True)),
    ids=lambda x: getattr(x, "kind", None),
)
def test_short_pieces_are_invalid(rule: Derivative, enough: int) -> None:
    assert rule.derive(NOISE[:enough], STEP, ONE[:enough])[2].any()
    assert not rule.derive(NOISE[: enough - 1], STEP, ONE[: enough - 1])[2].any()


@pytest.mark.parametrize(
    ("config", "words"),
    [
        (
            {"kind": "savitzky_golay", "window": "0.2 s", "order": 3},
            "set window to 0.5 s or longer",
        ),
        ({"kind": "butterworth", "cutoff": "5 Hz"}, "not below the Nyquist frequency 5 Hz"),
    ],
)
def test_rules_that_do_not_go_with_the_step(config: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        validate(config, DerivativeConfig, "test").derive(NOISE, STEP, ONE)


@pytest.mark.parametrize(
    "config",
    [{"kind": "savitzky_golay", "window": -1}, {"kind": "butterworth"}, {"kind": "central"}],
)
def test_faulty_configs(config: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        validate(config, DerivativeConfig, "test")


def test_the_named_window_is_enough() -> None:
    assert SavitzkyGolay(window=0.5, order=3).derive(NOISE, STEP, ONE)[2].all()

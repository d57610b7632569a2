"""Profiles of delay against a regression for every shift."""

from __future__ import annotations

import numpy as np
import pytest

from residnet.core.errors import FitError
from residnet.regression.equation_rows import delay_profile


def refits(
    held: np.ndarray, moved: np.ndarray, y: np.ndarray, stretch: np.ndarray, longest: int
) -> list[float]:
    now = np.array([i for i in range(longest, len(y)) if stretch[i] == stretch[i - longest]])
    out = []
    for shift in range(longest + 1):
        x = held[now] * moved[now - shift]
        left = y[now] - x @ np.linalg.lstsq(x, y[now], rcond=None)[0]
        out.append(float(left @ left))
    return out


@pytest.mark.parametrize("shift", [0, 3, 8])
def test_profile_equals_refits_across_gaps(shift: int) -> None:
    random = np.random.default_rng(shift)
    n = 400
    state, drive = random.normal(size=(2, n)) * [[1.0], [500.0]]
    stretch = np.repeat([0, 1, 2], [150, 50, 200])
    held = np.stack((state, np.ones(n), state**2), axis=1)
    moved = np.stack((np.ones(n), drive, drive * np.abs(drive)), axis=1)
    y = (
        -state
        + 1e-3 * np.roll(drive, shift)
        + 1e-7 * state**2 * np.roll(drive * np.abs(drive), shift)
        + 0.3 * random.normal(size=n)
    )
    profile = delay_profile(held, moved, y, stretch, 10)
    np.testing.assert_allclose(profile.rss, refits(held, moved, y, stretch, 10), rtol=1e-9)
    assert profile.shift == shift


def test_terms_that_say_the_same_do_no_harm() -> None:
    random = np.random.default_rng(0)
    drive = random.normal(size=300)
    one = np.ones((300, 2))
    profile = delay_profile(
        one, np.stack((drive, drive), axis=1), np.roll(drive, 4), np.zeros(300, dtype=int), 8
    )
    assert profile.shift == 4
    assert profile.rss[4] < 1e-9 * profile.rss[3]


def test_too_short_a_record_is_one_line() -> None:
    with pytest.raises(FitError, match="delay: 0 samples have a past of 20"):
        delay_profile(np.ones((15, 1)), np.ones((15, 1)), np.ones(15), np.zeros(15, dtype=int), 20)

"""Clocks whose numbers do not go on, and headings that a recorder made up."""

from __future__ import annotations

import numpy as np
import pytest

from residnet.io.readers.clock_repair import repair_clock
from residnet.io.readers.quantities import mask_interpolated_headings

T = 0.1 * np.arange(300)
COLUMNS = [np.sin(T)]


@pytest.mark.parametrize("bits", [16, 24, 32])
@pytest.mark.parametrize("tick", [1e-6, 1e-3])
def test_a_counter_that_wraps_goes_on(bits: int, tick: float) -> None:
    length = 2.0**bits * tick
    step = min(0.1, 0.01 * length)
    true = step * np.arange(300) + 0.9 * length
    mended, remarks = repair_clock(np.remainder(true, length), COLUMNS, tick)
    np.testing.assert_allclose(np.diff(mended), step, rtol=1e-6)
    assert [one["code"] for one in remarks] == ["clock_wraps"] * bool(true[-1] > length)


def test_an_hour_that_comes_twice_is_told_from_a_restart() -> None:
    local = np.where(T > 15.0, T - 3600.0, T)
    np.testing.assert_allclose(repair_clock(local, COLUMNS)[0], T)
    restarted = np.where(T > 15.0, T - 15.0, T)
    np.testing.assert_array_equal(repair_clock(restarted, COLUMNS)[0], restarted)
    np.testing.assert_array_equal(repair_clock(restarted, COLUMNS, 1e-6)[0], restarted)


@pytest.mark.parametrize(("times", "start"), [(2.0, 0.1), (3.3, 6.2), (10.0, 3.0)])
def test_headings_between_359_and_1_are_no_headings(times: float, start: float) -> None:
    random = np.random.default_rng(round(10 * times))
    at = 0.1 * times * np.arange(int(2000 / times))
    psi = start + 1.5 * np.sin(at / 20) + 0.02 * np.cumsum(random.normal(size=at.size))
    grid = 0.1 * np.arange(1900)
    found = mask_interpolated_headings(np.interp(grid, at, np.remainder(psi, 2.0 * np.pi)))
    apart = found - np.interp(grid, at, psi)
    apart -= 2.0 * np.pi * np.round(np.nanmedian(apart) / (2.0 * np.pi))
    assert np.nanmax(np.abs(apart)) < 1e-9
    crossings = np.count_nonzero(np.diff(np.floor(psi / (2.0 * np.pi))))
    assert np.isnan(found).sum() <= (np.ceil(times) + 1) * crossings
    clean = np.remainder(np.interp(grid, at, psi), 2.0 * np.pi)
    assert np.isfinite(mask_interpolated_headings(clean)).all()

"""The time grid against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from residnet.core.errors import DataError, UsageError
from residnet.core.log import Log
from residnet.data.align import GridConfig, align


def test_a_log_on_the_grid_keeps_its_times_and_samples_exactly() -> None:
    rng = np.random.default_rng(0)
    t = 1176.1 + 0.1 * np.arange(500) + rng.uniform(-4e-5, 4e-5, 500)
    log = Log("a", t, {"u": rng.normal(size=500)}, masks={"frozen": rng.random(500) < 0.1})
    out = align(log, GridConfig(step=0.1))
    assert out.t is log.t
    assert out["u"] is log["u"]
    assert out.masks == log.masks


def test_jitter_beyond_the_tolerance_is_interpolated() -> None:
    t = 0.1 * np.arange(100)
    t[50] += 0.01
    log = Log("a", t, {"u": 3.0 * t - 1.0})
    out = align(log, GridConfig(step=0.1))
    np.testing.assert_allclose(out.t, 0.1 * np.arange(100))
    np.testing.assert_allclose(out["u"], 3.0 * out.t - 1.0, atol=1e-12)


def test_lines_survive_irregular_clocks_and_far_origins() -> None:
    t = np.sort(np.random.default_rng(3).uniform(0.0, 60.0, 900))
    log = Log("a", t, {"x": 7e6 + 2.0 * t, "psi": 0.3 * t}, masks={})
    for step in (0.05, 0.5):
        out = align(log, GridConfig(step=step, longest_gap=2.0))
        np.testing.assert_allclose(out["x"] - 7e6, 2.0 * out.t, atol=1e-5)
        np.testing.assert_allclose(out["psi"], 0.3 * out.t, atol=1e-12)
        assert out.meta["grid"]["averaged"] == (step == 0.5)
        np.testing.assert_allclose(np.diff(out.t), step)


def test_averaging_has_the_gain_of_a_boxcar_and_no_delay() -> None:
    t = 0.01 * np.arange(20001)
    for frequency in (0.2, 0.9):
        out = align(Log("a", t, {"u": np.sin(2.0 * np.pi * frequency * t)}), GridConfig(step=0.5))
        inner = slice(2, -2)
        np.testing.assert_allclose(
            out["u"][inner],
            np.sinc(0.5 * frequency) * np.sin(2.0 * np.pi * frequency * out.t[inner]),
            atol=2e-4,
        )
    # what would fold to a constant has a null
    out = align(Log("a", t, {"u": np.sin(2.0 * np.pi * 2.0 * t + 0.7)}), GridConfig(step=0.5))
    assert np.abs(out["u"][2:-2]).max() < 1e-6


def test_held_inputs_take_the_value_before_and_states_the_line_between() -> None:
    log = Log(
        "a",
        np.array([0.0, 0.3, 0.6, 0.9]),
        {"delta": np.array([1.0, 2, 3, 4]), "u": np.array([0.0, 3, 6, 9])},
    )
    out = align(log, GridConfig(step=0.2, held=("delta",)))
    np.testing.assert_allclose(out.t, [0.0, 0.2, 0.4, 0.6, 0.8])
    np.testing.assert_allclose(out["delta"], [1.0, 1.0, 2.0, 3.0, 3.0])
    np.testing.assert_allclose(out["u"], [0.0, 2.0, 4.0, 6.0, 8.0])


def test_wrapping_angles_go_the_short_way_and_stay_in_their_range() -> None:
    for wind, expected in (
        ([350.0, 10.0, 20.0], [350.0, 0.0, 10.0, 15.0, 20.0]),
        ([170.0, -170.0, -160.0], [170.0, -180.0, -170.0, -165.0, -160.0]),
    ):
        log = Log("a", np.array([0.0, 1.0, 2.0]), {"wind_dir": np.radians(wind)})
        values = np.degrees(align(log, GridConfig(step=0.5))["wind_dir"])
        np.testing.assert_allclose(np.remainder(values - expected + 1.0, 360.0), 1.0, atol=1e-9)
        assert (values >= -180.0 - 1e-9).all()
        assert np.ptp(values) <= 360.0


def test_points_in_gaps_and_beside_missing_samples_are_masked() -> None:
    log = Log(
        "a",
        np.array([0.0, 0.1, 0.2, 0.6, 0.7, 0.8, 0.9]),
        {"u": np.array([0.0, 1, 2, 6, 7, np.nan, 9])},
    )
    out = align(log, GridConfig(step=0.1, longest_gap=0.2))
    np.testing.assert_allclose(out["u"], [0, 1, 2, np.nan, np.nan, np.nan, 6, 7, np.nan, 9])
    assert np.flatnonzero(out.masks["hard:gap"]).tolist() == [3, 4, 5, 8]
    bridged = align(log, GridConfig(step=0.1, longest_gap=0.4))
    assert np.flatnonzero(bridged.masks["hard:gap"]).tolist() == [8]
    half = align(log, GridConfig(step=0.05, longest_gap=0.4))
    assert np.flatnonzero(half.masks["hard:gap"]).tolist() == [15, 16, 17]


def test_missing_samples_of_a_log_on_the_grid_are_masked_too() -> None:
    out = align(
        Log("a", 0.1 * np.arange(4), {"u": np.array([0.0, np.nan, 2, 3])}), GridConfig(step=0.1)
    )
    assert out.masks["hard:gap"].tolist() == [False, True, False, False]


def test_an_average_that_reaches_a_missing_sample_or_a_gap_is_missing() -> None:
    t = np.delete(0.1 * np.arange(101), np.arange(52, 60))
    u = np.ones(t.size)
    u[20] = np.nan
    out = align(Log("a", t, {"u": u}), GridConfig(step=1.0, longest_gap=0.3))
    assert np.flatnonzero(np.isnan(out["u"])).tolist() == [2, 5, 6]
    assert np.flatnonzero(out.masks["hard:gap"]).tolist() == [2, 5, 6]


def test_masks_cover_every_point_that_a_masked_sample_enters() -> None:
    mask = np.zeros(7, dtype=bool)
    mask[3] = True
    log = Log("a", 0.2 * np.arange(7), {"u": np.arange(7.0)}, masks={"frozen": mask})
    assert np.flatnonzero(align(log, GridConfig(step=0.1)).masks["frozen"]).tolist() == [5, 6, 7]


def test_faults() -> None:
    with pytest.raises(DataError, match="1 samples"):
        align(Log("a", np.zeros(1), {"u": np.ones(1)}), GridConfig(step=0.1))
    with pytest.raises(UsageError, match="no channel 'dleta'; did you mean 'delta'"):
        align(
            Log("a", np.arange(3.0), {"delta": np.ones(3)}), GridConfig(step=0.1, held=("dleta",))
        )
    with pytest.raises(DataError, match="check the unit of time"):
        align(Log("a", np.array([0.0, 1.0, 1.7e9]), {"u": np.ones(3)}), GridConfig(step=0.1))

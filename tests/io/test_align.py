"""The time grid against closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from residnet.core.errors import DataError, UsageError
from residnet.core.log import Log
from residnet.preprocessing.align import GridConfig, align_to_grid

NAN = np.nan


def gridded(
    t: Any, step: float, held: tuple[str, ...] = (), gap: float | None = None, **u: Any
) -> Log:
    channels = {name: np.asarray(values, dtype=float) for name, values in u.items()}
    log = Log("a", np.asarray(t, dtype=float), channels)
    return align_to_grid(log, GridConfig(step=step, held=held, longest_gap=gap))


def test_align_to_grid_leaves_a_gridded_log_unchanged() -> None:
    rng = np.random.default_rng(0)
    t: np.ndarray = 1176.1 + 0.1 * np.arange(500) + rng.uniform(-4e-5, 4e-5, 500)
    log = Log("a", t, {"u": rng.normal(size=500)}, masks={"frozen": rng.random(500) < 0.1})
    out = align_to_grid(log, GridConfig(step=0.1))
    assert (out.t is log.t, out["u"] is log["u"], out.masks == log.masks) == (True, True, True)
    # a stamp beyond a thousandth of a step is interpolated
    t = 0.1 * np.arange(100)
    t[50] += 0.01
    shaken = gridded(t, 0.1, u=3.0 * t - 1.0)
    np.testing.assert_allclose(shaken["u"], 3.0 * (0.1 * np.arange(100)) - 1.0, atol=1e-12)


def test_align_to_grid_is_exact_for_lines() -> None:
    t = np.sort(np.random.default_rng(3).uniform(0.0, 60.0, 900))
    for step in (0.05, 0.5):
        out = gridded(t, step, gap=2.0, x=7e6 + 2.0 * t, psi=0.3 * t)
        np.testing.assert_allclose(out["x"] - 7e6, 2.0 * out.t, atol=1e-5)
        np.testing.assert_allclose(out["psi"], 0.3 * out.t, atol=1e-12)
        assert out.meta["grid"]["averaged"] == (step == 0.5)
        np.testing.assert_allclose(np.diff(out.t), step)


def test_align_to_grid_averages_with_boxcar_gain_and_zero_phase() -> None:
    t = 0.01 * np.arange(20001)
    inner = slice(2, -2)
    for frequency in (0.2, 0.9, 2.0):
        out = gridded(t, 0.5, u=np.sin(2.0 * np.pi * frequency * t + 0.7))
        wave = np.sin(2.0 * np.pi * frequency * out.t[inner] + 0.7)
        # what would fold to a constant has a null
        np.testing.assert_allclose(out["u"][inner], np.sinc(0.5 * frequency) * wave, atol=2e-4)


def test_align_to_grid_holds_inputs_and_interpolates_states() -> None:
    out = gridded([0, 0.3, 0.6, 0.9], 0.2, ("delta",), delta=[1, 2, 3, 4], u=[0, 3, 6, 9])
    np.testing.assert_allclose(out.t, [0.0, 0.2, 0.4, 0.6, 0.8])
    np.testing.assert_allclose(out["delta"], [1.0, 1.0, 2.0, 3.0, 3.0])
    np.testing.assert_allclose(out["u"], [0.0, 2.0, 4.0, 6.0, 8.0])


def test_align_to_grid_interpolates_wrapped_angles() -> None:
    for wind, expected in (
        ([350.0, 10.0, 20.0], [350.0, 0.0, 10.0, 15.0, 20.0]),
        ([170.0, -170.0, -160.0], [170.0, -180.0, -170.0, -165.0, -160.0]),
    ):
        values = np.degrees(gridded([0, 1, 2], 0.5, wind_dir=np.radians(wind))["wind_dir"])
        np.testing.assert_allclose(np.remainder(values - expected + 1.0, 360.0), 1.0, atol=1e-9)
        assert (values >= min(wind[1], 0.0) - 10.0 - 1e-9).all()
        assert np.ptp(values) <= 360.0


GAPPED = ([0.0, 0.1, 0.2, 0.6, 0.7, 0.8, 0.9], [0.0, 1, 2, 6, 7, NAN, 9])
LONG = np.delete(0.1 * np.arange(101), np.arange(52, 60))
HOLED = np.where(np.arange(LONG.size) == 20, NAN, 1.0)


@pytest.mark.parametrize(
    ("t", "u", "step", "gap", "masked"),
    [
        (*GAPPED, 0.1, 0.2, [3, 4, 5, 8]),
        (*GAPPED, 0.1, 0.4, [8]),
        (*GAPPED, 0.05, 0.4, [15, 16, 17]),
        (0.1 * np.arange(4), [0, NAN, 2, 3], 0.1, None, [1]),
        # an average that reaches a missing sample or a gap is missing
        (LONG, HOLED, 1.0, 0.3, [2, 5, 6]),
    ],
)
def test_align_to_grid_masks_gaps_and_missing_samples(
    t: Any, u: Any, step: float, gap: float | None, masked: list[int]
) -> None:
    out = gridded(t, step, gap=gap, u=u)
    assert np.flatnonzero(out.masks["hard:gap"]).tolist() == masked
    assert np.flatnonzero(np.isnan(out["u"])).tolist() == masked


def test_align_to_grid_extends_masks() -> None:
    mask = np.arange(7) == 3
    log = Log("a", 0.2 * np.arange(7), {"u": np.arange(7.0)}, masks={"frozen": mask})
    assert np.flatnonzero(align_to_grid(log, GridConfig(step=0.1)).masks["frozen"]).tolist() == [
        5,
        6,
        7,
    ]


@pytest.mark.parametrize(
    ("t", "held", "error", "words"),
    [
        ([0.0], (), DataError, "1 samples"),
        ([0.0, 1.0, 2.0], ("ux",), UsageError, "no channel 'ux'"),
        ([0.0, 1.0, 1.7e9], (), DataError, "check the unit of time"),
    ],
)
def test_align_to_grid_refuses_invalid_logs(
    t: list[float], held: tuple[str, ...], error: type, words: str
) -> None:
    with pytest.raises(error, match=words):
        gridded(t, 0.1, held, u=np.ones(len(t)))

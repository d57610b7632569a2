"""Inputs over a step, and windows at the beginnings of logs."""

import numpy as np
import pytest

from residnet.core.log import Log
from residnet.core.names import STATE_NAMES
from residnet.evaluation.freerun import FreeRunErrors, Prediction
from residnet.evaluation.protocol import WindowProtocol
from residnet.physics.signals_config import SignalsConfig
from residnet.preprocessing.prepare import PrepareConfig, PreparedLog, prepare_log
from residnet.preprocessing.samples import make_samples
from residnet.preprocessing.windows import WindowStore

STEP = 0.1


def made(hold: str, *, broken: bool = False) -> PreparedLog:
    """Six seconds of a steady vessel whose input is t^2, with a break at sample 30 where asked."""
    t = STEP * np.arange(60)
    channels = {name: np.zeros(60) for name in STATE_NAMES} | {"n": t**2}
    if broken:
        channels["u"][28:31] = np.nan
    config = PrepareConfig.model_validate(
        {
            "grid": {"step": STEP},
            "derivative": {"kind": "savitzky_golay", "window": 0.5, "order": 2},
            "hold": hold,
        }
    )
    return prepare_log(Log("made", t, channels, manoeuvre="made"), "train", ("n",), config)


def test_prepare_log_holds_inputs_from_the_sample_by_default() -> None:
    log = made("start")
    assert np.array_equal(log.w, log.regression_inputs)
    assert np.allclose(log.w[:, 0], (STEP * np.arange(60)) ** 2)


@pytest.mark.parametrize("broken", [False, True])
def test_prepare_log_mean_inputs_end_with_the_segment(broken: bool) -> None:
    log = made("mean", broken=broken)
    for k in range(60):
        if log.segment[k] < 0:
            continue
        goes_on = k + 1 < 60 and log.segment[k + 1] == log.segment[k]
        expected = (
            (log.regression_inputs[k] + log.regression_inputs[k + 1]) / 2
            if goes_on
            else log.regression_inputs[k]
        )
        assert log.w[k] == pytest.approx(expected)


@pytest.mark.parametrize("step", [0.1, 0.25])
@pytest.mark.parametrize("kind", ["gaps", "dies", "rare", "nothing", "spikes"])
def test_prepare_log_ignores_unused_channels(kind: str, step: float) -> None:
    random = np.random.default_rng(1)
    t = 0.1 * np.arange(400)
    channels = {name: 0.1 * np.sin(t + k) for k, name in enumerate((*STATE_NAMES, "n"))}
    other = random.normal(size=t.size)
    spoiled = {
        "gaps": random.random(t.size) < 0.3,
        "dies": t > 20.0,
        "rare": np.arange(t.size) % 10 > 0,
        "nothing": np.ones(t.size, dtype=bool),
        "spikes": np.zeros(t.size, dtype=bool),
    }[kind]
    other[spoiled] = np.nan
    other[200] = 1e3 if kind == "spikes" else other[200]
    config = PrepareConfig.model_validate(
        {
            "grid": {"step": step},
            "derivative": {"kind": "savitzky_golay", "window": 1.5, "order": 2},
            "masks": [{"kind": "spike"}, {"kind": "nan"}],
        }
    )
    alone, beside = (
        prepare_log(Log("made", t, content, manoeuvre="made"), "train", ("n",), config)
        for content in (channels, {**channels, "voltage": other})
    )
    assert alone.trainable.sum() > 100
    for name in ("y", "smoothed", "nu_dot", "w", "segment", "usable", "trainable"):
        np.testing.assert_array_equal(getattr(alone, name), getattr(beside, name))


@pytest.mark.parametrize("kind", ["hampel", "outlier"])
def test_masked_outliers_enter_no_fit_score_or_window_start(kind: str) -> None:
    """From the rule to least squares, training windows, free-run windows and errors."""
    t = STEP * np.arange(400)
    u = 2.0 + 0.3 * np.sin(0.4 * t) + 1e-3 * np.random.default_rng(0).standard_normal(400)
    bad = np.array([0, 57, 200, 311]) if kind == "outlier" else np.array([57, 200, 311])
    spiked = u.copy()
    spiked[bad] += 0.5
    zeros = {name: np.zeros(400) for name in STATE_NAMES}
    log = Log("spiked", t, {**zeros, "u": spiked, "n": np.ones(400)}, manoeuvre="made")
    derivative = {"kind": "savitzky_golay", "window": 0.5, "order": 2}
    config = PrepareConfig.model_validate(
        {
            "grid": {"step": STEP},
            "derivative": derivative,
            "masks": [{"kind": kind, "channels": ["u"]}],
        }
    )
    found = prepare_log(log, "train", ("n",), config)
    assert np.isin(bad, np.flatnonzero(~found.usable)).all()
    assert (~found.usable).sum() <= bad.size + 4
    assert not found.trainable[bad].any()
    signals = SignalsConfig(inputs=("n",)).build()
    learned = make_samples([found], signals)
    # pieces end at an outlier, so that no derivative holds it
    assert float((learned.channel("u") - 2.0).abs().max()) < 0.35
    assert float(learned.target[:, 0].abs().max()) < 0.2
    store = WindowStore.from_logs([found])
    assert not store.usable[bad].any()
    windows = WindowProtocol(length=10.0, first=5.7).make_windows(found, 0, STEP)
    assert windows[0].start == 58
    true = np.zeros((400, 6))
    true[:, 3] = u
    perfect = [Prediction(true[w.start : w.stop], False) for w in windows]
    errors = FreeRunErrors.from_predictions(windows, perfect, [found])
    np.testing.assert_allclose(errors.rmse, 0.0, atol=1e-12)

"""Bands, worst windows and consistency of channels against numbers worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_logs import made

from residnet.baselines.given import StillConfig
from residnet.data.prepare import Prepared
from residnet.dynamics.hybrid import HybridDynamics
from residnet.heads.base import ZeroHead
from residnet.judge.freerun import Candidate, FreeRun, Prediction
from residnet.judge.metrics import Judged
from residnet.judge.protocol import Window
from residnet.physics.signals import SignalsConfig

SCALES = {"u": 0.5, "v": 0.25, "r": 0.1}
STEP = 0.1


def candidate(name: str, reference: str | None = None) -> Candidate:
    signals = SignalsConfig(inputs=("delta",)).build()
    return Candidate(
        name,
        "head",
        HybridDynamics(signals, StillConfig().build(()), ZeroHead(), STEP, "euler"),
        reference=reference,
    )


def straight(speed: float, count: int = 21, drift: float = 0.0, turned: float = 0.0) -> np.ndarray:
    """States of a straight run north whose measured position gains `drift` m/s eastwards and whose
    heading gains `turned` rad, unseen by u, v, r.
    """
    t = STEP * np.arange(count)
    return np.stack((speed * t, drift * t, turned * t / t[-1], 0 * t + speed, 0 * t, 0 * t), axis=1)


def test_consistency_by_hand() -> None:
    logs = [made(straight(1.0, drift=0.3, turned=0.02), STEP), made(straight(2.0, drift=0.4), STEP)]
    windows = [Window(0, 0, 21, 0, np.zeros(3)), Window(1, 0, 21, 0, np.zeros(3))]
    found = Judged(FreeRun("T2", "test", windows), [], logs, SCALES).kinematics(STEP)
    # after 2 s the position is off by 0.6 m and 0.8 m, the heading by 0.02 rad and nothing
    assert found["windows"] == 2
    assert found["position_mean"] == pytest.approx(0.7)
    assert found["position_rms"] == pytest.approx(np.sqrt((0.36 + 0.64) / 2))
    assert found["heading_mean"] == pytest.approx(0.01)
    assert found["heading_rms"] == pytest.approx(0.02 / np.sqrt(2))


def nine(wind: list[float] | None = None) -> tuple[FreeRun, list[Prepared]]:
    """Nine logs of one window each at speeds 1 .. 9 m/s; `a` is off by 0.01, 0.02, .. m/s in u, `b`
    by twice that.
    """
    logs = [made(straight(k + 1.0), STEP, name=f"log{k}") for k in range(9)]
    if wind is not None:
        logs = [
            replace(
                p,
                log=p.log.replace(channels={**p.log.channels, "wind_speed": np.full(21, wind[k])}),
            )
            for k, p in enumerate(logs)
        ]
    windows = [Window(k, 0, 21, 0, np.zeros(3)) for k in range(9)]

    def off(factor: float) -> list[Prediction]:
        out = []
        for k, p in enumerate(logs):
            states = p.y.copy()
            states[:, 3] += factor * 0.01 * (k + 1)
            out.append(Prediction(states, False))
        return out

    return FreeRun("T2", "test", windows, {"a": off(1), "b": off(2)}), logs


def test_bands_are_thirds_of_the_windows() -> None:
    run, logs = nine(wind=[3.0, 1.0, 2.0] * 3)
    found = Judged(run, [candidate("a", "b"), candidate("b")], logs, SCALES).bands()
    assert [(band["by"], band["low"], band["high"], band["windows"]) for band in found] == [
        ("speed", 1.0, 3.0, 3),
        ("speed", 4.0, 6.0, 3),
        ("speed", 7.0, 9.0, 3),
        ("wind", 1.0, 1.0, 3),
        ("wind", 2.0, 2.0, 3),
        ("wind", 3.0, 3.0, 3),
    ]
    # u alone is off: nrmse of a window is a third of its error over the scale
    levels = [
        np.mean(ks) * 0.01 / 0.5 / 3
        for ks in ((1, 2, 3), (4, 5, 6), (7, 8, 9), (2, 5, 8), (3, 6, 9), (1, 4, 7))
    ]
    assert [band["models"]["a"]["nrmse_mean"] for band in found] == pytest.approx(levels)
    for band, level in zip(found, levels, strict=True):
        paired = band["models"]["a"]["difference"]
        assert paired["to"] == "b"
        assert paired["nrmse_mean"] == pytest.approx(-level)
        assert paired["ratio"] == pytest.approx(0.5)
        assert band["models"]["b"]["difference"] is None


def test_bands_without_windows_enough_or_without_wind_are_left_out() -> None:
    run, logs = nine()
    assert {band["by"] for band in Judged(run, [candidate("a")], logs, SCALES).bands()} == {"speed"}
    few = FreeRun("T2", "test", run.windows[:8], {"a": run.predictions["a"][:8]})
    # 8 windows: thirds of 3, 2 and 3
    assert [band["low"] for band in Judged(few, [candidate("a")], logs, SCALES).bands()] == [
        1.0,
        6.0,
    ]
    # one speed: no breakdown at all
    still = [made(straight(1.0), STEP) for _ in range(9)]
    assert Judged(run, [candidate("a")], still, SCALES).bands() == []


def test_worst_windows_are_named() -> None:
    run, logs = nine()
    found = Judged(run, [candidate("a")], logs, SCALES).limits(STEP)["worst"]["a"]
    assert [entry["log"] for entry in found] == ["log8", "log7", "log6"]
    # u alone is off, by 0.09, 0.08 and 0.07 m/s
    worst = [0.01 * k / 0.5 / 3 for k in (9, 8, 7)]
    assert [entry["nrmse"] for entry in found] == pytest.approx(worst)
    assert found[0]["t"] == pytest.approx(3.0)
    assert found[0]["rmse"]["u"] == pytest.approx(0.09)
    assert found[0]["manoeuvre"] == "zigzag"

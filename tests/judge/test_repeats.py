"""Repeated stretches: found where they were put, compared as a plain loop compares them."""

from __future__ import annotations

import numpy as np
import pytest
from made_logs import made

from residnet.judge.goodness import find_pairs, mismatch, repeatability
from residnet.judge.protocol import Windows

STEP = 0.1
PROTOCOL = Windows(length=10.0, first=5.0)
SCALES = {"u": 0.1, "v": 0.05, "r": 0.02}


def test_mismatch_equals_a_loop() -> None:
    rng = np.random.default_rng(0)
    given, series = rng.normal(5, 2, (17, 2)), rng.normal(5, 2, (90, 2))
    plain = [np.sqrt(((series[k : k + 17] - given) ** 2).mean(0)).max() for k in range(90 - 17 + 1)]
    np.testing.assert_allclose(mismatch(given, series), plain, rtol=1e-9)
    assert mismatch(series, given).shape == (0,)


def commands(seed: int, count: int) -> np.ndarray:
    """Random steps of revolutions and rudder, [T, 2]."""
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform([5, -0.6], [15, 0.6], (count // 20 + 1, 2)), 20, axis=0)[:count]


def states(count: int, offset: float = 0.0, heading: float = 0.0) -> np.ndarray:
    """A straight run at 1 m/s + offset; u, v and r are off by one, two and three times `offset`
    after the first 6 s.
    """
    t = STEP * np.arange(count)
    late = offset * (t > 6.05)
    u = 1.0 + late
    s = np.cumsum(u) * STEP
    return np.stack(
        (s * np.cos(heading), s * np.sin(heading), 0 * t + heading, u, 2 * late, 3 * late), axis=1
    )


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
    assert (pair.first.log, pair.first.start, pair.log, pair.start) == (0, 50, 1, 90)
    assert pair.mismatch == pytest.approx(0, abs=1e-6)
    found = repeatability(PROTOCOL, logs, 2, SCALES, STEP)
    share = np.sqrt(51 / 101)
    assert (found["pairs"], found["logs"]) == (1, 2)
    assert [found[name] for name in "uvr"] == pytest.approx(
        [0.02 * share, 0.01 * share, 0.004 * share]
    )
    assert found["nrmse"] == pytest.approx(0.2 * share)
    # both run 10 m ahead, whatever their heading
    assert found["position"] == pytest.approx(0, abs=1e-9)
    assert found["manoeuvres"]["turning"]["pairs"] == 1


@pytest.mark.parametrize("column", [0, 1])
def test_other_commands_or_another_start_are_no_repeat(column: int) -> None:
    w = commands(0, 160)
    spread = w.max(0) - w.min(0)
    for share, pairs in ((0.04, 1), (0.06, 0)):
        other = w.copy()
        other[:, column] += share * spread[column]
        logs = [made(states(160), STEP, w=w), made(states(160), STEP, w=other)]
        # the range over all logs is wider by the share itself
        assert repeatability(PROTOCOL, logs, 2, SCALES, STEP)["pairs"] == pairs
    for offset, pairs in ((0.024, 1), (0.026, 0)):
        y = states(160)
        y[:, 3] += offset
        assert (
            repeatability(
                PROTOCOL, [made(states(160), STEP, w=w), made(y, STEP, w=w)], 2, SCALES, STEP
            )["pairs"]
            == pairs
        )


def test_breaks_and_exogenous_channels() -> None:
    w = np.concatenate((commands(0, 160), np.random.default_rng(2).normal(size=(160, 1))), axis=1)
    wind = w.copy()
    wind[:, 2] += 50.0
    whole = made(states(160), STEP, w=w)
    # what nobody commands may differ
    assert (
        repeatability(PROTOCOL, [whole, made(states(160), STEP, w=wind)], 2, SCALES, STEP)["pairs"]
        == 1
    )
    broken = made(states(160), STEP, w=w, piece=np.repeat([0, 1], [100, 60]))
    found = repeatability(PROTOCOL, [whole, broken], 2, SCALES, STEP)
    assert found["pairs"] == found["logs"] == 0
    assert "u" not in found


def test_a_log_repeats_itself_only_after_the_window() -> None:
    once = commands(3, 160)
    twice = np.concatenate((once, once))
    log = made(np.tile(states(1), (320, 1)), STEP, w=twice)
    pairs = [
        p
        for p in find_pairs(PROTOCOL, [log], 2, np.array([0.1, 0.05, 0.02]), STEP)
        if p.first.start == 50
    ]
    assert [p.start for p in pairs] == [210]

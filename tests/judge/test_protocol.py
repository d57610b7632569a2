"""Which windows a protocol gives, against the rules written as plain loops."""

from __future__ import annotations

import numpy as np
import pytest
from made_logs import made, random_runs, random_states

from residnet.core.errors import DataError
from residnet.judge.protocol import WholeManoeuvre, Windows, all_windows

STEP = 0.1


def starts_by_loop(bad: np.ndarray, seconds: float, first: float) -> list[int]:
    """The published protocol of the data README, sample by sample (no breaks)."""
    steps, start, starts = round(seconds / STEP), round(first / STEP), []
    while start + steps < len(bad):
        while start < len(bad) and bad[start]:
            start += 1
        if start + steps >= len(bad):
            break
        starts.append(start)
        start += steps
    return starts


def test_windows_equal_the_published_protocol_on_random_masks() -> None:
    rng = np.random.default_rng(0)
    counts = []
    for _ in range(300):
        count = int(rng.integers(1, 400))
        bad = random_runs(count, rng, mean=8.0)
        seconds, first = float(rng.choice([1.0, 3.0, 5.5])), float(rng.choice([0.0, 0.5, 5.0]))
        log = made(random_states(count, rng), STEP, usable=~bad)
        windows = Windows(length=seconds, first=first, history=2.0).windows(log, 7, STEP)
        expected = starts_by_loop(bad, seconds, first)
        assert [w.start for w in windows] == expected
        for w in windows:
            assert w.log == 7
            assert w.stop == w.start + round(seconds / STEP) + 1
            assert w.past == max(w.start - 20, 0)
            np.testing.assert_array_equal(w.nu, log.y[w.start, 3:])
        counts.append(len(expected))
    assert np.mean(counts) > 2


def test_windows_never_cross_a_break() -> None:
    rng = np.random.default_rng(1)
    found = 0
    for _ in range(300):
        count = int(rng.integers(1, 300))
        breaks = np.cumsum(rng.random(count) < 0.02)
        hole = random_runs(count, rng, mean=40.0) & (rng.random() < 0.5)
        piece = np.where(hole, -1, breaks + 1000 * np.cumsum(np.diff(hole, prepend=False)))
        usable = ~(random_runs(count, rng, mean=15.0) & (rng.random(count) < 0.7))
        log = made(random_states(count, rng), STEP, usable=usable, piece=piece)
        windows = Windows(length=2.0, first=0.5, history=1.0).windows(log, 0, STEP)
        last = 5
        for w in windows:
            inside = piece[w.start : w.stop]
            assert inside.size == 21
            assert (inside == inside[0]).all()
            assert inside[0] >= 0
            assert log.usable[w.start]
            assert w.start >= last
            # greedy: no earlier start would have done
            for s in range(last, w.start):
                part = piece[s : s + 21]
                assert not log.usable[s] or (part != part[0]).any() or part.size < 21
            last = w.start + 20
        for s in range(last, count - 20):
            part = piece[s : s + 21]
            assert not log.usable[s] or (part != part[0]).any()
        found += len(windows)
    assert found > 300


def test_history_does_not_reach_across_a_break() -> None:
    """What warms up a memory must be an uninterrupted past."""
    piece = np.repeat([0, -1, 1], 100)
    log = made(np.zeros((300, 6)), STEP, piece=piece)
    windows = Windows(length=4.0, first=5.0, history=6.0).windows(log, 0, STEP)
    assert [(w.past, w.start) for w in windows] == [(0, 50), (200, 200), (200, 240)]
    touching = made(np.zeros((200, 6)), STEP, piece=np.repeat([0, 1], 100))
    windows = Windows(length=4.0, first=9.0, history=6.0).windows(touching, 0, STEP)
    assert [(w.past, w.start) for w in windows] == [(100, 100), (100, 140)]


def test_whole_manoeuvres() -> None:
    rng = np.random.default_rng(2)
    for _ in range(200):
        count = int(rng.integers(1, 400))
        piece = np.where(
            random_runs(count, rng, mean=60.0), np.cumsum(rng.random(count) < 0.01), -1
        )
        piece = np.where(piece >= 0, np.cumsum(np.diff(piece, prepend=-2) != 0), -1)
        log = made(random_states(count, rng), STEP, piece=piece)
        expected = []
        for number in np.unique(piece[piece >= 0]):
            rows = np.flatnonzero(piece == number)
            assert (np.diff(rows) == 1).all()
            if len(rows) > 30:
                expected.append((int(rows[0]) + 4, int(rows[-1]) + 1, int(rows[0])))
        windows = WholeManoeuvre(initial=0.4, shortest=3.0).windows(log, 3, STEP)
        assert [(w.start, w.stop, w.past) for w in windows] == expected
        for w in windows:
            np.testing.assert_allclose(w.nu, log.y[w.past : w.start, 3:].mean(0))


def test_a_stretch_without_a_sample_to_score_is_no_window() -> None:
    """Its error would be the mean of nothing, and metrics.json holds no NaN."""
    usable, piece = np.ones(200, dtype=bool), np.repeat([0, 1], 100)
    usable[4:100] = False
    windows = WholeManoeuvre(initial=0.4, shortest=3.0).windows(
        made(np.zeros((200, 6)), STEP, usable=usable, piece=piece), 0, STEP
    )
    assert [w.start for w in windows] == [104]


def test_no_window_at_all_says_how_long_the_logs_are() -> None:
    logs = [
        made(np.zeros((50, 6)), STEP, name="short"),
        made(np.zeros((80, 6)), STEP, name="longer"),
    ]
    with pytest.raises(
        DataError, match=r"protocol T30: none of 2 'test' logs.*longer, lasts 8\.0 s"
    ):
        all_windows(Windows(length=30.0), logs, STEP, "T30")
    assert [w.log for w in all_windows(Windows(length=2.0, first=0.0), logs, STEP, "T2")] == [
        0,
        0,
        1,
        1,
        1,
    ]

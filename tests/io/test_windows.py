"""Training windows against plain loops over logs with breaks, masked samples and unknown
derivatives.
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from made_logs import random_runs

from residnet.core.errors import DataError
from residnet.core.log import Log
from residnet.core.names import STATE_NAMES
from residnet.preprocessing.data_module import RowsDataModule, WindowBatch, WindowsDataModule
from residnet.preprocessing.prepare import PreparedLog
from residnet.preprocessing.window_index import WindowStage
from residnet.preprocessing.windows import WindowSampler, WindowStore


def broken_log(seed: int, count: int) -> PreparedLog:
    """Random numbers in stretches; the second stretch follows the first at once, so that only the
    label tells them apart.
    """
    random = np.random.default_rng(seed)
    piece = np.cumsum(random.random(count) < 0.04)
    piece = np.where(random_runs(count, random, 25.0), piece, -1)
    y, w = random.normal(size=(count, 6)), random.normal(size=(count, 2))
    y[piece < 0, 3] = np.nan
    y[0] = 1.0
    usable = random_runs(count, random, 12.0) & (piece >= 0)
    good = usable & (random.random(count) < 0.8)
    log = Log(
        f"log_{seed}", 0.1 * np.arange(count), {name: y[:, i] for i, name in enumerate(STATE_NAMES)}
    )
    return PreparedLog(
        log, "train", y, y + 0.5, random.normal(size=(count, 3)), w, w, piece, usable, good
    )


LOGS = [broken_log(seed, count) for seed, count in enumerate((300, 1, 240, 400))]
STORE = WindowStore.from_logs(LOGS, torch.float64)
# (log, sample) of every row of the store
ROWS = [(number, k) for number, log in enumerate(LOGS) for k in range(len(log))]


def stretch(number: int, k: int) -> tuple[int, int]:
    """First sample of the stretch that holds sample k of a log, and one past its last."""
    piece = LOGS[number].segment
    first = last = k
    while first > 0 and piece[first - 1] == piece[k]:
        first -= 1
    while last + 1 < len(piece) and piece[last + 1] == piece[k]:
        last += 1
    return first, last + 1


def expected_starts(length: int) -> list[int]:
    out = []
    for row, (number, k) in enumerate(ROWS):
        log = LOGS[number]
        if (
            log.segment[k] >= 0
            and k + length <= stretch(number, k)[1]
            and log.trainable[k]
            and log.usable[k : k + length].sum() >= 0.5 * length
        ):
            out.append(row)
    return out


@pytest.mark.parametrize("length", [1, 2, 7, 20])
def test_find_starts_and_take_windows_equal_a_reference_loop(length: int) -> None:
    starts = STORE.find_starts(length)
    assert starts.tolist() == expected_starts(length)
    names = ("y", "smoothed", "nu_dot", "w", "usable", "trainable")
    taken = {name: STORE.take_windows(getattr(STORE, name), starts, length) for name in names}
    for i, row in enumerate(starts.tolist()):
        number, k = ROWS[row]
        for name, values in taken.items():
            own = getattr(LOGS[number], name)[k : k + length]
            if name in ("y", "smoothed"):
                # positions are counted from the log's start
                own = own - np.concatenate((LOGS[number].y[0, :2], np.zeros(4)))
            np.testing.assert_array_equal(values[i].numpy(), own)


def test_from_logs_counts_remaining_and_elapsed_samples() -> None:
    for row, (number, k) in enumerate(ROWS):
        first, end = stretch(number, k)
        if LOGS[number].segment[k] >= 0:
            assert (int(STORE.n_elapsed[row]), int(STORE.n_remaining[row])) == (k - first, end - k)
        else:
            assert int(STORE.n_remaining[row]) == 0
    starts = expected_starts(5)
    for lead in (0, 1, 4):
        expected = [row for row in starts if ROWS[row][1] - stretch(*ROWS[row])[0] == lead]
        assert STORE.find_segment_starts(5, lead).tolist() == expected
        assert expected


def test_take_history_repeats_the_first_sample_of_a_short_segment() -> None:
    starts = STORE.find_starts(3)
    length = 6
    padded = 0
    y, w = STORE.take_history(starts, length)
    for i, row in enumerate(starts.tolist()):
        number, k = ROWS[row]
        first, _ = stretch(number, k)
        padded += k - first < length
        samples = np.maximum(np.arange(k - length, k), first)
        np.testing.assert_array_equal(y[i, :, 2:].numpy(), LOGS[number].y[samples, 2:])
        np.testing.assert_array_equal(w[i].numpy(), LOGS[number].w[samples])
    assert 0 < padded < len(starts)
    assert STORE.take_history(starts, 0)[0].shape == (len(starts), 0, 6)


def test_find_starts_with_too_long_windows_raises() -> None:
    for wanted in (lambda: STORE.find_starts(500), lambda: STORE.find_segment_starts(5, 300)):
        with pytest.raises(DataError, match="no training log holds a window of") as caught:
            wanted()
        assert "\n" not in str(caught.value)
    assert bool(np.isnan(np.concatenate([log.y for log in LOGS])).any())
    for name in ("y", "smoothed", "nu_dot", "w"):
        assert bool(torch.isfinite(getattr(STORE, name)).all())


def test_draw_epoch_depends_on_seed_and_epoch_only() -> None:
    batches = WindowSampler(torch.arange(100, 190), batch_size=8, n_batches=5)
    first = batches.draw_epoch(3, 7)
    torch.manual_seed(123)
    assert torch.equal(
        WindowSampler(torch.arange(100, 190), batch_size=8, n_batches=5).draw_epoch(3, 7), first
    )
    assert first.shape == (5, 8)
    assert not torch.equal(batches.draw_epoch(3, 8), first)
    assert not torch.equal(batches.draw_epoch(4, 7), first)


def test_draw_epoch_draws_without_replacement() -> None:
    starts = torch.arange(100, 190)
    drawn = WindowSampler(starts, batch_size=9, n_batches=10).draw_epoch(0, 0)
    assert sorted(drawn.flatten().tolist()) == starts.tolist()
    twice = WindowSampler(starts, batch_size=10, n_batches=20).draw_epoch(0, 0).flatten()
    counts = torch.bincount(twice - 100)
    assert set(counts.tolist()) == {2, 3}
    assert len(set(twice[:90].tolist())) == len(set(twice[90:180].tolist())) == 90


def test_windows_data_module_yields_windows_of_each_stage(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stages = [
        WindowStage(3, 4),
        WindowStage(5, 6, n_history=2, n_segment_start_windows=2, n_lead=3),
    ]
    data = WindowsDataModule(STORE, stages, 2, seed=9, get_stage=lambda epoch: min(epoch, 1))
    seen: list[tuple[WindowBatch, ...]] = []
    for epoch in range(3):
        trainer = SimpleNamespace(current_epoch=epoch, global_rank=0, world_size=1)
        monkeypatch.setattr(data, "trainer", trainer)
        seen += data.train_dataloader()
    assert [[part.y.shape[:2] for part in batch] for batch in seen] == [
        *[[(4, 3)]] * 2,
        *[[(4, 5), (2, 5)]] * 4,
    ]
    anywhere, begun = seen[-1]
    assert (anywhere.past_y.shape[1], begun.past_y.shape[1]) == (2, 3)
    assert begun.n_elapsed.tolist() == [3, 3]
    starts = WindowSampler(STORE.find_starts(5), 4, 2).draw_epoch(9, 2)[1]
    for row, start in enumerate(starts.tolist()):
        whole = slice(start, start + 5)
        for part in ("y", "smoothed", "nu_dot", "w", "regression_inputs", "usable", "trainable"):
            assert torch.equal(getattr(anywhere, part)[row], getattr(STORE, part)[whole])
    past, w_past = STORE.take_history(starts, 2)
    assert torch.equal(anywhere.past_y, past)
    assert torch.equal(anywhere.past_w, w_past)


def test_rows_data_module_shuffles_all_rows_in_every_epoch() -> None:
    data = RowsDataModule((torch.arange(10), -torch.arange(10)), 4, seed=3)
    first, second = (list(data.iterate_batches(epoch)) for epoch in (0, 1))
    assert [len(rows) for rows, _ in first] == [4, 4, 2]
    assert len(list(data.train_dataloader())) == data.n_batches == 3
    rows = [torch.cat([part for part, _ in batches]) for batches in (first, second)]
    assert all(torch.equal(-part, other) for part, other in first)
    assert torch.equal(rows[0].sort().values, torch.arange(10))
    assert not torch.equal(*rows)
    assert torch.equal(rows[0], torch.cat([part for part, _ in data.iterate_batches(0)]))

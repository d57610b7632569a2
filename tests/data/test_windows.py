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
from residnet.core.names import STATE
from residnet.data.module import RowsDataModule, Windows, WindowsDataModule
from residnet.data.prepare import Prepared
from residnet.data.windows import WindowBatches, WindowStage, WindowStore


def broken_log(seed: int, count: int) -> Prepared:
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
        f"log_{seed}", 0.1 * np.arange(count), {name: y[:, i] for i, name in enumerate(STATE)}
    )
    return Prepared(
        log, "train", y, y + 0.5, random.normal(size=(count, 3)), w, w, piece, usable, good
    )


LOGS = [broken_log(seed, count) for seed, count in enumerate((300, 1, 240, 400))]
STORE = WindowStore.gather(LOGS, torch.float64)
# (log, sample) of every row of the store
ROWS = [(number, k) for number, log in enumerate(LOGS) for k in range(len(log))]


def stretch(number: int, k: int) -> tuple[int, int]:
    """First sample of the stretch that holds sample k of a log, and one past its last."""
    piece = LOGS[number].piece
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
            log.piece[k] >= 0
            and k + length <= stretch(number, k)[1]
            and log.good[k]
            and log.usable[k : k + length].sum() >= 0.5 * length
        ):
            out.append(row)
    return out


@pytest.mark.parametrize("length", [1, 2, 7, 20])
def test_windows_start_where_the_loop_says_and_hold_the_logs_samples(length: int) -> None:
    starts = STORE.starts(length)
    assert starts.tolist() == expected_starts(length)
    names = ("y", "smooth", "nu_dot", "w", "usable", "good")
    taken = {name: STORE.take(getattr(STORE, name), starts, length) for name in names}
    for i, row in enumerate(starts.tolist()):
        number, k = ROWS[row]
        for name, values in taken.items():
            own = getattr(LOGS[number], name)[k : k + length]
            if name in ("y", "smooth"):
                # positions are counted from the log's start
                own = own - np.concatenate((LOGS[number].y[0, :2], np.zeros(4)))
            np.testing.assert_array_equal(values[i].numpy(), own)


def test_reach_depth_and_beginnings_are_those_of_the_stretch() -> None:
    for row, (number, k) in enumerate(ROWS):
        first, end = stretch(number, k)
        if LOGS[number].piece[k] >= 0:
            assert (int(STORE.depth[row]), int(STORE.reach[row])) == (k - first, end - k)
        else:
            assert int(STORE.reach[row]) == 0
    starts = expected_starts(5)
    for lead in (0, 1, 4):
        expected = [row for row in starts if ROWS[row][1] - stretch(*ROWS[row])[0] == lead]
        assert STORE.beginnings(5, lead).tolist() == expected
        assert expected


def test_history_repeats_the_first_sample_of_a_stretch_that_is_too_short() -> None:
    starts, length, padded = STORE.starts(3), 6, 0
    y, w = STORE.history(starts, length)
    for i, row in enumerate(starts.tolist()):
        number, k = ROWS[row]
        first, _ = stretch(number, k)
        padded += k - first < length
        samples = np.maximum(np.arange(k - length, k), first)
        np.testing.assert_array_equal(y[i, :, 2:].numpy(), LOGS[number].y[samples, 2:])
        np.testing.assert_array_equal(w[i].numpy(), LOGS[number].w[samples])
    assert 0 < padded < len(starts)
    assert STORE.history(starts, 0)[0].shape == (len(starts), 0, 6)


def test_too_long_a_window_is_one_line_and_unknown_values_reach_no_tensor() -> None:
    for wanted in (lambda: STORE.starts(500), lambda: STORE.beginnings(5, 300)):
        with pytest.raises(DataError, match="no training log holds a window of") as caught:
            wanted()
        assert "\n" not in str(caught.value)
    assert bool(np.isnan(np.concatenate([log.y for log in LOGS])).any())
    for name in ("y", "smooth", "nu_dot", "w"):
        assert bool(torch.isfinite(getattr(STORE, name)).all())


def test_batches_depend_on_seed_and_epoch_alone() -> None:
    batches = WindowBatches(torch.arange(100, 190), batch=8, steps=5)
    first = batches.epoch(3, 7)
    torch.manual_seed(123)
    assert torch.equal(WindowBatches(torch.arange(100, 190), batch=8, steps=5).epoch(3, 7), first)
    assert first.shape == (5, 8)
    assert not torch.equal(batches.epoch(3, 8), first)
    assert not torch.equal(batches.epoch(4, 7), first)


def test_batches_draw_without_replacement_as_far_as_the_starts_last() -> None:
    starts = torch.arange(100, 190)
    drawn = WindowBatches(starts, batch=9, steps=10).epoch(0, 0)
    assert sorted(drawn.flatten().tolist()) == starts.tolist()
    twice = WindowBatches(starts, batch=10, steps=20).epoch(0, 0).flatten()
    counts = torch.bincount(twice - 100)
    assert set(counts.tolist()) == {2, 3}
    assert len(set(twice[:90].tolist())) == len(set(twice[90:180].tolist())) == 90


def test_a_data_module_gives_whole_windows_stage_by_stage(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stages = [WindowStage(3, 4), WindowStage(5, 6, history=2, begun=2, lead=3)]
    data = WindowsDataModule(STORE, stages, 2, seed=9, stage=lambda epoch: min(epoch, 1))
    seen: list[tuple[Windows, ...]] = []
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
    assert begun.depth.tolist() == [3, 3]
    starts = WindowBatches(STORE.starts(5), 4, 2).epoch(9, 2)[1]
    for row, start in enumerate(starts.tolist()):
        whole = slice(start, start + 5)
        for part in ("y", "smooth", "nu_dot", "w", "recorded", "usable", "good"):
            assert torch.equal(getattr(anywhere, part)[row], getattr(STORE, part)[whole])
    past, w_past = STORE.history(starts, 2)
    assert torch.equal(anywhere.past_y, past)
    assert torch.equal(anywhere.past_w, w_past)


def test_every_epoch_goes_through_all_rows_in_an_order_of_its_own() -> None:
    data = RowsDataModule((torch.arange(10), -torch.arange(10)), 4, seed=3)
    first, second = (list(data.batches(epoch)) for epoch in (0, 1))
    assert [len(rows) for rows, _ in first] == [4, 4, 2]
    assert len(list(data.train_dataloader())) == data.steps == 3
    rows = [torch.cat([part for part, _ in batches]) for batches in (first, second)]
    assert all(torch.equal(-part, other) for part, other in first)
    assert torch.equal(rows[0].sort().values, torch.arange(10))
    assert not torch.equal(*rows)
    assert torch.equal(rows[0], torch.cat([part for part, _ in data.batches(0)]))

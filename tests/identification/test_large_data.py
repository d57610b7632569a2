"""Fits of many samples, kept on disk and worked on piece by piece, against those in memory."""

from __future__ import annotations

import dataclasses
import mmap
import time
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from tiny_fit import DATA, settings_of

from residnet.core.arrays import paged
from residnet.core.log import Log
from residnet.identification.fit import fit_models
from residnet.identification.prepared import (
    convert_to_motion_through_water,
    prepare_splits,
    split_long_log,
)
from residnet.io.sources import read_split_logs
from residnet.preprocessing.windows import WindowStore
from residnet.regression.estimator import ChunkedRegressors, Estimator
from residnet.regression.least_squares import LeastSquares
from residnet.regression.shrinkage import PLSR, Ridge


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take hundreds of samples for many."""
    monkeypatch.setattr(paged, "MAX_SAMPLES_IN_MEMORY", 500)
    monkeypatch.setattr(paged, "CHUNK_ROWS", 130)


@pytest.mark.long
def test_fit_models_from_disk_equals_fit_from_memory(
    few: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = settings_of(heads={"plsr": {"kind": "plsr"}, "ridge": {"kind": "ridge"}})
    read = read_split_logs(DATA)
    on_disk = {split: [log.move_to_disk() for log in logs] for split, logs in read.items()}
    prepared = prepare_splits(on_disk, settings)
    assert all(paged.is_memory_mapped(log.y) for logs in prepared.values() for log in logs)
    small = fit_models(prepared, settings)
    store = WindowStore.from_logs(prepared["train"])
    monkeypatch.undo()
    held = prepare_splits(read, settings)
    assert not any(paged.is_memory_mapped(log.y) for logs in held.values() for log in logs)
    for each in (held, convert_to_motion_through_water(held, settings)[0]):
        assert all(isinstance(members, paged.PageReleasingList) for members in each.values())
    for name, entry in fit_models(held, settings).items():
        for key, value in entry.model.state_dict().items():
            torch.testing.assert_close(
                small[name].model.state_dict()[key], value, rtol=1e-7, atol=1e-10
            )
    other = WindowStore.from_logs(held["train"])
    for part in dataclasses.fields(store):
        one = getattr(store, part.name)
        another = getattr(other, part.name)
        assert one is another is None or torch.equal(one, another)


@pytest.mark.parametrize(
    "estimator", [LeastSquares((0.0, 1e-3)), Ridge((1e-6, 1e-2)), PLSR()], ids=lambda e: type(e)
)
def test_estimator_fit_in_chunks_equals_fit_at_once(few: None, estimator: Estimator) -> None:
    generator = torch.Generator().manual_seed(5)
    z = torch.randn(900, 3, generator=generator, dtype=torch.float64)

    def basis(z: torch.Tensor) -> torch.Tensor:
        return torch.cat((z, z.square(), torch.full_like(z[:, :1], 0.3)), dim=1)

    columns = [5, 0, 1, 2, 4]
    y = basis(z)[:, [0, 4]] + 0.1 * torch.randn(900, 2, generator=generator, dtype=torch.float64)
    groups = torch.arange(900) // 150
    in_pieces = estimator.fit(ChunkedRegressors(basis, z, columns), y, groups)
    at_once = estimator.fit(basis(z)[:, columns], y, groups)
    assert len(in_pieces) == len(at_once)
    for found, wanted in zip(in_pieces, at_once, strict=True):
        assert found.hyperparameters == wanted.hyperparameters
        for name, value in wanted.state.items():
            torch.testing.assert_close(found.state[name], value, rtol=1e-9, atol=1e-12)
        assert [c.standard_error for c in found.table] == pytest.approx(
            [c.standard_error for c in wanted.table], rel=1e-9
        )


def test_split_long_log_returns_consecutive_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("residnet.identification.prepared._MAX_SAMPLES", 400)
    log = Log("trip", np.arange(1000.0), {"u": np.arange(1000.0)})
    parts = split_long_log(log)
    assert [part.name for part in parts] == ["trip_1_of_3", "trip_2_of_3", "trip_3_of_3"]
    np.testing.assert_array_equal(np.concatenate([part["u"] for part in parts]), log["u"])
    assert split_long_log(parts[0]) == [parts[0]]


def test_release_pages_keeps_values() -> None:
    values = np.random.default_rng(0).normal(size=(1000, 3))
    kept = paged.copy_to_disk(values)
    paged.release_pages()
    np.testing.assert_array_equal(kept, values)
    assert paged.is_memory_mapped(kept[5:, 0])
    assert not paged.is_memory_mapped(values)


LINUX = pytest.mark.skipif(
    not Path("/proc/self/statm").exists(), reason="pages are counted on Linux only"
)


def pages() -> int:
    return int(Path("/proc/self/statm").read_text().split()[2]) * mmap.PAGESIZE


@LINUX
def test_page_releaser_limits_resident_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paged, "_MAX_RESIDENT_BYTES", 1 << 24)
    before = pages()
    values = paged.allocate_on_disk((1 << 23,))
    values[...] = np.arange(values.size)
    until = time.monotonic() + 20.0
    while pages() - before > 1 << 25 and time.monotonic() < until:
        time.sleep(0.05)
    assert pages() - before <= 1 << 25
    np.testing.assert_array_equal(values[:: 1 << 18], np.arange(0, values.size, 1 << 18))


def test_take_rows_of_many_is_memory_mapped(few: None, monkeypatch: pytest.MonkeyPatch) -> None:
    placed = Mock(wraps=paged.allocate_on_disk)
    monkeypatch.setattr(paged, "allocate_on_disk", placed)
    values = torch.arange(3000.0, dtype=torch.float64).reshape(1000, 3)
    many = torch.arange(1000) % 4 > 0
    some = torch.arange(1000) < 100
    assert torch.equal(paged.take_rows(values, many), values[many])
    assert torch.equal(paged.take_rows(values[:, 0], many), values[many][:, 0])
    assert torch.equal(paged.take_rows(values, some), values[some])
    assert [call.args[0] for call in placed.call_args_list] == [(750, 3), (750,)]


@LINUX
def test_page_releasing_list_holds_pages_of_one_item(monkeypatch: pytest.MonkeyPatch) -> None:
    def most(items: list[np.ndarray]) -> int:
        paged.release_pages()
        before = pages()
        found = []
        for item in items:
            assert item[::512].sum() == 0.0
            found.append(pages() - before)
        return max(found)

    # nobody else gives them back here
    monkeypatch.setattr(paged, "_MAX_RESIDENT_BYTES", 1 << 40)
    size = 1 << 23
    items = [paged.allocate_on_disk((size // 8,)) for _ in range(8)]
    for item in items:
        item[...] = 0.0
    assert most(items) >= 6 * size
    assert most(paged.PageReleasingList(items)) < 2.5 * size

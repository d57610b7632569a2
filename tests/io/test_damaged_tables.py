"""Damaged tables: each ends in a log whose samples are those that were written, or in one clear
line; never in anything else.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from damaged_text import COLUMNS, DAMAGES, LINES, ROWS, TABLE, TRUTH, Damage
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mutations import BYTE_DAMAGES

from residnet.core.config import validate_config
from residnet.core.errors import ResidnetError
from residnet.core.log import Log
from residnet.io.readers import ReaderConfig
from residnet.quality import inspect_log

_MAP = {
    "time": {"column": "t"},
    "channels": {
        "x": {"column": "x", "unit": "m"},
        "psi": {"column": "psi", "unit": "rad"},
        "u": {"column": "u", "unit": "m/s"},
        "n": {"column": "n", "unit": "1/s"},
    },
}
READERS = {
    kind: validate_config({"kind": kind, **_MAP}, ReaderConfig, "test").build()
    for kind in ("csv", "parquet")
}


def outcome(path: Path, kind: str) -> Log | None:
    """The log, or None where there was one clear line."""
    try:
        log = READERS[kind].read(path)
    except ResidnetError as error:
        text = str(error)
        assert text.startswith(str(path)), text
        assert "\n" not in text, text
        assert 20 < len(text.removeprefix(str(path))) < 2000, text
        return None
    return log


def foreign(log: Log) -> list[str]:
    """What is not as it was written: times out of order or of no row, and samples that are neither
    their row's nor missing.
    """
    found = [] if log.t.size >= 2 and bool((np.diff(log.t) > 0.0).all()) else ["times"]
    for i, t in enumerate(log.t):
        row = TRUTH.get(f"{t:.6f}")
        if row is None:
            found.append(f"no row was written at t = {t!r}")
            continue
        for column, name in enumerate(COLUMNS[1:], start=1):
            value = log[name][i]
            if not (np.isnan(value) or abs(value - row[column]) <= 1e-9):
                found.append(f"{name} at {t}: {value}, written {row[column]}")
    return found


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("damaged")


ONCE: dict[str, Any] = {
    "deadline": None,
    "derandomize": True,
    "database": None,
    "suppress_health_check": [HealthCheck.function_scoped_fixture],
}


@settings(max_examples=300, **ONCE)
@given(
    seed=st.integers(0, 2**32),
    which=st.lists(st.sampled_from(DAMAGES), min_size=1, max_size=2),
    end=st.booleans(),
)
def test_read_of_damaged_text_returns_written_samples_or_one_error(
    folder: Path, seed: int, which: list[Damage], end: bool
) -> None:
    rng = random.Random(seed)
    data = "\n".join(LINES).encode() + (b"\n" if end else b"")
    for damage in which:
        data = damage(data, rng) if data else data
    path = folder / "table.csv"
    path.write_bytes(data)
    log = outcome(path, "csv")
    assert log is None or foreign(log) == []


def with_u(cells: list[Any]) -> Callable[[pa.Table], pa.Table]:
    return lambda table: table.set_column(3, "u", pa.array(cells))


U = TABLE["u"].to_numpy()
CELLS: dict[str, list[Any]] = {
    "text": [f"{u:.6f}" for u in U],
    "words": [f"{u:.6f} m" for u in U],
    "nulls": [None if i % 3 == 0 else u for i, u in enumerate(U)],
    "all null": [None] * ROWS,
    "lists": [[u] for u in U],
    "bytes": [f"{u:.6f}".encode() for u in U],
    "infinite": [np.inf if i == 7 else u for i, u in enumerate(U)],
}
OTHER: dict[str, Callable[[pa.Table], pa.Table]] = {
    "shuffled": lambda table: table.take(pa.array([*range(9, ROWS), *range(9)])),
    "repeated": lambda table: table.take(pa.array(sorted([*range(ROWS), 3, 3]))),
    "without a column": lambda table: table.drop_columns(["u"]),
    "a name twice": lambda table: table.rename_columns(["t", "t", "psi", "u", "n"]),
    "one row": lambda table: table.slice(0, 1),
    **{name: with_u(cells) for name, cells in CELLS.items()},
}


@pytest.mark.parametrize("how", OTHER)
def test_read_of_unusual_parquet_returns_written_samples_or_one_error(
    how: str, folder: Path
) -> None:
    path = folder / "table.parquet"
    pq.write_table(OTHER[how](pa.Table.from_pandas(TABLE, preserve_index=False)), path)
    log = outcome(path, "parquet")
    assert (log is not None) == (how in ("text", "nulls", "bytes", "repeated")), log
    assert log is None or foreign(log) == []


def test_read_of_damaged_parquet_returns_written_samples_or_one_error(folder: Path) -> None:
    table = pa.Table.from_pandas(TABLE)
    path = folder / "table.parquet"
    rng = random.Random(1)
    pq.write_table(table, path, write_page_checksum=True)
    whole = path.read_bytes()
    for damage in BYTE_DAMAGES * 12:
        path.write_bytes(damage(whole, rng))
        log = outcome(path, "parquet")
        assert log is None or foreign(log) == []


def test_read_of_undamaged_tables_returns_all_samples(folder: Path) -> None:
    """What the two tests above compare with, and that the check sees a slipped cell."""
    for end in ("", "\n", "\r\n"):
        path = folder / "whole.csv"
        path.write_bytes("\n".join(LINES).encode() + end.encode())
        log = outcome(path, "csv")
        assert log is not None
        assert len(log) == ROWS
        assert foreign(log) == []
    assert log is not None
    assert foreign(log.replace(channels={**log.channels, "u": np.roll(log["u"], 1)})) != []


@pytest.mark.parametrize("cut", [1, 3, 8, 20])
def test_read_of_a_cut_last_line_drops_it(folder: Path, cut: int) -> None:
    path = folder / "cut.csv"
    path.write_bytes("\n".join(LINES).encode()[:-cut])
    log = outcome(path, "csv")
    assert log is not None
    assert len(log) == ROWS - 1
    assert foreign(log) == []
    assert log.meta["rows_dropped"] == 1
    assert [
        finding.code for finding in inspect_log(log).findings if "left out" in finding.text
    ] == ["cut_line"]

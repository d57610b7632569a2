"""Damaged tables: each ends in a log whose samples are those that were written, or in one clear
line; never in anything else.
"""

from __future__ import annotations

import io
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from damaged_text import BYTES, COLUMNS, DAMAGES, LINES, ROWS, TABLE, TRUTH, Damage
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from residnet.core.config import validate
from residnet.core.errors import ResidnetError
from residnet.core.log import Log
from residnet.data.doctor import inspect
from residnet.data.readers import ReaderConfig

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
    kind: validate({"kind": kind, **_MAP}, ReaderConfig, "test").build()
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


@settings(max_examples=800, **ONCE)
@given(
    seed=st.integers(0, 2**32),
    which=st.lists(st.sampled_from(DAMAGES), min_size=1, max_size=2),
    end=st.booleans(),
)
def test_damaged_text_gives_the_samples_as_written_or_one_clear_line(
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


def written_parquet(table: pa.Table) -> bytes:
    out = io.BytesIO()
    pq.write_table(table, out, write_page_checksum=True)
    return out.getvalue()


OTHER_TYPES: dict[str, Callable[[np.ndarray], pa.Array]] = {
    "text": lambda values: pa.array([f"{value:.6f}" for value in values]),
    "words": lambda values: pa.array([f"{value:.6f} m" for value in values]),
    "nulls": lambda values: pa.array(
        [None if i % 3 == 0 else value for i, value in enumerate(values)], pa.float64()
    ),
    "all null": lambda values: pa.nulls(len(values)),
    "lists": lambda values: pa.array([[value] for value in values]),
    "structs": lambda values: pa.array([{"a": value} for value in values]),
    "dictionary": lambda values: pa.array([f"{value:.6f}" for value in values]).dictionary_encode(),
    "bytes": lambda values: pa.array([f"{value:.6f}".encode() for value in values]),
    "stamps": lambda values: pa.array((values * 1e6).astype("int64"), pa.timestamp("us")),
    "bools": lambda values: pa.array([bool(i % 2) for i in range(len(values))]),
    "infinite": lambda values: pa.array(
        [np.inf if i == 7 else value for i, value in enumerate(values)]
    ),
}


@settings(max_examples=200, **ONCE)
@given(
    seed=st.integers(0, 2**32),
    how=st.sampled_from(
        ["cut", "flipped", "zeroed", "inserted", "shuffled", "repeated", "types", "columns"]
    ),
)
def test_damaged_parquet_gives_the_samples_as_written_or_one_clear_line(
    folder: Path, seed: int, how: str
) -> None:
    rng = random.Random(seed)
    table = pa.Table.from_pandas(TABLE, preserve_index=False)
    kind = rng.choice(list(OTHER_TYPES))
    column = rng.choice(COLUMNS)
    if how == "shuffled":
        table = table.take(pa.array(rng.sample(range(ROWS), ROWS)))
    elif how == "repeated":
        table = table.take(pa.array(sorted(rng.choices(range(ROWS), k=ROWS))))
    elif how == "types":
        table = table.set_column(
            COLUMNS.index(column), column, OTHER_TYPES[kind](TABLE[column].to_numpy())
        )
    elif how == "columns":
        table = rng.choice(
            [
                table.drop_columns([column]),
                table.rename_columns(["t", "t", "psi", "u", "n"]),
                table.slice(0, rng.randint(0, 2)),
            ]
        )
    data = bytearray(written_parquet(table))
    if how == "cut":
        data = data[: rng.randrange(len(data))]
    elif how == "flipped":
        for _ in range(rng.randint(1, 5)):
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    elif how == "zeroed":
        at = rng.randrange(len(data))
        data[at : at + 200] = bytes(len(data[at : at + 200]))
    elif how == "inserted":
        at = rng.randrange(len(data))
        data[at:at] = rng.choice(BYTES) * 3
    path = folder / "table.parquet"
    path.write_bytes(bytes(data))
    log = outcome(path, "parquet")
    # flags are numbers to whoever maps them, and microseconds of an epoch are no time that was
    # written
    assert log is None or (how == "types" and kind in ("bools", "stamps")) or foreign(log) == []


def test_undamaged_tables_come_out_whole(folder: Path) -> None:
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
def test_a_file_that_ends_within_its_last_line_loses_that_line(folder: Path, cut: int) -> None:
    path = folder / "cut.csv"
    path.write_bytes("\n".join(LINES).encode()[:-cut])
    log = outcome(path, "csv")
    assert log is not None
    assert len(log) == ROWS - 1
    assert foreign(log) == []
    assert log.meta["rows_dropped"] == 1
    assert [finding.code for finding in inspect(log).findings if "left out" in finding.text] == [
        "cut_line"
    ]

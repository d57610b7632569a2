"""Damaged tables: each ends in a log whose samples are those that were written, or in one clear
line; never in anything else.
"""

from __future__ import annotations

import io
import random
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from residnet.core.config import validate
from residnet.core.errors import ResidnetError
from residnet.core.log import Log
from residnet.data.doctor import inspect
from residnet.data.readers import ReaderConfig

COLUMNS = ("t", "x", "psi", "u", "n")
ROWS = 30
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
# every cell is another number, with as many decimals as the others of its column, so that one that
# slipped is seen
TABLE = pd.DataFrame(
    {
        "t": [round(0.1 * i + 1.0, 6) for i in range(ROWS)],
        "x": [round(100.0 + 3.7 * i + 0.001234, 6) for i in range(ROWS)],
        "psi": [round(0.013 * i + 0.000321, 6) for i in range(ROWS)],
        "u": [round(-20.0 - 0.11 * i + 0.000456, 6) for i in range(ROWS)],
        "n": [round(5000.0 + 7.3 * i + 0.000789, 6) for i in range(ROWS)],
    }
)
LINES = [
    ",".join(COLUMNS),
    *(",".join(f"{value:.6f}" for value in row) for row in TABLE.to_numpy()),
]
TRUTH = {f"{row[0]:.6f}": row for row in TABLE.to_numpy()}
# what stands in a cell that no sensor wrote; none of them is another number
JUNK = [
    *[
        "",
        "nan",
        "NaN",
        "NULL",
        "N/A",
        "None",
        "-",
        "--",
        "+",
        "abc",
        "True",
        "'",
        "#",
        '"',
        '""',
        "{'a': 1}",
        "[1, 2]",
        "(3)",
        "=1+1",
        "a,b,c",
    ],
    *[
        "1e999",
        "inf",
        "-inf",
        "1,5",
        "0x1F",
        "1_0",
        "1 2",
        "12 :30",
        "1.2.3",
        "2020-01-01",
        "e5",
        "1e",
        "1d5",
        "$5",
        "5%",
        "5m",
    ],
    *["\u0661\u0662", "\uff11", "\u2212 3", "\ufeff", "\t", "\x1a"],
]
BYTES = [
    *[
        b"\x00",
        b"\xff",
        b"\xfe\xff",
        b"\xc3",
        b"\xe4",
        b"\x1a",
        b"\xef\xbb\xbf",
        b"\n",
        b"\r",
        b"\r\n",
        b"\t",
        b" ",
    ],
    *[b'"', b"''", b",", b";", b"a", b"\\"],
]

Damage = Callable[[bytes, random.Random], bytes]


def lines_of(data: bytes) -> list[bytes]:
    return data.split(b"\n")


def truncated(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def beheaded(data: bytes, rng: random.Random) -> bytes:
    return data[rng.randrange(len(data) + 1) :]


def shuffled(data: bytes, rng: random.Random) -> bytes:
    head, *rows = lines_of(data)
    rng.shuffle(rows)
    return b"\n".join([head, *rows])


def repeated(data: bytes, rng: random.Random) -> bytes:
    rows = lines_of(data)
    at = rng.randrange(len(rows))
    return b"\n".join([*rows[: at + 1], *[rows[at]] * rng.randint(1, 40), *rows[at + 1 :]])


def without_rows(data: bytes, rng: random.Random) -> bytes:
    return b"\n".join(row for row in lines_of(data) if rng.random() < 0.8)


def two_files(data: bytes, rng: random.Random) -> bytes:
    return data + data


def junk_cells(data: bytes, rng: random.Random) -> bytes:
    rows = [row.split(b",") for row in lines_of(data)]
    for _ in range(rng.randint(1, 4)):
        row = rng.choice(rows)
        row[rng.randrange(len(row))] = rng.choice(JUNK).encode()
    return b"\n".join(b",".join(row) for row in rows)


def ragged(data: bytes, rng: random.Random) -> bytes:
    rows = [row.split(b",") for row in lines_of(data)]
    row = rng.choice(rows)
    if rng.random() < 0.5 and len(row) > 1:
        del row[rng.randrange(len(row))]
    else:
        row.insert(rng.randrange(len(row) + 1), rng.choice([b"", b"7.000000", b"x"]))
    return b"\n".join(b",".join(row) for row in rows)


def other_delimiter(data: bytes, rng: random.Random) -> bytes:
    sign = rng.choice([b";", b"\t", b" ", b"|", b", ", b",,"])
    return b"\n".join(
        row.replace(b",", sign) if rng.random() < rng.choice([0.1, 1.0]) else row
        for row in lines_of(data)
    )


def decimal_commas(data: bytes, rng: random.Random) -> bytes:
    head, *rows = lines_of(data)
    return b"\n".join([head, *(row.replace(b".", b",") for row in rows)])


def other_encoding(data: bytes, rng: random.Random) -> bytes:
    text = data.decode("latin-1")
    return text.encode(
        rng.choice(["utf-16", "utf-16-le", "utf-32", "utf-8-sig", "cp037"]), errors="replace"
    )


def inserted_bytes(data: bytes, rng: random.Random) -> bytes:
    for _ in range(rng.randint(1, 3)):
        at = rng.randrange(len(data) + 1)
        data = data[:at] + rng.choice(BYTES) * rng.choice([1, 1, 1, 50]) + data[at:]
    return data


def zeroed(data: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(data) + 1)
    return data[:at] + b"\x00" * rng.randint(1, 600) + data[at + rng.randint(0, 600) :]


def other_line_ends(data: bytes, rng: random.Random) -> bytes:
    return data.replace(b"\n", rng.choice([b"\r\n", b"\r", b"\n\n", b"\n,,,,\n", b"\n \n"]))


def huge(data: bytes, rng: random.Random) -> bytes:
    rows = [row.split(b",") for row in lines_of(data)]
    row = rng.choice(rows[1:] or rows)
    row[rng.randrange(len(row))] = rng.choice(
        [b"9" * 400, b"1" + b"0" * 5000, b"-" + b"9" * 310, b"x" * 200_000]
    )
    return b"\n".join(b",".join(row) for row in rows)


def quoted(data: bytes, rng: random.Random) -> bytes:
    rows = [row.split(b",") for row in lines_of(data)]
    for _ in range(rng.randint(1, 6)):
        row = rng.choice(rows)
        at = rng.randrange(len(row))
        row[at] = rng.choice([b'"' + row[at] + b'"', b'"' + row[at], row[at] + b'"'])
    return b"\n".join(b",".join(row) for row in rows)


def header_lost(data: bytes, rng: random.Random) -> bytes:
    head, *rows = lines_of(data)
    names = head.split(b",")
    rng.shuffle(names)
    return b"\n".join(
        rng.choice(
            [
                rows,
                [b"", *rows],
                [b",".join([*names[:-1], names[0]]), *rows],
                [head, head, *rows],
                [head.upper(), *rows],
            ]
        )
    )


def emptied(data: bytes, rng: random.Random) -> bytes:
    return rng.choice(
        [
            b"",
            b"\n",
            b"\n\n\n",
            data.split(b"\n")[0],
            data.split(b"\n")[0] + b"\n",
            b" ",
            b",,,,\n",
            b"\xef\xbb\xbf",
            b'"',
        ]
    )


DAMAGES: list[Damage] = [
    truncated,
    beheaded,
    shuffled,
    repeated,
    without_rows,
    two_files,
    junk_cells,
    ragged,
    other_delimiter,
    decimal_commas,
    other_encoding,
    inserted_bytes,
    zeroed,
    other_line_ends,
    huge,
    quoted,
    header_lost,
    emptied,
]


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


ONCE = {
    "deadline": None,
    "derandomize": True,
    "database": None,
    "suppress_health_check": [HealthCheck.function_scoped_fixture],
}


@settings(max_examples=1650, **ONCE)
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


@settings(max_examples=400, **ONCE)
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

"""A table as text, and what can happen to it on the way: cut, shuffled, mixed, miswritten."""

from __future__ import annotations

import random
from collections.abc import Callable

import pandas as pd

COLUMNS = ("t", "x", "psi", "u", "n")
ROWS = 30
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

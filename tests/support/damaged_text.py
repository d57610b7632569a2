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
    *("", "a,b,c", "{'a': 1}", "[1, 2]", "1 2", "12 :30", "\u2212 3", "\t", "\x1a", "\ufeff"),
    *("nan", "NaN", "NULL", "N/A", "None", "-", "--", "+", "abc", "True", "'", "#", '"', '""'),
    *("(3)", "=1+1", "1e999", "inf", "-inf", "1,5", "0x1F", "1_0", "1.2.3", "2020-01-01", "e5"),
    *("1e", "1d5", "$5", "5%", "5m", "١٢", "１"),
]
BYTES = [
    *(b"\x00", b"\xff", b"\xfe\xff", b"\xc3", b"\xe4", b"\x1a", b"\xef\xbb\xbf", b"\n", b"\r"),
    *(b"\r\n", b"\t", b" ", b'"', b"''", b",", b";", b"a", b"\\"),
]
Damage = Callable[[bytes, random.Random], bytes]
Row = list[bytes]


def by_rows(change: Callable[[list[Row], random.Random], list[Row]]) -> Damage:
    """A damage of a table's cells."""

    def damage(data: bytes, rng: random.Random) -> bytes:
        rows = change([line.split(b",") for line in data.split(b"\n")], rng)
        return b"\n".join(b",".join(row) for row in rows)

    return damage


def shuffled(rows: list[Row], rng: random.Random) -> list[Row]:
    return [rows[0], *rng.sample(rows[1:], len(rows) - 1)]


def repeated(rows: list[Row], rng: random.Random) -> list[Row]:
    at = rng.randrange(len(rows))
    return [*rows[: at + 1], *[rows[at]] * rng.randint(1, 40), *rows[at + 1 :]]


def without_rows(rows: list[Row], rng: random.Random) -> list[Row]:
    return [row for row in rows if rng.random() < 0.8]


def junk_cells(rows: list[Row], rng: random.Random) -> list[Row]:
    for _ in range(rng.randint(1, 4)):
        row = rng.choice(rows)
        row[rng.randrange(len(row))] = rng.choice(JUNK).encode()
    return rows


def ragged(rows: list[Row], rng: random.Random) -> list[Row]:
    row = rng.choice(rows)
    if rng.random() < 0.5 and len(row) > 1:
        del row[rng.randrange(len(row))]
    else:
        row.insert(rng.randrange(len(row) + 1), rng.choice([b"", b"7.000000", b"x"]))
    return rows


def huge(rows: list[Row], rng: random.Random) -> list[Row]:
    row = rng.choice(rows[1:] or rows)
    large = [b"9" * 400, b"1" + b"0" * 5000, b"-" + b"9" * 310, b"x" * 200_000]
    row[rng.randrange(len(row))] = rng.choice(large)
    return rows


def quoted(rows: list[Row], rng: random.Random) -> list[Row]:
    for _ in range(rng.randint(1, 6)):
        row = rng.choice(rows)
        at = rng.randrange(len(row))
        row[at] = rng.choice([b'"' + row[at] + b'"', b'"' + row[at], row[at] + b'"'])
    return rows


def header_lost(rows: list[Row], rng: random.Random) -> list[Row]:
    head, *rest = rows
    upper = [name.upper() for name in head]
    # names that only changed places would be another table, which nobody can tell
    twice = [*head[:-1], head[0]]
    return rng.choice([rest, [[b""], *rest], [twice, *rest], [head, head, *rest], [upper, *rest]])


def other_delimiter(data: bytes, rng: random.Random) -> bytes:
    sign = rng.choice([b";", b"\t", b" ", b"|", b", ", b",,"])
    share = rng.choice([0.1, 1.0])
    lines = data.split(b"\n")
    return b"\n".join(line.replace(b",", sign) if rng.random() < share else line for line in lines)


def decimal_commas(data: bytes, rng: random.Random) -> bytes:
    head, line_end, rest = data.partition(b"\n")
    return head + line_end + rest.replace(b".", b",")


def other_encoding(data: bytes, rng: random.Random) -> bytes:
    name = rng.choice(["utf-16", "utf-16-le", "utf-32", "utf-8-sig", "cp037"])
    return data.decode("latin-1").encode(name, errors="replace")


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


def emptied(data: bytes, rng: random.Random) -> bytes:
    head = data.split(b"\n")[0]
    left = [b"", b"\n", b"\n\n\n", head, head + b"\n", b" ", b",,,,\n", b"\xef\xbb\xbf", b'"']
    return rng.choice(left)


DAMAGES: list[Damage] = [
    lambda data, rng: data[: rng.randrange(len(data) + 1)],
    lambda data, rng: data[rng.randrange(len(data) + 1) :],
    lambda data, rng: data + data,
    *map(
        by_rows, (shuffled, repeated, without_rows, junk_cells, ragged, huge, quoted, header_lost)
    ),
    *(other_delimiter, decimal_commas, other_encoding, inserted_bytes, zeroed, other_line_ends),
    emptied,
]

"""Where the table of a file begins: what a recorder says of itself, names, units, then values."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from residnet.core.errors import DataError

BLANKS = " "
"""Stands for any number of blanks and tabulators between cells."""
_SEARCHED = 200
"""Lines among which a header is looked for."""
_BELOW = 3
"""Most lines with units and the like between names and values."""
_NUMBER = re.compile(
    r"[-+]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][-+]?\d+)?|[-+]?(?:nan|inf)", re.IGNORECASE
)
_TIME = re.compile(r"\d{1,4}\s*[-./:年時h]\s*\d")


class Header(NamedTuple):
    """The names of a table's columns, and where they stand.

    Attributes:
        names: of the columns, in order.
        line: number of their line in the file, from 1.
        above: number of lines above the first one with values.
    """

    names: tuple[str, ...]
    line: int
    above: int


def cells_of(lines: Iterable[str], delimiter: str) -> Iterator[list[str]]:
    """Yield the cells of each line without the blanks around them.

    Raises:
        csv.Error: where a quotation mark stays open.
    """
    if delimiter == BLANKS:
        yield from (line.split() for line in lines)
        return
    for row in csv.reader(lines, delimiter=delimiter, skipinitialspace=True):
        yield [cell.strip() for cell in row]


def numbered(names: Sequence[str]) -> list[str]:
    """Return names of which each stands once: copies are counted, nameless columns too."""
    out: list[str] = []
    for place, name in enumerate(names):
        several = name and list(names).count(name) > 1
        copy = f"{name}.{list(names[:place]).count(name)}"
        unique = copy if several else name or f"Unnamed: {place}"
        while unique in out:
            unique += "_"
        out.append(unique)
    return out


def measures(cell: str) -> bool:
    """Return whether a cell holds a number, a date or a time of day."""
    return bool(_NUMBER.fullmatch(cell) or _TIME.match(cell))


def header_with(path: Path, delimiter: str, file: Path, columns: Sequence[str]) -> Header:
    """Return the first line of a text table that holds all the names; else its first line.

    Args:
        path: of the table, for messages.
        delimiter: between cells.
        file: that holds its text as UTF-8.
        columns: names that are looked for.

    Raises:
        DataError: where the first line is blank or no line of cells.
    """
    with file.open(newline="", encoding="utf-8-sig") as stream:
        rows: list[tuple[int, list[str]]] = []
        try:
            if delimiter == BLANKS:
                rows = list(enumerate(cells_of(islice(stream, _SEARCHED), BLANKS), start=1))
            else:
                reader = csv.reader(stream, delimiter=delimiter, skipinitialspace=True)
                for row in islice(reader, _SEARCHED):
                    rows.append((reader.line_num, [cell.strip() for cell in row]))
        except csv.Error as error:
            if not _holding(rows, columns):
                raise DataError(
                    f"{path}: line 1 is no header with column names ({error}); a quotation mark may"
                    " be open, or lines are missing at the beginning"
                ) from error
    found = _holding(rows, columns)
    if not found and (not rows or not any(rows[0][1])):
        raise DataError(
            f"{path}: the file is empty or its first line is blank; a header line with column"
            " names was expected"
        )
    at = found[0] if found else 0
    line, names = rows[at]
    called = numbered(names)
    where = [called.index(column) for column in columns if column in called]
    below = _without_values([cells for _, cells in rows[at + 1 :]], where) if found else 0
    return Header(tuple(names), line, rows[at + below][0])


def _holding(rows: Sequence[tuple[int, list[str]]], columns: Sequence[str]) -> list[int]:
    """Return which row holds all the names, at most one."""
    wanted = set(columns)
    return [i for i, (_, row) in enumerate(rows) if wanted <= {*row, *numbered(row)}][:1]


def _without_values(rows: Sequence[Sequence[str]], where: Sequence[int]) -> int:
    """Return how many of the first rows hold words, such as units, where values are wanted."""
    count = 0
    for row in rows[:_BELOW]:
        cells = [row[i] for i in where if i < len(row)]
        if not any(cells) or any(map(measures, cells)):
            break
        count += 1
    return count


def found_header(rows: Sequence[Sequence[str]]) -> tuple[int, int] | None:
    """Return which of the first rows holds names, and which is the first with values.

    None where no row above the values can be one of names.

    Args:
        rows: cells of the first rows, without the blanks around them.
    """
    filled = [sum(map(bool, row)) for row in rows]
    valued = [sum(map(measures, row)) for row in rows]
    # what most rows look like is the table
    usual = sorted(filled[len(filled) // 2 :])[len(filled[len(filled) // 2 :]) // 2] if rows else 0
    for at, row in enumerate(rows):
        words = filled[at] - valued[at]
        if filled[at] < max(2, 0.8 * usual) or words <= valued[at]:
            continue
        below = _without_values(rows[at + 1 :], range(len(row)))
        # a title of several cells has names beneath it, a table has values
        after = rows[at + 1 + below : at + 4 + below]
        if any(sum(map(measures, cells)) >= 0.3 * usual for cells in after) or not after:
            return _last_names(rows, at, at + 1 + below)
    return None


def _last_names(rows: Sequence[Sequence[str]], first: int, values: int) -> tuple[int, int]:
    """Return the row of names and the first with values; groups above the names are passed over."""
    while first + 1 < values and _repeated(rows[first]) and not _repeated(rows[first + 1]):
        first += 1
    return first, values


def _repeated(row: Sequence[str]) -> bool:
    filled = [cell for cell in row if cell]
    return len(set(filled)) < len(filled)

"""The first rows of a text table whose form nobody described: names, delimiter, decimals."""

from __future__ import annotations

import csv
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from residnet.core.errors import DataError
from residnet.core.names import shown
from residnet.data.readers.encoding import as_utf8
from residnet.data.readers.tables.header import BLANKS, cells_of, found_header, numbered
from residnet.data.readers.tables.lines import comment_lines

if TYPE_CHECKING:
    import pandas as pd

_HEAD = 1 << 16
_SEARCHED = 60
"""Lines among which names of columns are looked for."""
_BEYOND = "beyond the last column"
_COMMA = re.compile(r"\s*-?\d+,\d+(?:[eE][-+]?\d+)?\s*")
_POINT = re.compile(r"\s*-?\d+\.\d+(?:[eE][-+]?\d+)?\s*")


def text_table(path: Path, rows: int) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Return the first rows of a text table and the settings of its reader.

    The `attrs` of the rows hold `between`: the cells of the lines between names and values.

    Raises:
        DataError: where it is empty or no table.
    """
    with as_utf8(path) as file:
        return _first_rows(path, file, rows)


def _first_rows(path: Path, file: Path, rows: int) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Return the first rows of a table whose text stands in `file` as UTF-8."""
    import pandas as pd

    with file.open("rb") as stream:
        head = stream.read(_HEAD)
    lines = head.decode("utf-8-sig", errors="replace").splitlines()
    lines = lines[:-1] if len(head) == _HEAD else lines
    if not any(line.strip() for line in lines) or b"\x00" in head:
        raise DataError(
            f"{path}: the file is empty or no text; a table with a header line was expected"
        )
    form = _form(path, lines)
    decimal = "," if form.delimiter != "," and _decimal_comma(lines, form.delimiter) else "."
    names = numbered(form.names)
    try:
        table = pd.read_csv(
            file,
            sep=r"\s+" if form.delimiter == BLANKS else form.delimiter,
            decimal=decimal,
            header=None,
            names=[*names, _BEYOND],
            skiprows=[*range(form.above), *comment_lines(file, form.above)],
            nrows=rows,
            encoding="utf-8-sig",
            skipinitialspace=True,
            index_col=False,
            low_memory=False,
        )[names]
    except (ValueError, csv.Error) as error:
        reason = shown(" ".join(str(error).split()), 200)
        raise DataError(f"{path}: not a regular table ({reason})") from error
    table.attrs["between"] = form.between
    about: dict[str, Any] = {"kind": "csv"}
    about |= {"delimiter": form.delimiter} if form.delimiter != "," else {}
    about |= {"decimal": ","} if decimal == "," else {}
    return table, about


class _Form(NamedTuple):
    """How the first lines of a text table lie.

    Attributes:
        delimiter: between cells.
        names: of the columns.
        above: number of lines above the values.
        between: cells of the lines between names and values.
    """

    delimiter: str
    names: list[str]
    above: int
    between: list[list[str]]


def _form(path: Path, lines: list[str]) -> _Form:
    """Return the delimiter whose cells are names over values in most lines, and where they stand.

    Raises:
        DataError: where there is none.
    """
    found: list[tuple[int, int, _Form]] = []
    for sign in (",", ";", "\t", "|", BLANKS):
        if sign == BLANKS and found:
            break
        rows = [_cells(line, sign) for line in lines[:_SEARCHED]]
        place = found_header(rows)
        if place is None:
            continue
        at, values = place
        wide = len(rows[at])
        below = [row for row in rows[values:] if any(row)]
        alike = sum(_as_wide(row, rows[at]) for row in below)
        if wide > 1 and 2 * alike > len(below):
            form = _Form(sign, rows[at], values, rows[at + 1 : values])
            found.append((alike, wide, form))
    if not found:
        raise DataError(
            f"{path}: no line holds names of columns above its numbers; write one, with the sign"
            f" between them that stands between numbers (its first line: '{shown(lines[0], 60)}')"
        )
    return max(found, key=lambda entry: entry[:2])[2]


def _as_wide(row: list[str], names: list[str]) -> bool:
    """Return whether a row has a cell for each name, an empty one at its end aside."""
    named = max((i for i, name in enumerate(names, start=1) if name), default=0)
    return named <= len(row) <= len(names) or (len(row) == len(names) + 1 and not row[-1])


def _cells(line: str, delimiter: str) -> list[str]:
    """Return the cells of one line; a line that is no table's is one cell."""
    try:
        return next(cells_of([line], delimiter), [])
    except csv.Error:
        return [line]


def _decimal_comma(lines: list[str], delimiter: str) -> bool:
    cells = [cell for line in lines[1:50] for cell in _cells(line, delimiter)]
    return sum(bool(_COMMA.fullmatch(cell)) for cell in cells) > sum(
        bool(_POINT.fullmatch(cell)) for cell in cells
    )

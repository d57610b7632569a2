"""Text tables: encoding, where names and values stand, whether every line is whole, cells."""

from __future__ import annotations

import codecs
import csv
import io
import re
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple, TextIO

import numpy as np

from residnet.core.errors import DataError, UsageError
from residnet.core.names import nearest, shown
from residnet.core.units import is_unit, known_unit
from residnet.data.readers.base import Advance

if TYPE_CHECKING:
    import pandas as pd

BLANKS = " "
"""Stands for any number of blanks and tabulators between cells."""
# lines among which names are looked for: of a described table, and of one that nobody described
_SEARCHED, _GUESSED = 200, 60
_BELOW = 3
"""Most lines with units and the like between names and values."""
# pieces of this many rows stay in the cache while they are parsed
_PIECE = 20_000
_HEAD, _BLOCK, _SCANNED = 1 << 16, 1 << 18, 1 << 20
_COMMENT = (b"#", b"%", b"//")
_COMMENTED = re.compile(r"\s*(?:#|%|//)\s+")
_NUMBER = re.compile(
    r"[-+]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][-+]?\d+)?|[-+]?(?:nan|inf)", re.IGNORECASE
)
_TIME = re.compile(r"\d{1,4}\s*[-./:年時h]\s*\d")
_UNIT = r"(?:[^\W\d_]|[°%µ])\S*"
_FRACTION = rf"\s*-?\d+{{}}\d+(?:[eE][-+]?\d+)?\s*(?:{_UNIT})?"
_WITH_UNIT = re.compile(rf"(?P<number>[-+]?[\d.,'’ \u00a0\u202f]*\d)\s*(?P<unit>{_UNIT})")
"""A number with its unit behind it, as in `1450 rpm`."""
_SIDES = frozenset("NSEW")
"""Behind a number they rather tell the side of the globe than newtons or seconds."""
_BEYOND = "beyond the last column"
# the longer marks first: one of UTF-32 begins as one of UTF-16 does
_MARKS = {
    codecs.BOM_UTF8: "utf-8",
    codecs.BOM_UTF32_LE: "utf-32",
    codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}
# Chinese looks like narrow kana in a Japanese encoding
_JAPANESE = re.compile(r"\A[^\uff61-\uff9f]*[\u3040-\u30ff\u4e00-\u9fff]")
_CHINESE = re.compile(r"[\u4e00-\u9fa5]{2}")
# its bytes make Chinese signs as well; those of Chinese words make more than Hangul
_KOREAN = re.compile(
    r"\A[\x00-\x7f°±²³µ·]*(?:[\uac00-\ud7a3]{2}[\x00-\x7f°±²³µ·\uac00-\ud7a3]*)+\Z"
)
_CYRILLIC, _RUN = re.compile(rb"[\xc0-\xff\xa8\xb0\xb8\xb9]+"), re.compile(rb"[\xc0-\xff]{4}")
_POLISH = re.compile(r"[a-z][³¹¿¼¾][a-z]")
_LATIN = re.compile(r"[\x00-\x7fÀ-ÿ°º²³µ·±´×–’]*")
_ASCII = bytes(range(128))


class Header(NamedTuple):
    """The names of a table's columns, and the number of lines above the first one with values."""

    names: tuple[str, ...]
    above: int


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


def positions(path: Path, header: Sequence[str], columns: Sequence[str]) -> list[int]:
    """Return where the wanted columns stand in the header."""
    names = numbered(header)
    for column in columns:
        if column in names:
            continue
        count = list(header).count(column)
        if count > 1:
            raise DataError(
                f"{path}: column '{column}' stands {count} times in the header; write"
                f" '{column}.0' for the first, '{column}.1' for the second"
            )
        raise UsageError(f"{path}: no column '{column}'{nearest(column, names)}")
    return [names.index(column) for column in columns]


def read_csv(
    path: Path,
    columns: Sequence[str],
    delimiter: str,
    decimal: str,
    encoding: str | None,
    advance: Advance,
) -> pd.DataFrame:
    """Return the wanted columns of a text table, in order.

    Its `attrs` hold `above`, the number of lines above the values less one, `cut`, whether the last
    line was left out because the file ends within it, and `units`, those in the cells of each
    column.

    Args:
        columns: names of the wanted columns.
        encoding: of the text; None finds it.
        advance: is told the share that is read.
    """
    import pandas as pd

    with as_utf8(path, encoding) as file:
        try:
            header = _header_with(path, delimiter, file, columns)
            wide, size = len(header.names), max(1, file.stat().st_size)
            try:
                where = positions(path, header.names, columns)
            except UsageError as error:
                one = f" (only one column found; is the delimiter really '{delimiter}'?)"
                raise UsageError(f"{error}{one if wide == 1 else ''}") from None
            cut, comments = _check_lines(path, delimiter, header, file)
            pieces: dict[int, list[pd.Series]] = {place: [] for place in where}
            with file.open("rb") as stream:
                form = _form(delimiter, decimal, (header.above, comments), range(wide))
                for piece in pd.read_csv(stream, **form, chunksize=_PIECE):
                    for place, own in pieces.items():
                        # a copy, or the other columns would stay
                        own.append(piece[place].copy())
                    advance(min(1.0, stream.tell() / size))
        except UnicodeDecodeError as error:
            raise DataError(
                f"{path}: not UTF-8 text (byte {error.start}); save the file as UTF-8, or give its"
                " `encoding`"
            ) from error
        except pd.errors.EmptyDataError:
            pass
        except pd.errors.ParserError as error:
            reason = shown(" ".join(str(error).split()), 200)
            raise DataError(
                f"{path}: not a regular table, its header has {wide} columns ({reason}); check"
                " `delimiter` and `decimal`"
            ) from error
    whole = {}
    for place in [*pieces]:
        parts = pieces.pop(place) or [pd.Series([])]
        column = parts[0] if len(parts) == 1 else pd.concat(parts, ignore_index=True)
        whole[place] = _plain(column, decimal)
    table = pd.DataFrame({i: whole[place][0] for i, place in enumerate(where)}, copy=False)
    table.columns = pd.Index(where)
    table = table.iloc[: -1 if cut else None]
    units = [whole[place][1] for place in where]
    table.attrs |= {"above": header.above - 1, "cut": cut, "units": units}
    return table


def _form(
    delimiter: str, decimal: str, skipped: tuple[int, Iterable[int]], names: Iterable[Any]
) -> dict[str, Any]:
    """Return how pandas reads the values of a table.

    `skipped` are the number of lines above the values, and the numbers of lines of comments.
    """
    return {
        # a byte order mark is no part of the first name
        "encoding": "utf-8-sig",
        "sep": r"\s+" if delimiter == BLANKS else delimiter,
        "decimal": decimal,
        "header": None,
        "skiprows": [*range(skipped[0]), *skipped[1]],
        "names": list(names),
        "index_col": False,
        "skip_blank_lines": False,
        "skipinitialspace": True,
        "low_memory": False,
    }


def plain(table: pd.DataFrame, decimal: str = ".") -> pd.DataFrame:
    """Return a table whose texts are numbers where they hold some; `attrs` hold `units` in cells.

    The units are those of each column, empty where its cells name none.
    """
    import pandas as pd

    found = [_plain(cells, decimal) for _, cells in table.items()]
    out = pd.DataFrame({i: cells for i, (cells, _) in enumerate(found)}, table.index)
    out.columns = table.columns
    out.attrs = {**table.attrs, "units": [unit for _, unit in found]}
    return out


_LOOKED_AT = 100
"""Cells of a column that may show at once that it holds words."""


def _plain(cells: pd.Series, decimal: str) -> tuple[pd.Series, str]:
    """Return a column whose numbers have no signs between thousands, and no marks for none (---).

    Where each cell names the same unit (`1450 rpm`), it is returned, and else nothing. A column
    that then still holds a word stays as it is, and so does one in which every cell could as well
    have three decimals.
    """
    import pandas as pd

    between = rf"[ '’\u00a0\u202f{'.' if decimal == ',' else ','}]"
    grouped = re.compile(rf"[-+]?[1-9]\d{{0,2}}(?:{between}\d{{3}})+(?:{re.escape(decimal)}\d+)?")

    def number(cell: Any) -> Any:
        if not isinstance(cell, str):
            return cell
        if grouped.fullmatch(cell.strip()):
            cell = re.sub(between, "", cell)
        return cell.replace(decimal, ".") if re.search(r"\w", cell) else np.nan

    if (
        pd.api.types.is_numeric_dtype(cells.dtype)
        or not cells.dropna().map(lambda cell: isinstance(cell, str | float | int)).all()
    ):
        return cells, ""
    unit, told = _without_unit(cells)
    # where one of the first cells is a word, such as a date, so is the column: no copies of all
    head = told.iloc[:_LOOKED_AT].map(number)
    if pd.to_numeric(head, errors="coerce").isna().sum() != head.isna().sum():
        return cells, ""
    signs = {len(re.findall(r"[^\d+-]", str(cell).strip())) for cell in told.dropna()}
    bare = told.map(number)
    values = pd.to_numeric(bare, errors="coerce")
    plain = (unit or signs != {1}) and values.isna().sum() == bare.isna().sum()
    return (values, unit) if plain else (cells, "")


def _without_unit(cells: pd.Series) -> tuple[str, pd.Series]:
    """Return the unit that stands behind each number of a column, and the cells without it.

    The unit is empty, and the cells are as they were, where any cell is no number with that unit.
    """
    written = cells.dropna()
    told = _unit_behind(str(written.iloc[0]).strip()) if len(written) else ""
    if not told:
        return "", cells
    bare = written.astype("string").str.strip()
    if not bare.str.endswith(told).all():
        return "", cells
    numbers = bare.str.removesuffix(told).str.strip().astype(object)
    return known_unit(told), numbers.reindex(cells.index)


def _unit_behind(cell: str) -> str:
    """Return the unit behind a number, as it is written; empty for none."""
    found = _WITH_UNIT.fullmatch(cell)
    if found is None or found["unit"] in _SIDES or not is_unit(found["unit"]):
        return ""
    return found["unit"]


def first_rows(path: Path, rows: int) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Return the first rows of a text table whose form nobody described, and its reader's settings.

    The `attrs` of the rows hold `between`: the cells of the lines between names and values.
    """
    import pandas as pd

    with as_utf8(path) as file:
        with file.open("rb") as stream:
            head = stream.read(_HEAD)
        lines = head.decode("utf-8-sig", errors="replace").splitlines()
        lines = lines[:-1] if len(head) == _HEAD else lines
        if not any(line.strip() for line in lines) or b"\x00" in head:
            raise DataError(
                f"{path}: the file is empty or no text; a table with a header line was expected"
            )
        if "---" in lines and any(line.startswith("header:") for line in lines):
            raise DataError(
                f"{path}: holds messages as `ros2 topic echo` prints them; record a bag"
                " (`ros2 bag record`), or write them as csv, in Python pandas.json_normalize("
                "list(yaml.safe_load_all(open(file)))).to_csv('log.csv', index=False)"
            )
        delimiter, cells, (at, above) = _delimiter(path, lines)
        # a comma between cells is none within numbers
        told = [cell for row in cells[1:50] for cell in row] if delimiter != "," else []
        comma, point = (
            sum(bool(re.fullmatch(_FRACTION.format(sign), cell)) for cell in told)
            for sign in (",", r"\.")
        )
        decimal = "," if comma > point else "."
        names = numbered(cells[at])
        comments, held = [], 0
        for line, block, _ in _blocks(file):
            said = _passed(block, delimiter, cells[at], above - line)
            comments += [line + i for i in said]
            held += sum(bool(one.strip()) for one in _lines(block)) - len(said)
            if held >= above + rows:
                # behind the rows that are read nothing has to be passed over
                break
        form = _form(delimiter, decimal, (above, comments), [*names, _BEYOND])
        try:
            table = pd.read_csv(file, **form | {"skip_blank_lines": True}, nrows=rows)[names]
        except (ValueError, csv.Error) as error:
            reason = shown(" ".join(str(error).split()), 200)
            raise DataError(f"{path}: not a regular table ({reason})") from error
    table = plain(table, decimal)
    table.attrs["between"] = cells[at + 1 : above]
    about = {"kind": "csv"} | ({"delimiter": delimiter} if delimiter != "," else {})
    return table, about | ({"decimal": ","} if decimal == "," else {})


def _delimiter(path: Path, lines: list[str]) -> tuple[str, list[list[str]], tuple[int, int]]:
    """Return the delimiter whose cells are names over values in most lines, and where they stand.

    Returns:
        The delimiter, the cells of the first lines, and the places of the names and first values.
    """
    found: list[tuple[int, int, tuple[str, list[list[str]], tuple[int, int]]]] = []
    text = "".join(lines[:_GUESSED])
    for sign in (",", ";", "\t", "|", BLANKS):
        if found if sign == BLANKS else sign not in text:
            continue
        rows = [_cells(_COMMENTED.sub("", line, count=1), sign) for line in lines[:_GUESSED]]
        place = found_header(rows)
        if place is None:
            continue
        names = rows[place[0]]
        wide, named = len(names), max((i for i, name in enumerate(names, 1) if name), default=0)
        below = [row for row in rows[place[1] :] if any(row)]
        alike = sum(
            named <= len(row) <= wide or (len(row) == wide + 1 and not row[-1]) for row in below
        )
        if wide > 1 and 2 * alike > len(below):
            found.append((alike, wide, (sign, rows, place)))
    if not found and sum(map(bool, map(str.strip, lines))) == 1:
        raise DataError(
            f"{path}: holds one line ('{shown(lines[0], 60)}') and no row of numbers below it; was"
            " the recording stopped at once? Leave the file out"
        )
    if not found:
        raise DataError(
            f"{path}: no line holds names of columns above its numbers; write one, with the sign"
            f" between them that stands between numbers (its first line: '{shown(lines[0], 60)}')"
        )
    return max(found, key=lambda entry: entry[:2])[2]


def _cells(line: str, delimiter: str) -> list[str]:
    """Return the cells of one line; a line that is no table's is one cell."""
    if delimiter == BLANKS:
        return line.split()
    try:
        row = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
    except csv.Error:
        return [line]
    return [cell.strip() for cell in row]


def _measures(cell: str) -> bool:
    """Return whether a cell holds a number, with or without its unit, a date or a time of day."""
    return bool(_NUMBER.fullmatch(cell) or _TIME.match(cell) or _unit_behind(cell))


def _header_with(path: Path, delimiter: str, file: Path, columns: Sequence[str]) -> Header:
    """Return the first line of a text table that holds all the names; else its first line."""
    wanted = set(columns)

    def lines(stream: TextIO) -> Iterator[tuple[int, list[str]]]:
        if delimiter == BLANKS:
            yield from enumerate((line.split() for line in stream), start=1)
            return
        reader = csv.reader(stream, delimiter=delimiter, skipinitialspace=True)
        for row in reader:
            yield reader.line_num, [cell.strip() for cell in row]

    names: list[str] | None = None
    # number of a line, its cells, and those without the sign of a comment
    rows: list[tuple[int, list[str], list[str]]] = []
    with file.open(newline="", encoding="utf-8-sig") as stream:
        try:
            for number, row in islice(lines(stream), _SEARCHED):
                said = _COMMENTED.sub("", delimiter.join(row), count=1).split(delimiter)
                rows.append((number, row, said))
                if names is None:
                    held = (one for one in (said, row) if wanted <= {*one, *numbered(one)})
                    names = next(held, None)
                    rows = rows if names is None else rows[-1:]
                elif len(rows) > _BELOW:
                    break
        except csv.Error as error:
            if names is None:
                raise DataError(
                    f"{path}: line 1 is no header with column names ({error}); a quotation mark may"
                    " be open, or lines are missing at the beginning"
                ) from error
    if names is None and (not rows or not any(rows[0][2])):
        raise DataError(
            f"{path}: the file is empty or its first line is blank; a header line with column"
            " names was expected"
        )
    if names is None:
        return Header(tuple(rows[0][2]), rows[0][0])
    called = numbered(names)
    where = [called.index(column) for column in columns if column in called]
    below = _without_values([row for _, row, _ in rows[1:]], where)
    return Header(tuple(names), rows[below][0])


def _without_values(rows: Sequence[Sequence[str]], where: Iterable[int]) -> int:
    """Return how many of the first rows hold words, such as units, where values are wanted."""
    where, count = list(where), 0
    for row in rows[:_BELOW]:
        cells = [row[i] for i in where if i < len(row)]
        if not any(cells) or any(map(_measures, cells)):
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
    valued = [sum(map(_measures, row)) for row in rows]
    # what most rows look like is the table
    later = sorted(filled[len(filled) // 2 :])
    usual = later[len(later) // 2] if rows else 0
    for at, row in enumerate(rows):
        words = filled[at] - valued[at]
        if filled[at] < max(2, 0.8 * usual) or words <= valued[at]:
            continue
        values = at + 1 + _without_values(rows[at + 1 :], range(len(row)))
        # a title of several cells has names beneath it, a table has values
        after = rows[values : values + 3]
        if after and not any(sum(map(_measures, cells)) >= 0.3 * usual for cells in after):
            continue
        # groups above the names are passed over
        while at + 1 < values and _repeats(rows[at]) and not _repeats(rows[at + 1]):
            at += 1
        # so is a table about the columns that stands above theirs
        theirs = found_header(rows[values:])
        if theirs is not None:
            names = rows[values + theirs[0]]
            if names != rows[at] and not any(map(_measures, names)) and not _repeats(names):
                return values + theirs[0], values + theirs[1]
        return at, values
    return None


def _repeats(row: Sequence[str]) -> bool:
    filled = [cell for cell in row if cell]
    return len(set(filled)) < len(filled)


def _check_lines(path: Path, delimiter: str, header: Header, file: Path) -> tuple[bool, list[int]]:
    """Look at every line of values: as many cells each as the header; blank lines do not count.

    A parser fills short lines with nothing and reads on; cells that slipped by one column would be
    numbers like any other. A delimiter more or less at the end of every line makes no cell.

    Returns:
        Whether the file ends within its last line, and the numbers of lines, from 0, that hold
        none: they begin with `#`, `%` or `//`, or repeat the names.
    """
    wide, above = len(header.names), header.above
    # names that are missing at the end are those of cells that are not there
    named = max((i for i, name in enumerate(header.names, start=1) if name), default=wide)
    cut, lines = _cut_short(file, delimiter, named), 0
    comments: list[int] = []
    for line, block, last in _blocks(file):
        if b"\x00" in block:
            at = line + block[: block.index(b"\x00")].count(b"\n") + 1
            raise DataError(
                f"{path}: line {at} holds a zero byte, which no text has; the file is damaged or"
                " not UTF-8, write it again"
            )
        cells = _counted(block, delimiter, wide)
        odd = (cells != wide) & (cells != 0)
        odd[: max(above - line, 0)] = False
        said = _passed(block, delimiter, header.names, above - line)
        comments += [line + i for i in said]
        odd[[i for i in said if i < odd.size]] = False
        if odd.any():
            # rarely so: an empty cell more at the end of lines, or without names
            rows = _lines(block)
            sign = delimiter.encode()
            ended = np.array([row.rstrip(b" ").endswith(sign) for row in rows])
            odd &= ~((cells >= named) & (cells < wide))
            odd &= ~((cells == wide + 1) & ended) if ended.size == cells.size else True
        if last and cut:
            odd[-1:] = False
        if odd.any():
            at = int(np.argmax(odd))
            raise DataError(
                f"{path}: line {line + at + 1} has {cells[at]} cells, the header {wide}"
                f" ({int(odd.sum())} such lines nearby); check `delimiter` and `decimal`, or delete"
                " the damaged lines"
            )
        lines = line + cells.size
    return cut and lines - 1 not in comments[-1:], comments


def _blocks(path: Path) -> Iterator[tuple[int, bytes, bool]]:
    """Yield blocks of whole lines: the number of the first, its bytes, and whether it is the last.

    Line ends are one byte each, and an open quote takes its line ends along.
    """
    with path.open("rb") as stream:
        rest, line = b"", 0
        while True:
            block = stream.read(_BLOCK)
            text, tail = rest + block, b""
            if b"\r" in text:
                # the other half of a line end may stand in the next block
                if block and text.endswith(b"\r"):
                    text, tail = text[:-1], b"\r"
                text = text.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
            if not block:
                if text:
                    yield line, text, True
                return
            end = text.rfind(b"\n") + 1 if text.count(b'"') % 2 == 0 else 0
            if end:
                yield line, text[:end], False
                line += text.count(b"\n", 0, end)
            rest = text[end:] + tail


def _lines(block: bytes) -> list[bytes]:
    lines = block.split(b"\n")
    return lines if lines[-1] else lines[:-1]


def _passed(block: bytes, delimiter: str, names: Sequence[str], above: int) -> list[int]:
    """Return which lines below those `above` are comments, or the names again."""
    again, telling = list(names), max(names, key=len, default="").encode() or _COMMENT[0]
    begin = 0
    for _ in range(above):
        begin = block.find(b"\n", begin) + 1 or len(block)
    block = block[begin:]
    if not any(sign in block for sign in (*_COMMENT, telling)):
        return []
    return [
        i
        for i, line in enumerate(_lines(block), max(above, 0))
        if line.lstrip().startswith(_COMMENT)
        or (telling in line and _cells(line.decode("utf-8", "replace"), delimiter) == again)
    ]


def _counted(block: bytes, delimiter: str, wide: int) -> np.ndarray:
    """Return the number of cells of each line, usually `wide`; 0 where it is blank."""
    if delimiter == BLANKS:
        return np.array([len(line.split()) for line in _lines(block)], dtype=np.int64)
    if b'"' in block:
        text = io.StringIO(block.decode("utf-8", errors="replace"), newline="")
        reader = csv.reader(text, delimiter=delimiter, skipinitialspace=True)
        try:
            return np.array([len(row) if any(row) or len(row) > 1 else 0 for row in reader])
        except csv.Error:
            # a cell of more than 128 kB: an open quote has swallowed the lines after it
            return np.ones(1, dtype=np.int64)
    sign = delimiter.encode()
    if wide > 1 and len(sign) == 1:
        # the usual block: every so many marks one is the end of a line, the others are delimiters
        marks = block.translate(None, bytes({*range(256)} - {sign[0], ord("\n")}))
        if marks == (sign * (wide - 1) + b"\n") * (len(marks) // wide):
            return np.full(len(marks) // wide, wide)
    lines = _lines(block)
    cells = np.array([line.count(sign) for line in lines], dtype=np.int64) + 1
    for i in np.flatnonzero(cells == 1):
        cells[i] = bool(lines[i].strip())
    return cells


def _cut_short(path: Path, delimiter: str, wide: int) -> bool:
    """Return whether the file ends within its last line.

    It has no end, and too few cells or a last cell shorter than any in that column shortly before.
    """
    with path.open("rb") as stream:
        size = stream.seek(0, io.SEEK_END)
        stream.seek(max(0, size - _HEAD))
        tail = stream.read()
    if not tail or tail.endswith((b"\n", b"\r")):
        return False
    lines = [line for line in tail.replace(b"\r", b"\n").split(b"\n") if line.strip()]
    mark = None if delimiter == BLANKS else delimiter.encode()
    last, before = lines[-1].split(mark), [line.split(mark) for line in lines[-51:-1]]
    # the first of several lines may itself be cut, by the tail, or be the header
    known = [
        len(cells[-1].strip()) for cells in before[1:] if len(cells) == wide and cells[-1].strip()
    ]
    if size <= _HEAD and len(lines) < 2:
        return False
    return len(last) < wide or (
        bool(known) and len(last) == wide and len(last[-1].strip()) < min(known)
    )


def encoding_of(path: Path) -> str:
    """Return the encoding of a text file: by its byte order mark, else by what its bytes can be.

    Text without a mark is UTF-8 where all of it can be, else UTF-16, Russian (cp1251), Polish
    (cp1250), Western European (cp1252), Japanese (cp932), Korean (cp949) or Chinese (gb18030).
    """
    with path.open("rb") as stream:
        told = _told(stream.read(_HEAD))
        if told is not None:
            return told
        stream.seek(0)
        block = _first_beyond_utf8(stream)
        if not block:
            return "utf-8"
        beyond = block.translate(None, _ASCII)
        # words of Cyrillic are runs of such letters; a Latin one stands among plain letters
        if _CYRILLIC.fullmatch(beyond) and _RUN.search(block):
            return "cp1251"
        western = block.decode("cp1252", errors="replace")
        if _POLISH.search(western):
            return "cp1250"
        # a Latin letter and the next one may look like one Japanese sign, but not the other way
        if _LATIN.fullmatch(western):
            return "cp1252"
        for name, likely in (
            ("cp932", _JAPANESE),
            ("cp949", _KOREAN),
            ("gb18030", _CHINESE),
            ("cp1252", re.compile("")),
        ):
            with suppress(UnicodeDecodeError):
                if likely.search(block.decode(name)):
                    return name
        # it gives every byte a sign: numbers can be read, and names stay names
        return "latin-1"


def encoding_of_head(head: bytes) -> str:
    """Return the encoding of a text from its first bytes alone."""
    return _told(head) or "utf-8"


@contextmanager
def as_utf8(path: Path, encoding: str | None = None) -> Iterator[Path]:
    """Yield a file that holds the text of `path` in UTF-8, perhaps behind a byte order mark.

    It is `path` itself where that is UTF-8, or else a temporary one, gone after the context. Zero
    bytes at its end, with which recorders fill what they have not written, are left out.

    Args:
        encoding: its name; None finds it.
    """
    name = codecs.lookup(encoding or encoding_of(path)).name
    wide = name.startswith(("utf-16", "utf-32"))
    with path.open("rb") as stream:
        stream.seek(max(0, path.stat().st_size - 1))
        zeros = not wide and stream.read() == b"\0"
    if name in ("utf-8", "utf-8-sig", "ascii") and not zeros:
        yield path
        return
    content = path.read_bytes()
    content = content.rstrip(b"\0") if zeros else content
    try:
        # half a sign at the end is left out
        text = codecs.getincrementaldecoder(name)().decode(content)
    except UnicodeError as error:
        at = getattr(error, "start", 0)
        raise DataError(
            f"{path}: not {name.upper()} text (near byte {at}); save the file as UTF-8, or give its"
            " `encoding`"
        ) from error
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / path.name
        copy.write_bytes(text.encode("utf-8"))
        yield copy


def _told(head: bytes) -> str | None:
    """Return the encoding that a mark, or the zeros of wide signs, tell; None for neither."""
    for mark, name in _MARKS.items():
        if head.startswith(mark):
            return name
    if len(head) < 4 or b"\x00" not in head:
        return None
    values = np.frombuffer(head[: len(head) // 2 * 2], dtype=np.uint8).reshape(-1, 2)
    first, second = (values == 0).mean(axis=0)
    if second > 0.5 and first < 0.01:
        return "utf-16-le"
    return "utf-16-be" if first > 0.5 and second < 0.01 else None


def _first_beyond_utf8(stream: BinaryIO) -> bytes:
    """Return the first block that is no UTF-8, whole lines of it; empty where all of it is."""
    decoder = codecs.getincrementaldecoder("utf-8")()
    while block := stream.read(_SCANNED):
        try:
            if not (block.isascii() and decoder.getstate()[0] == b""):
                decoder.decode(block)
        except UnicodeDecodeError:
            return block[: block.rfind(b"\n") + 1] or block
    return b""

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
from residnet.core.names import suggest_name, truncate
from residnet.core.units import canonical_unit, is_unit
from residnet.io.readers.base import ProgressCallback

if TYPE_CHECKING:
    import pandas as pd

WHITESPACE_DELIMITER = " "
"""Stands for any number of blanks and tabulators between cells."""
# lines among which names are looked for: of a described table, and of one that nobody described
_HEADER_SEARCH_LINES, _SNIFFED_LINES = 200, 60
_MAX_UNIT_LINES = 3
"""Most lines with units and the like between names and values."""
# pieces of this many rows stay in the cache while they are parsed
_CHUNK_ROWS = 20_000
_HEAD_BYTES, _BLOCK_BYTES, _SCAN_BYTES = 1 << 16, 1 << 18, 1 << 20
_COMMENT_SIGNS = (b"#", b"%", b"//")
_COMMENT_PREFIX = re.compile(r"\s*(?:#|%|//)\s+")
_NUMBER = re.compile(
    r"[-+]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][-+]?\d+)?|[-+]?(?:nan|inf)", re.IGNORECASE
)
_TIME = re.compile(r"\d{1,4}\s*[-./:年時h]\s*\d")
_UNIT = r"(?:[^\W\d_]|[°%µ])\S*"
_FRACTION = rf"\s*-?\d+{{}}\d+(?:[eE][-+]?\d+)?\s*(?:{_UNIT})?"
_WITH_UNIT = re.compile(rf"(?P<number>[-+]?[\d.,'’ \u00a0\u202f]*\d)\s*(?P<unit>{_UNIT})")
"""A number with its unit behind it, as in `1450 rpm`."""
_HEMISPHERES = frozenset("NSEW")
"""Behind a number they rather tell the side of the globe than newtons or seconds."""
_EXTRA_COLUMN = "beyond the last column"
# the longer marks first: one of UTF-32 begins as one of UTF-16 does
_BYTE_ORDER_MARKS = {
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
_CYRILLIC, _LETTER_RUN = (
    re.compile(rb"[\xc0-\xff\xa8\xb0\xb8\xb9]+"),
    re.compile(rb"[\xc0-\xff]{4}"),
)
_POLISH = re.compile(r"[a-z][³¹¿¼¾][a-z]")
_LATIN = re.compile(r"[\x00-\x7fÀ-ÿ°º²³µ·±´×–’]*")
_ASCII = bytes(range(128))


class Header(NamedTuple):
    """The names of a table's columns, and the number of lines above the first one with values."""

    names: tuple[str, ...]
    n_lines_above: int


def make_names_unique(names: Sequence[str]) -> list[str]:
    """Return names of which each stands once: copies are counted, nameless columns too."""
    unique_names: list[str] = []
    for position, name in enumerate(names):
        is_repeated = name and list(names).count(name) > 1
        copy = f"{name}.{list(names[:position]).count(name)}"
        unique = copy if is_repeated else name or f"Unnamed: {position}"
        while unique in unique_names:
            unique += "_"
        unique_names.append(unique)
    return unique_names


def find_column_positions(path: Path, header: Sequence[str], columns: Sequence[str]) -> list[int]:
    """Return where the wanted columns stand in the header."""
    names = make_names_unique(header)
    for column in columns:
        if column in names:
            continue
        count = list(header).count(column)
        if count > 1:
            raise DataError(
                f"{path}: column '{column}' stands {count} times in the header; write"
                f" '{column}.0' for the first, '{column}.1' for the second"
            )
        raise UsageError(f"{path}: no column '{column}'{suggest_name(column, names)}")
    return [names.index(column) for column in columns]


def read_csv(
    path: Path,
    columns: Sequence[str],
    delimiter: str,
    decimal: str,
    encoding: str | None,
    advance: ProgressCallback,
) -> pd.DataFrame:
    """Return the wanted columns of a text table, in order.

    Its `attrs` hold `n_lines_above`, the number of lines above the values less one, `is_truncated`, whether the last
    line was left out because the file ends within it, and `units`, those in the cells of each
    column.

    Args:
        columns: names of the wanted columns.
        encoding: of the text; None finds it.
        advance: is told the share that is read.
    """
    import pandas as pd

    with open_as_utf8(path, encoding) as file:
        try:
            header = _find_header_with_columns(path, delimiter, file, columns)
            n_columns, size = len(header.names), max(1, file.stat().st_size)
            try:
                column_positions = find_column_positions(path, header.names, columns)
            except UsageError as error:
                hint = f" (only one column found; is the delimiter really '{delimiter}'?)"
                raise UsageError(f"{error}{hint if n_columns == 1 else ''}") from None
            is_truncated, comments = _check_lines(path, delimiter, header, file)
            chunks: dict[int, list[pd.Series]] = {position: [] for position in column_positions}
            with file.open("rb") as stream:
                pandas_options = _pandas_options(
                    delimiter, decimal, (header.n_lines_above, comments), range(n_columns)
                )
                for chunk in pd.read_csv(stream, **pandas_options, chunksize=_CHUNK_ROWS):
                    for position, column_chunks in chunks.items():
                        # a copy, or the other columns would stay
                        column_chunks.append(chunk[position].copy())
                    advance(min(1.0, stream.tell() / size))
        except UnicodeDecodeError as error:
            raise DataError(
                f"{path}: not UTF-8 text (byte {error.start}); save the file as UTF-8, or give its"
                " `encoding`"
            ) from error
        except pd.errors.EmptyDataError:
            pass
        except pd.errors.ParserError as error:
            reason = truncate(" ".join(str(error).split()), 200)
            raise DataError(
                f"{path}: not a regular table, its header has {n_columns} columns ({reason}); check"
                " `delimiter` and `decimal`"
            ) from error
    parsed_columns = {}
    for position in [*chunks]:
        column_parts = chunks.pop(position) or [pd.Series([])]
        column = (
            column_parts[0]
            if len(column_parts) == 1
            else pd.concat(column_parts, ignore_index=True)
        )
        parsed_columns[position] = _coerce_column(column, decimal)
    table = pd.DataFrame(
        {i: parsed_columns[position][0] for i, position in enumerate(column_positions)}, copy=False
    )
    table.columns = pd.Index(column_positions)
    table = table.iloc[: -1 if is_truncated else None]
    units = [parsed_columns[position][1] for position in column_positions]
    table.attrs |= {"above": header.n_lines_above - 1, "cut": is_truncated, "units": units}
    return table


def _pandas_options(
    delimiter: str, decimal: str, skipped_lines: tuple[int, Iterable[int]], names: Iterable[Any]
) -> dict[str, Any]:
    """Return how pandas reads the values of a table.

    `skipped_lines` are the number of lines above the values, and the numbers of lines of comments.
    """
    return {
        # a byte order mark is no part of the first name
        "encoding": "utf-8-sig",
        "sep": r"\s+" if delimiter == WHITESPACE_DELIMITER else delimiter,
        "decimal": decimal,
        "header": None,
        "skiprows": [*range(skipped_lines[0]), *skipped_lines[1]],
        "names": list(names),
        "index_col": False,
        "skip_blank_lines": False,
        "skipinitialspace": True,
        "low_memory": False,
    }


def coerce_numeric(table: pd.DataFrame, decimal: str = ".") -> pd.DataFrame:
    """Return a table whose texts are numbers where they hold some; `attrs` hold `units` in cells.

    The units are those of each column, empty where its cells name none.
    """
    import pandas as pd

    coerced = [_coerce_column(cells, decimal) for _, cells in table.items()]
    coerced_table = pd.DataFrame({i: cells for i, (cells, _) in enumerate(coerced)}, table.index)
    coerced_table.columns = table.columns
    coerced_table.attrs = {**table.attrs, "units": [unit for _, unit in coerced]}
    return coerced_table


_LOOKED_AT = 100
"""Cells of a column that may show at once that it holds words."""


def _coerce_column(cells: pd.Series, decimal: str) -> tuple[pd.Series, str]:
    """Return a column whose numbers have no signs between thousands, and no marks for none (---).

    Where each cell names the same unit (`1450 rpm`), it is returned, and else nothing. A column
    that then still holds a word stays as it is, and so does one in which every cell could as well
    have three decimals.
    """
    import pandas as pd

    thousands_separator = rf"[ '’\u00a0\u202f{'.' if decimal == ',' else ','}]"
    grouped_number = re.compile(
        rf"[-+]?[1-9]\d{{0,2}}(?:{thousands_separator}\d{{3}})+(?:{re.escape(decimal)}\d+)?"
    )

    def normalize_number(cell: Any) -> Any:
        if not isinstance(cell, str):
            return cell
        if grouped_number.fullmatch(cell.strip()):
            cell = re.sub(thousands_separator, "", cell)
        return cell.replace(decimal, ".") if re.search(r"\w", cell) else np.nan

    if (
        pd.api.types.is_numeric_dtype(cells.dtype)
        or not cells.dropna().map(lambda cell: isinstance(cell, str | float | int)).all()
    ):
        return cells, ""
    unit, unitless_cells = _strip_unit(cells)
    # where one of the first cells is a word, such as a date, so is the column: no copies of all
    head = unitless_cells.iloc[:_LOOKED_AT].map(normalize_number)
    if pd.to_numeric(head, errors="coerce").isna().sum() != head.isna().sum():
        return cells, ""
    separator_counts = {
        len(re.findall(r"[^\d+-]", str(cell).strip())) for cell in unitless_cells.dropna()
    }
    normalized = unitless_cells.map(normalize_number)
    values = pd.to_numeric(normalized, errors="coerce")
    is_numeric = (
        unit or separator_counts != {1}
    ) and values.isna().sum() == normalized.isna().sum()
    return (values, unit) if is_numeric else (cells, "")


def _strip_unit(cells: pd.Series) -> tuple[str, pd.Series]:
    """Return the unit that stands behind each number of a column, and the cells without it.

    The unit is empty, and the cells are as they were, where any cell is no number with that unit.
    """
    filled_cells = cells.dropna()
    unit_text = _parse_trailing_unit(str(filled_cells.iloc[0]).strip()) if len(filled_cells) else ""
    if not unit_text:
        return "", cells
    stripped_cells = filled_cells.astype("string").str.strip()
    if not stripped_cells.str.endswith(unit_text).all():
        return "", cells
    unitless_texts = stripped_cells.str.removesuffix(unit_text).str.strip().astype(object)
    return canonical_unit(unit_text), unitless_texts.reindex(cells.index)


def _parse_trailing_unit(cell: str) -> str:
    """Return the unit behind a number, as it is written; empty for none."""
    match = _WITH_UNIT.fullmatch(cell)
    if match is None or match["unit"] in _HEMISPHERES or not is_unit(match["unit"]):
        return ""
    return match["unit"]


def read_table_head(path: Path, rows: int) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Return the first rows of a text table whose form nobody described, and its reader's settings.

    The `attrs` of the rows hold `thousands_separator`: the cells of the lines between names and values.
    """
    import pandas as pd

    with open_as_utf8(path) as file:
        with file.open("rb") as stream:
            head = stream.read(_HEAD_BYTES)
        lines = head.decode("utf-8-sig", errors="replace").splitlines()
        lines = lines[:-1] if len(head) == _HEAD_BYTES else lines
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
        delimiter, cells, (header_row, n_lines_above) = _detect_delimiter(path, lines)
        # a comma between cells is none within numbers
        sampled_cells = [cell for row in cells[1:50] for cell in row] if delimiter != "," else []
        n_decimal_commas, n_decimal_points = (
            sum(bool(re.fullmatch(_FRACTION.format(sign), cell)) for cell in sampled_cells)
            for sign in (",", r"\.")
        )
        decimal = "," if n_decimal_commas > n_decimal_points else "."
        names = make_names_unique(cells[header_row])
        comments, n_rows_seen = [], 0
        for line, block, _ in _iter_line_blocks(file):
            skipped_lines = _find_comment_lines(
                block, delimiter, cells[header_row], n_lines_above - line
            )
            comments += [line + i for i in skipped_lines]
            n_rows_seen += sum(bool(text.strip()) for text in _split_lines(block)) - len(
                skipped_lines
            )
            if n_rows_seen >= n_lines_above + rows:
                # behind the rows that are read nothing has to be passed over
                break
        pandas_options = _pandas_options(
            delimiter, decimal, (n_lines_above, comments), [*names, _EXTRA_COLUMN]
        )
        try:
            table = pd.read_csv(file, **pandas_options | {"skip_blank_lines": True}, nrows=rows)[
                names
            ]
        except (ValueError, csv.Error) as error:
            reason = truncate(" ".join(str(error).split()), 200)
            raise DataError(f"{path}: not a regular table ({reason})") from error
    table = coerce_numeric(table, decimal)
    table.attrs["between"] = cells[header_row + 1 : n_lines_above]
    reader_settings = {"kind": "csv"} | ({"delimiter": delimiter} if delimiter != "," else {})
    return table, reader_settings | ({"decimal": ","} if decimal == "," else {})


def _detect_delimiter(path: Path, lines: list[str]) -> tuple[str, list[list[str]], tuple[int, int]]:
    """Return the delimiter whose cells are names over values in most lines, and where they stand.

    Returns:
        The delimiter, the cells of the first lines, and the places of the names and first values.
    """
    candidates: list[tuple[int, int, tuple[str, list[list[str]], tuple[int, int]]]] = []
    text = "".join(lines[:_SNIFFED_LINES])
    for delimiter in (",", ";", "\t", "|", WHITESPACE_DELIMITER):
        if candidates if delimiter == WHITESPACE_DELIMITER else delimiter not in text:
            continue
        rows = [
            _split_line(_COMMENT_PREFIX.sub("", line, count=1), delimiter)
            for line in lines[:_SNIFFED_LINES]
        ]
        header_position = find_header(rows)
        if header_position is None:
            continue
        names = rows[header_position[0]]
        n_columns, n_named_columns = (
            len(names),
            max((i for i, name in enumerate(names, 1) if name), default=0),
        )
        value_rows = [row for row in rows[header_position[1] :] if any(row)]
        n_regular_rows = sum(
            n_named_columns <= len(row) <= n_columns or (len(row) == n_columns + 1 and not row[-1])
            for row in value_rows
        )
        if n_columns > 1 and 2 * n_regular_rows > len(value_rows):
            candidates.append((n_regular_rows, n_columns, (delimiter, rows, header_position)))
    if not candidates and sum(map(bool, map(str.strip, lines))) == 1:
        raise DataError(
            f"{path}: holds one line ('{truncate(lines[0], 60)}') and no row of numbers below it; was"
            " the recording stopped at once? Leave the file out"
        )
    if not candidates:
        raise DataError(
            f"{path}: no line holds names of columns above its numbers; write one, with the sign"
            f" between them that stands between numbers (its first line: '{truncate(lines[0], 60)}')"
        )
    return max(candidates, key=lambda entry: entry[:2])[2]


def _split_line(line: str, delimiter: str) -> list[str]:
    """Return the cells of one line; a line that is no table's is one cell."""
    if delimiter == WHITESPACE_DELIMITER:
        return line.split()
    try:
        row = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
    except csv.Error:
        return [line]
    return [cell.strip() for cell in row]


def _is_value(cell: str) -> bool:
    """Return whether a cell holds a number, with or without its unit, a date or a time of day."""
    return bool(_NUMBER.fullmatch(cell) or _TIME.match(cell) or _parse_trailing_unit(cell))


def _find_header_with_columns(
    path: Path, delimiter: str, file: Path, columns: Sequence[str]
) -> Header:
    """Return the first line of a text table that holds all the names; else its first line."""
    required_names = set(columns)

    def iter_rows(stream: TextIO) -> Iterator[tuple[int, list[str]]]:
        if delimiter == WHITESPACE_DELIMITER:
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
            for number, row in islice(iter_rows(stream), _HEADER_SEARCH_LINES):
                uncommented_cells = _COMMENT_PREFIX.sub("", delimiter.join(row), count=1).split(
                    delimiter
                )
                rows.append((number, row, uncommented_cells))
                if names is None:
                    matching_rows = (
                        cells
                        for cells in (uncommented_cells, row)
                        if required_names <= {*cells, *make_names_unique(cells)}
                    )
                    names = next(matching_rows, None)
                    rows = rows if names is None else rows[-1:]
                elif len(rows) > _MAX_UNIT_LINES:
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
    unique_names = make_names_unique(names)
    column_positions = [unique_names.index(column) for column in columns if column in unique_names]
    n_unit_lines = _count_unit_lines([row for _, row, _ in rows[1:]], column_positions)
    return Header(tuple(names), rows[n_unit_lines][0])


def _count_unit_lines(rows: Sequence[Sequence[str]], column_positions: Iterable[int]) -> int:
    """Return how many of the first rows hold words, such as units, where values are wanted."""
    column_positions, count = list(column_positions), 0
    for row in rows[:_MAX_UNIT_LINES]:
        cells = [row[i] for i in column_positions if i < len(row)]
        if not any(cells) or any(map(_is_value, cells)):
            break
        count += 1
    return count


def find_header(rows: Sequence[Sequence[str]]) -> tuple[int, int] | None:
    """Return which of the first rows holds names, and which is the first with values.

    None where no row above the values can be one of names.

    Args:
        rows: cells of the first rows, without the blanks around them.
    """
    n_filled = [sum(map(bool, row)) for row in rows]
    n_values = [sum(map(_is_value, row)) for row in rows]
    # what most rows look like is the table
    later_counts = sorted(n_filled[len(n_filled) // 2 :])
    typical_count = later_counts[len(later_counts) // 2] if rows else 0
    for header_row, row in enumerate(rows):
        n_words = n_filled[header_row] - n_values[header_row]
        if n_filled[header_row] < max(2, 0.8 * typical_count) or n_words <= n_values[header_row]:
            continue
        first_value_row = (
            header_row + 1 + _count_unit_lines(rows[header_row + 1 :], range(len(row)))
        )
        # a title of several cells has names beneath it, a table has values
        following_rows = rows[first_value_row : first_value_row + 3]
        if following_rows and not any(
            sum(map(_is_value, cells)) >= 0.3 * typical_count for cells in following_rows
        ):
            continue
        # groups above the names are passed over
        while (
            header_row + 1 < first_value_row
            and _has_repeated_cells(rows[header_row])
            and not _has_repeated_cells(rows[header_row + 1])
        ):
            header_row += 1
        # so is a table about the columns that stands above theirs
        nested_header = find_header(rows[first_value_row:])
        if nested_header is not None:
            names = rows[first_value_row + nested_header[0]]
            if (
                names != rows[header_row]
                and not any(map(_is_value, names))
                and not _has_repeated_cells(names)
            ):
                return first_value_row + nested_header[0], first_value_row + nested_header[1]
        return header_row, first_value_row
    return None


def _has_repeated_cells(row: Sequence[str]) -> bool:
    filled_cells = [cell for cell in row if cell]
    return len(set(filled_cells)) < len(filled_cells)


def _check_lines(path: Path, delimiter: str, header: Header, file: Path) -> tuple[bool, list[int]]:
    """Look at every line of values: as many cells each as the header; blank lines do not count.

    A parser fills short lines with nothing and reads on; cells that slipped by one column would be
    numbers like any other. A delimiter more or less at the end of every line makes no cell.

    Returns:
        Whether the file ends within its last line, and the numbers of lines, from 0, that hold
        none: they begin with `#`, `%` or `//`, or repeat the names.
    """
    n_columns, n_lines_above = len(header.names), header.n_lines_above
    # names that are missing at the end are those of cells that are not there
    n_named_columns = max(
        (i for i, name in enumerate(header.names, start=1) if name), default=n_columns
    )
    is_truncated, n_lines = _is_truncated(file, delimiter, n_named_columns), 0
    comments: list[int] = []
    for first_line, block, is_last_block in _iter_line_blocks(file):
        if b"\x00" in block:
            line_index = first_line + block[: block.index(b"\x00")].count(b"\n") + 1
            raise DataError(
                f"{path}: line {line_index} holds a zero byte, which no text has; the file is damaged or"
                " not UTF-8, write it again"
            )
        cells = _count_cells(block, delimiter, n_columns)
        is_irregular = (cells != n_columns) & (cells != 0)
        is_irregular[: max(n_lines_above - first_line, 0)] = False
        skipped_lines = _find_comment_lines(
            block, delimiter, header.names, n_lines_above - first_line
        )
        comments += [first_line + i for i in skipped_lines]
        is_irregular[[i for i in skipped_lines if i < is_irregular.size]] = False
        if is_irregular.any():
            # rarely so: an empty cell more at the end of lines, or without names
            rows = _split_lines(block)
            sign = delimiter.encode()
            has_trailing_delimiter = np.array([row.rstrip(b" ").endswith(sign) for row in rows])
            is_irregular &= ~((cells >= n_named_columns) & (cells < n_columns))
            is_irregular &= (
                ~((cells == n_columns + 1) & has_trailing_delimiter)
                if has_trailing_delimiter.size == cells.size
                else True
            )
        if is_last_block and is_truncated:
            is_irregular[-1:] = False
        if is_irregular.any():
            line_index = int(np.argmax(is_irregular))
            raise DataError(
                f"{path}: line {first_line + line_index + 1} has {cells[line_index]} cells, the header {n_columns}"
                f" ({int(is_irregular.sum())} such lines nearby); check `delimiter` and `decimal`, or delete"
                " the damaged lines"
            )
        n_lines = first_line + cells.size
    return is_truncated and n_lines - 1 not in comments[-1:], comments


def _iter_line_blocks(path: Path) -> Iterator[tuple[int, bytes, bool]]:
    """Yield blocks of whole lines: the number of the first, its bytes, and whether it is the last.

    Line ends are one byte each, and an open quote takes its line ends along.
    """
    with path.open("rb") as stream:
        pending, line_number = b"", 0
        while True:
            block = stream.read(_BLOCK_BYTES)
            text, tail = pending + block, b""
            if b"\r" in text:
                # the other half of a line end may stand in the next block
                if block and text.endswith(b"\r"):
                    text, tail = text[:-1], b"\r"
                text = text.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
            if not block:
                if text:
                    yield line_number, text, True
                return
            block_end = text.rfind(b"\n") + 1 if text.count(b'"') % 2 == 0 else 0
            if block_end:
                yield line_number, text[:block_end], False
                line_number += text.count(b"\n", 0, block_end)
            pending = text[block_end:] + tail


def _split_lines(block: bytes) -> list[bytes]:
    lines = block.split(b"\n")
    return lines if lines[-1] else lines[:-1]


def _find_comment_lines(
    block: bytes, delimiter: str, names: Sequence[str], n_lines_above: int
) -> list[int]:
    """Return which lines below those `n_lines_above` are comments, or the names again."""
    header_cells, longest_name = (
        list(names),
        max(names, key=len, default="").encode() or _COMMENT_SIGNS[0],
    )
    offset = 0
    for _ in range(n_lines_above):
        offset = block.find(b"\n", offset) + 1 or len(block)
    block = block[offset:]
    if not any(sign in block for sign in (*_COMMENT_SIGNS, longest_name)):
        return []
    return [
        i
        for i, line in enumerate(_split_lines(block), max(n_lines_above, 0))
        if line.lstrip().startswith(_COMMENT_SIGNS)
        or (
            longest_name in line
            and _split_line(line.decode("utf-8", "replace"), delimiter) == header_cells
        )
    ]


def _count_cells(block: bytes, delimiter: str, n_columns: int) -> np.ndarray:
    """Return the number of cells of each line, usually `wide`; 0 where it is blank."""
    if delimiter == WHITESPACE_DELIMITER:
        return np.array([len(line.split()) for line in _split_lines(block)], dtype=np.int64)
    if b'"' in block:
        text = io.StringIO(block.decode("utf-8", errors="replace"), newline="")
        reader = csv.reader(text, delimiter=delimiter, skipinitialspace=True)
        try:
            return np.array([len(row) if any(row) or len(row) > 1 else 0 for row in reader])
        except csv.Error:
            # a cell of more than 128 kB: an open quote has swallowed the lines after it
            return np.ones(1, dtype=np.int64)
    delimiter_bytes = delimiter.encode()
    if n_columns > 1 and len(delimiter_bytes) == 1:
        # the usual block: every so many marks one is the end of a line, the others are delimiters
        separator_bytes = block.translate(
            None, bytes({*range(256)} - {delimiter_bytes[0], ord("\n")})
        )
        if separator_bytes == (delimiter_bytes * (n_columns - 1) + b"\n") * (
            len(separator_bytes) // n_columns
        ):
            return np.full(len(separator_bytes) // n_columns, n_columns)
    lines = _split_lines(block)
    cells = np.array([line.count(delimiter_bytes) for line in lines], dtype=np.int64) + 1
    for i in np.flatnonzero(cells == 1):
        cells[i] = bool(lines[i].strip())
    return cells


def _is_truncated(path: Path, delimiter: str, n_columns: int) -> bool:
    """Return whether the file ends within its last line.

    It has no end, and too few cells or a last cell shorter than any in that column shortly before.
    """
    with path.open("rb") as stream:
        size = stream.seek(0, io.SEEK_END)
        stream.seek(max(0, size - _HEAD_BYTES))
        tail = stream.read()
    if not tail or tail.endswith((b"\n", b"\r")):
        return False
    lines = [line for line in tail.replace(b"\r", b"\n").split(b"\n") if line.strip()]
    delimiter_bytes = None if delimiter == WHITESPACE_DELIMITER else delimiter.encode()
    last_cells, previous_lines = (
        lines[-1].split(delimiter_bytes),
        [line.split(delimiter_bytes) for line in lines[-51:-1]],
    )
    # the first of several lines may itself be cut, by the tail, or be the header
    last_cell_lengths = [
        len(cells[-1].strip())
        for cells in previous_lines[1:]
        if len(cells) == n_columns and cells[-1].strip()
    ]
    if size <= _HEAD_BYTES and len(lines) < 2:
        return False
    return len(last_cells) < n_columns or (
        bool(last_cell_lengths)
        and len(last_cells) == n_columns
        and len(last_cells[-1].strip()) < min(last_cell_lengths)
    )


def detect_encoding(path: Path) -> str:
    """Return the encoding of a text file: by its byte order mark, else by what its bytes can be.

    Text without a mark is UTF-8 where all of it can be, else UTF-16, Russian (cp1251), Polish
    (cp1250), Western European (cp1252), Japanese (cp932), Korean (cp949) or Chinese (gb18030).
    """
    with path.open("rb") as stream:
        bom_encoding = _encoding_from_bom(stream.read(_HEAD_BYTES))
        if bom_encoding is not None:
            return bom_encoding
        stream.seek(0)
        block = _find_non_utf8_block(stream)
        if not block:
            return "utf-8"
        non_ascii = block.translate(None, _ASCII)
        # words of Cyrillic are runs of such letters; a Latin one stands among plain letters
        if _CYRILLIC.fullmatch(non_ascii) and _LETTER_RUN.search(block):
            return "cp1251"
        western = block.decode("cp1252", errors="replace")
        if _POLISH.search(western):
            return "cp1250"
        # a Latin letter and the next one may look like one Japanese sign, but not the other way
        if _LATIN.fullmatch(western):
            return "cp1252"
        for name, pattern in (
            ("cp932", _JAPANESE),
            ("cp949", _KOREAN),
            ("gb18030", _CHINESE),
            ("cp1252", re.compile("")),
        ):
            with suppress(UnicodeDecodeError):
                if pattern.search(block.decode(name)):
                    return name
        # it gives every byte a sign: numbers can be read, and names stay names
        return "latin-1"


def detect_encoding_of_head(head: bytes) -> str:
    """Return the encoding of a text from its first bytes alone."""
    return _encoding_from_bom(head) or "utf-8"


@contextmanager
def open_as_utf8(path: Path, encoding: str | None = None) -> Iterator[Path]:
    """Yield a file that holds the text of `path` in UTF-8, perhaps behind a byte order mark.

    It is `path` itself where that is UTF-8, or else a temporary one, gone after the context. Zero
    bytes at its end, with which recorders fill what they have not written, are left out.

    Args:
        encoding: its name; None finds it.
    """
    name = codecs.lookup(encoding or detect_encoding(path)).name
    is_multibyte = name.startswith(("utf-16", "utf-32"))
    with path.open("rb") as stream:
        stream.seek(max(0, path.stat().st_size - 1))
        has_trailing_zeros = not is_multibyte and stream.read() == b"\0"
    if name in ("utf-8", "utf-8-sig", "ascii") and not has_trailing_zeros:
        yield path
        return
    content = path.read_bytes()
    content = content.rstrip(b"\0") if has_trailing_zeros else content
    try:
        # half a sign at the end is left out
        text = codecs.getincrementaldecoder(name)().decode(content)
    except UnicodeError as error:
        error_position = getattr(error, "start", 0)
        raise DataError(
            f"{path}: not {name.upper()} text (near byte {error_position}); save the file as UTF-8, or give its"
            " `encoding`"
        ) from error
    with tempfile.TemporaryDirectory() as folder:
        utf8_copy = Path(folder) / path.name
        utf8_copy.write_bytes(text.encode("utf-8"))
        yield utf8_copy


def _encoding_from_bom(head: bytes) -> str | None:
    """Return the encoding that a mark, or the zeros of wide signs, tell; None for neither."""
    for mark, name in _BYTE_ORDER_MARKS.items():
        if head.startswith(mark):
            return name
    if len(head) < 4 or b"\x00" not in head:
        return None
    byte_pairs = np.frombuffer(head[: len(head) // 2 * 2], dtype=np.uint8).reshape(-1, 2)
    even_zero_share, odd_zero_share = (byte_pairs == 0).mean(axis=0)
    if odd_zero_share > 0.5 and even_zero_share < 0.01:
        return "utf-16-le"
    return "utf-16-be" if even_zero_share > 0.5 and odd_zero_share < 0.01 else None


def _find_non_utf8_block(stream: BinaryIO) -> bytes:
    """Return the first block that is no UTF-8, whole lines of it; empty where all of it is."""
    decoder = codecs.getincrementaldecoder("utf-8")()
    while block := stream.read(_SCAN_BYTES):
        try:
            if not (block.isascii() and decoder.getstate()[0] == b""):
                decoder.decode(block)
        except UnicodeDecodeError:
            return block[: block.rfind(b"\n") + 1] or block
    return b""

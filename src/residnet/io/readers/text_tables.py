"""Text tables: detection of delimiter and header, parsing of cells."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np

from residnet.core.errors import DataError, UsageError
from residnet.core.names import suggest_name, truncate
from residnet.core.units import canonical_unit, is_unit
from residnet.io.header_vocabulary import (
    match_input_channel,
    match_state_channel,
    parse_name,
)
from residnet.io.readers.base import ProgressCallback
from residnet.io.readers.cell_values import UNIT, is_value, parse_trailing_unit
from residnet.io.readers.motion_capture import (
    detect_mocap_axes,
    parse_mocap_header,
    read_mocap,
)
from residnet.io.readers.several_tests import open_test_as_utf8
from residnet.io.readers.table_lines import (
    WHITESPACE_DELIMITER,
    Header,
    check_lines,
    find_comment_lines,
    find_separator_lines,
    iter_line_blocks,
    split_line,
    split_lines,
)
from residnet.io.readers.text_encoding import HEAD_BYTES

if TYPE_CHECKING:
    import pandas as pd

_HEADER_SEARCH_LINES = 200
"""Lines in which the header of a table with a channel map is searched."""
_SNIFFED_LINES = 60
"""Lines from which the format of a table without a channel map is detected."""
_MAX_UNIT_LINES = 3
"""Largest number of lines with units or remarks between column names and values."""
# chunks of this size stay in the processor's cache while they are parsed
_CHUNK_ROWS = 20_000
_COMMENT_PREFIX = re.compile(r"\s*(?:#|%|//)\s+")
_FRACTION = rf"\s*-?\d+{{}}\d+(?:[eE][-+]?\d+)?\s*(?:{UNIT})?"
_SIDE = re.compile(r"^(?P<side>[PS])?(?:ORT|TBD|TB)?\s*(?P<number>\d+(?:[.,]\d*)?)$", re.IGNORECASE)
_EXTRA_COLUMN = "beyond the last column"


class HeaderlessTableError(DataError):
    """A table without column names.

    Attributes:
        n_columns: number of columns.
        proposed_names: one word for each column from a line above the numbers, most of them names
            of channels; empty without such a line.
    """

    def __init__(self, path: Path, first_row: Sequence[str], proposed_names: Sequence[str]) -> None:
        self.n_columns = len(first_row)
        self.proposed_names = tuple(proposed_names)
        super().__init__(
            f"{path}: has {len(first_row)} columns of numbers without names (first row:"
            f" {truncate(' '.join(first_row), 80)}); name them once for all files, in order:"
            " residnet new --names t,x,y,..., the key `names` of the reader in a config,"
            " or in Python read_logs(files, names=[...])"
        )


def make_names_unique(names: Sequence[str]) -> list[str]:
    """Return unique column names: repeated names and empty names receive a number."""
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
    """Return the indices of columns in a header.

    Args:
        path: file of the table, for messages.
        header: all column names, which may repeat.
        columns: required names; of a repeated name `name.0` is the first column.

    Raises:
        UsageError: if a column is missing.
        DataError: if a required name is ambiguous.
    """
    names = make_names_unique(header)
    for column in columns:
        if column in names:
            continue
        count = list(header).count(column)
        if count > 1:
            raise DataError(
                f"{path}: the header contains column '{column}' {count} times; write"
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
    names: Sequence[str] | None = None,
) -> pd.DataFrame:
    """Read columns of a text table.

    Args:
        path: file of the table.
        columns: names of the columns to read.
        delimiter: separator of cells.
        decimal: decimal sign.
        encoding: encoding of the text; None detects it.
        advance: callback that receives the fraction of the file that has been read.
        names: names of all columns of a table without a line of names; None searches that line.

    Returns:
        The columns in the requested order. `attrs` has `n_lines_above` (lines above the values
        minus one), `is_truncated` (whether an incomplete last line was dropped), `n_blank_lines`
        (skipped lines with separators only) and `units` (the unit in the cells of each column, or
        an empty string).

    Raises:
        UsageError: if a column is missing.
        DataError: if the file is no regular table in this encoding.
    """
    import pandas as pd

    with open_test_as_utf8(path, encoding) as (file, row_offset):
        try:
            header = (
                _find_header_with_columns(path, delimiter, file, columns)
                if names is None
                else _locate_values(path, delimiter, file, names)
            )
            n_columns = len(header.names)
            size = max(1, file.stat().st_size)
            try:
                column_positions = find_column_positions(path, header.names, columns)
            except UsageError as error:
                hint = f" (only one column found; is the delimiter really '{delimiter}'?)"
                raise UsageError(f"{error}{hint if n_columns == 1 else ''}") from None
            is_truncated, comments, n_blank_lines = check_lines(path, delimiter, header, file)
            chunks: dict[int, list[pd.Series]] = {position: [] for position in column_positions}
            with file.open("rb") as stream:
                pandas_options = _pandas_options(
                    delimiter, decimal, (header.n_lines_above, comments), range(n_columns)
                )
                for chunk in pd.read_csv(stream, **pandas_options, chunksize=_CHUNK_ROWS):
                    for position, column_chunks in chunks.items():
                        # without a copy the chunk with all columns would stay in memory
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
    table.attrs |= {
        "n_lines_above": header.n_lines_above - 1 + row_offset,
        "is_truncated": is_truncated,
        "n_blank_lines": n_blank_lines,
        "units": units,
    }
    return table


def _pandas_options(
    delimiter: str, decimal: str, skipped_lines: tuple[int, Iterable[int]], names: Iterable[Any]
) -> dict[str, Any]:
    """Return the arguments of `pandas.read_csv` for the values of a table.

    Args:
        delimiter: separator of cells.
        decimal: decimal sign.
        skipped_lines: number of lines above the values, and indices of comment lines.
        names: column labels.
    """
    return {
        # utf-8-sig keeps a byte order mark out of the first name
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
    """Convert columns of text to numbers where all cells are numbers.

    Args:
        table: columns of text or numbers.
        decimal: decimal sign.

    Returns:
        The converted table; `attrs["units"]` has the unit in the cells of each column, or an empty
        string.
    """
    import pandas as pd

    coerced = [_coerce_column(cells, decimal) for _, cells in table.items()]
    coerced_table = pd.DataFrame({i: cells for i, (cells, _) in enumerate(coerced)}, table.index)
    coerced_table.columns = table.columns
    coerced_table.attrs = {**table.attrs, "units": [unit for _, unit in coerced]}
    return coerced_table


_N_SAMPLED_CELLS = 100
"""Number of cells that are tested first; most columns of text are rejected from these."""


def _coerce_column(cells: pd.Series, decimal: str) -> tuple[pd.Series, str]:
    """Convert one column to numbers.

    Thousands separators, marks of missing values (`---`) and a unit common to all cells (`1450
    rpm`) are removed. A column with a remaining word is not converted. Neither is one whose cells
    all have exactly one separator, which could also be a decimal sign before three digits.

    Returns:
        The column, converted or unchanged, and the unit in its cells or an empty string.
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
    signed_cells = _replace_sides(cells)
    unit, unitless_cells = _strip_unit(signed_cells)
    # a word among the first cells rejects the column before all cells are copied
    head = unitless_cells.iloc[:_N_SAMPLED_CELLS].map(normalize_number)
    if pd.to_numeric(head, errors="coerce").isna().sum() != head.isna().sum():
        return cells, ""
    separator_counts = {
        len(re.findall(r"[^\d+-]", str(cell).strip())) for cell in unitless_cells.dropna()
    }
    normalized = unitless_cells.map(normalize_number)
    values = pd.to_numeric(normalized, errors="coerce")
    is_numeric = (
        unit or signed_cells is not cells or separator_counts != {1}
    ) and values.isna().sum() == normalized.isna().sum()
    return (values, unit) if is_numeric else (cells, "")


def _replace_sides(cells: pd.Series) -> pd.Series:
    """Replace the sides of cells such as `P12.3` and `S05.0` by signs, positive to starboard."""
    texts = cells.dropna().astype("string").str.strip()
    texts = texts[texts.str.contains(r"\w")]
    parts = texts.iloc[:_N_SAMPLED_CELLS].str.extract(_SIDE)
    if not len(parts) or parts["number"].isna().any() or parts["side"].isna().all():
        return cells
    parts = texts.str.extract(_SIDE)
    signed_texts = parts["side"].str.upper().eq("P").map({True: "-", False: ""}) + parts["number"]
    return signed_texts.fillna(texts).astype(object).reindex(cells.index)


def _strip_unit(cells: pd.Series) -> tuple[str, pd.Series]:
    """Split a unit that follows the number in every cell from the cells.

    Returns:
        The unit and the cells without it, or an empty string and the unchanged cells.
    """
    filled_cells = cells.dropna()
    unit_text = parse_trailing_unit(str(filled_cells.iloc[0]).strip()) if len(filled_cells) else ""
    if not unit_text:
        return "", cells
    stripped_cells = filled_cells.astype("string").str.strip()
    if not stripped_cells.str.endswith(unit_text).all():
        return "", cells
    unitless_texts = stripped_cells.str.removesuffix(unit_text).str.strip().astype(object)
    return canonical_unit(unit_text), unitless_texts.reindex(cells.index)


def read_table_head(
    path: Path,
    rows: int,
    column_names: Sequence[str] | None = None,
    mocap_body: str | None = None,
) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Read the first rows of a text table and detect its format.

    Args:
        path: file of the table.
        rows: largest number of rows to read.
        column_names: names of all columns of a table without a line of names.
        mocap_body: rigid body of an export of a motion-capture system; None reads all.

    Returns:
        The rows, with the cells of the lines between names and values in `attrs["unit_rows"]`, and
        the settings `kind`, `delimiter` and `decimal` of a reader.

    Raises:
        HeaderlessTableError: if the table has no line of names, and none are given.
        DataError: if the file is empty or no table.
    """
    import pandas as pd

    with open_test_as_utf8(path) as (file, _):
        with file.open("rb") as stream:
            head = stream.read(HEAD_BYTES)
        lines = head.decode("utf-8-sig", errors="replace").splitlines()
        lines = lines[:-1] if len(head) == HEAD_BYTES else lines
        if not any(line.strip() for line in lines) or b"\x00" in head:
            raise DataError(
                f"{path}: the file is empty or no text; a table with a header line was expected"
            )
        if "---" in lines and any(line.startswith("header:") for line in lines):
            raise DataError(
                f"{path}: contains the output of `ros2 topic echo`; record a bag"
                " (`ros2 bag record`), or convert it to csv, in Python pandas.json_normalize("
                "list(yaml.safe_load_all(open(file)))).to_csv('log.csv', index=False)"
            )
        if column_names is None and parse_mocap_header(path, lines) is not None:
            axes = detect_mocap_axes(file, rows, mocap_body)
            settings: dict[str, Any] = {"kind": "csv", "mocap_up": axes.up, "mocap_bow": axes.bow}
            settings |= {} if mocap_body is None else {"mocap_body": mocap_body}
            return read_mocap(file, axes, mocap_body, rows), settings
        if column_names is None:
            delimiter, cells, (header_row, n_lines_above) = _detect_delimiter(path, lines)
            if header_row + 1 < n_lines_above:
                _refuse_names_in_two_rows(path, cells[header_row], cells[header_row + 1])
        else:
            delimiter, cells, n_lines_above = _detect_values(path, lines, len(column_names))
            # the names take the place of the line above the values
            header_row = n_lines_above
            cells = [*cells[:n_lines_above], [*column_names], *cells[n_lines_above:]]
        # a comma that separates cells is no decimal sign
        sampled_cells = [cell for row in cells[1:50] for cell in row] if delimiter != "," else []
        n_decimal_commas, n_decimal_points = (
            sum(bool(re.fullmatch(_FRACTION.format(sign), cell)) for cell in sampled_cells)
            for sign in (",", r"\.")
        )
        decimal = "," if n_decimal_commas > n_decimal_points else "."
        names = make_names_unique(cells[header_row])
        comments = []
        n_rows_seen = 0
        for line, block, _ in iter_line_blocks(file):
            skipped_lines = find_comment_lines(
                block, delimiter, cells[header_row], n_lines_above - line
            )
            skipped_lines = sorted(
                {*skipped_lines, *find_separator_lines(block, delimiter, len(names))}
            )
            comments += [line + i for i in skipped_lines]
            n_rows_seen += sum(bool(text.strip()) for text in split_lines(block)) - len(
                skipped_lines
            )
            if n_rows_seen >= n_lines_above + rows:
                # comments behind the requested rows need not be known
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
    table.attrs["unit_rows"] = cells[header_row + 1 : n_lines_above]
    reader_settings = {"kind": "csv"} | ({"delimiter": delimiter} if delimiter != "," else {})
    return table, reader_settings | ({"decimal": ","} if decimal == "," else {})


def _detect_delimiter(path: Path, lines: list[str]) -> tuple[str, list[list[str]], tuple[int, int]]:
    """Return the delimiter that splits most lines into a regular table with a header.

    Args:
        path: file of the table, for messages.
        lines: first lines of the file.

    Returns:
        The delimiter, the cells of the first lines, and the indices of the line of names and of the
        first line of values.

    Raises:
        DataError: if no delimiter gives a table with a header.
    """
    candidates: list[tuple[int, int, tuple[str, list[list[str]], tuple[int, int]]]] = []
    text = "".join(lines[:_SNIFFED_LINES])
    for delimiter in (",", ";", "\t", "|", WHITESPACE_DELIMITER):
        if candidates if delimiter == WHITESPACE_DELIMITER else delimiter not in text:
            continue
        rows = [
            split_line(_COMMENT_PREFIX.sub("", line, count=1), delimiter)
            for line in lines[:_SNIFFED_LINES]
        ]
        header_position = find_header(rows)
        if header_position is None:
            continue
        names = rows[header_position[0]]
        n_columns = len(names)
        # the last columns may have no name and no cells
        n_named_columns = max((i for i, name in enumerate(names, 1) if name), default=0)
        value_rows = [row for row in rows[header_position[1] :] if any(row)]
        n_regular_rows = sum(
            n_named_columns <= len(row) <= n_columns or (len(row) == n_columns + 1 and not row[-1])
            for row in value_rows
        )
        if n_columns > 1 and 2 * n_regular_rows > len(value_rows):
            candidates.append((n_regular_rows, n_columns, (delimiter, rows, header_position)))
    if not candidates and sum(map(bool, map(str.strip, lines))) == 1:
        raise DataError(
            f"{path}: contains one line ('{truncate(lines[0], 60)}') and no row of numbers below"
            " it; leave the file out"
        )
    if not candidates and (values := _find_values(lines)) is not None:
        _, rows, first_row = values
        proposed_names = _propose_names(lines[:first_row], len(rows[first_row]))
        raise HeaderlessTableError(path, rows[first_row], proposed_names)
    if not candidates:
        raise DataError(
            f"{path}: no line with column names above the numbers; add one with the delimiter of"
            f" the numbers (first line: '{truncate(lines[0], 60)}')"
        )
    return max(candidates, key=lambda entry: entry[:2])[2]


def _find_values(lines: Sequence[str]) -> tuple[str, list[list[str]], int] | None:
    """Find the rows of numbers in a table without column names.

    Args:
        lines: first lines of the file.

    Returns:
        The delimiter, the cells of the first lines, and the index of the first row of numbers; None
        if most of the lines are no rows of numbers with the same number of cells.
    """
    for delimiter in (";", "\t", "|", ",", WHITESPACE_DELIMITER):
        rows = [split_line(line, delimiter) for line in lines[:_SNIFFED_LINES]]
        later_rows = [row for row in rows[len(rows) // 2 :] if any(row)]
        # the last delimiter may end the line
        later_rows = [row[:-1] if row and not row[-1] else row for row in later_rows]
        n_columns = len(later_rows[0]) if later_rows else 0
        is_regular = [len(row) == n_columns and all(map(is_value, row)) for row in later_rows]
        if n_columns < 2 or 2 * sum(is_regular) <= len(is_regular):
            continue
        rows = [row[:-1] if len(row) == n_columns + 1 and not row[-1] else row for row in rows]
        for i, row in enumerate(rows):
            if len(row) == n_columns and all(map(is_value, row)):
                return delimiter, rows, i
    return None


def _detect_values(
    path: Path, lines: Sequence[str], n_names: int
) -> tuple[str, list[list[str]], int]:
    """Return delimiter, cells and index of the first row of a table whose names are given.

    Raises:
        DataError: if the table has no rows of numbers, or another number of columns than names.
    """
    values = _find_values(lines)
    if values is None:
        raise DataError(
            f"{path}: has no rows of numbers that `names` could name (first line:"
            f" '{truncate(lines[0], 60)}'); leave `names` out if the file has a line of names"
        )
    delimiter, rows, first_row = values
    if len(rows[first_row]) != n_names:
        raise DataError(
            f"{path}: has {len(rows[first_row])} columns, and {n_names} names are given; give one"
            " name for each column (key `names`, or residnet new --names)"
        )
    return delimiter, rows, first_row


def _propose_names(lines: Sequence[str], n_columns: int) -> list[str]:
    """Return the last words of a line of prose above the numbers that look like column names.

    There is one different word for each column, and at least half of the words name the time or a
    channel. Empty if no line has such words.
    """
    for line in reversed(lines):
        words = [word for word in re.split(r"[\s,;|]+", line) if re.search(r"\w", word)]
        names = words[-n_columns:]
        if len(names) < n_columns or len({*names}) < n_columns or any(map(is_value, names)):
            continue
        parsed_names = [parse_name(name) for name in names]
        n_known = sum(
            parsed_name.has_all("time")
            or match_state_channel(parsed_name) is not None
            or match_input_channel(parsed_name) is not None
            for parsed_name in parsed_names
        )
        if 2 * n_known >= n_columns:
            return names
    return []


def _locate_values(path: Path, delimiter: str, file: Path, names: Sequence[str]) -> Header:
    """Return the header of a table without a line of names.

    Args:
        path: file of the table, for messages.
        delimiter: separator of cells.
        file: the same text in UTF-8.
        names: names of all columns.

    Raises:
        DataError: if no line has as many numbers as there are names.
    """
    with file.open(encoding="utf-8-sig", errors="replace") as stream:
        for i, line in enumerate(islice(stream, _HEADER_SEARCH_LINES)):
            row = split_line(line.rstrip("\r\n"), delimiter)
            row = row[:-1] if len(row) == len(names) + 1 and not row[-1] else row
            if len(row) == len(names) and 2 * sum(map(is_value, row)) > len(row):
                return Header(tuple(names), i)
    raise DataError(
        f"{path}: no line has {len(names)} numbers, one for each of the `names`; check `names` and"
        " `delimiter`"
    )


def _iter_numbered_rows(stream: TextIO, delimiter: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the line number and the cells of each row of a text table."""
    if delimiter == WHITESPACE_DELIMITER:
        yield from enumerate((line.split() for line in stream), start=1)
        return
    reader = csv.reader(stream, delimiter=delimiter, skipinitialspace=True)
    for row in reader:
        yield reader.line_num, [cell.strip() for cell in row]


def count_numbers(line: str) -> int:
    """Return the number of cells of a line of numbers; 0 if a cell is no number."""
    cells = [cell for cell in re.split(r"[\s,;|]+", line) if cell]
    return len(cells) if all(map(is_value, cells)) else 0


def _find_header_with_columns(
    path: Path, delimiter: str, file: Path, columns: Sequence[str]
) -> Header:
    """Return the first line with all required names as header, or the first line of the file.

    Args:
        path: file of the table, for messages.
        delimiter: separator of cells.
        file: the same text in UTF-8.
        columns: required names.

    Raises:
        DataError: if the file is empty or its first line is no header.
    """
    required_names = set(columns)

    names: list[str] | None = None
    # line number, cells, and cells without the sign of a comment
    rows: list[tuple[int, list[str], list[str]]] = []
    with file.open(newline="", encoding="utf-8-sig") as stream:
        try:
            for number, row in islice(_iter_numbered_rows(stream, delimiter), _HEADER_SEARCH_LINES):
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
                    f"{path}: line 1 is no header with column names ({error}); check for an"
                    " unclosed quotation mark, or for missing lines at the beginning"
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
    """Return how many of the first rows have text, such as units, in the given columns."""
    column_positions = list(column_positions)
    count = 0
    for row in rows[:_MAX_UNIT_LINES]:
        cells = [row[i] for i in column_positions if i < len(row)]
        if not any(cells) or any(map(is_value, cells)):
            break
        count += 1
    return count


def find_header(rows: Sequence[Sequence[str]]) -> tuple[int, int] | None:
    """Find the row of column names and the first row of values.

    Args:
        rows: cells of the first rows, without surrounding blanks.

    Returns:
        The indices of both rows; None if no row above the values can be a header.
    """
    n_filled = [sum(map(bool, row)) for row in rows]
    n_values = [sum(map(is_value, row)) for row in rows]
    # the second half of the rows belongs to the table, whatever precedes it
    later_counts = sorted(n_filled[len(n_filled) // 2 :])
    typical_count = later_counts[len(later_counts) // 2] if rows else 0
    for header_row, row in enumerate(rows):
        n_words = n_filled[header_row] - n_values[header_row]
        if n_filled[header_row] < max(2, 0.8 * typical_count) or n_words <= n_values[header_row]:
            continue
        first_value_row = (
            header_row + 1 + _count_unit_lines(rows[header_row + 1 :], range(len(row)))
        )
        # below a title of several cells are names, below a header are values
        following_rows = rows[first_value_row : first_value_row + 3]
        if following_rows and not any(
            sum(map(is_value, cells)) >= 0.3 * typical_count for cells in following_rows
        ):
            continue
        # skip a row that groups columns: it repeats names, and the row below it does not
        while (
            header_row + 1 < first_value_row
            and _has_repeated_cells(rows[header_row])
            and not _has_repeated_cells(rows[header_row + 1])
            and not _has_units_below_names(rows[header_row], rows[header_row + 1])
        ):
            header_row += 1
        # skip a smaller table above, which describes the columns
        nested_header = find_header(rows[first_value_row:])
        if nested_header is not None:
            names = rows[first_value_row + nested_header[0]]
            if (
                names != rows[header_row]
                and not any(map(is_value, names))
                and not _has_repeated_cells(names)
            ):
                return first_value_row + nested_header[0], first_value_row + nested_header[1]
        return header_row, first_value_row
    return None


def _has_units_below_names(upper: Sequence[str], lower: Sequence[str]) -> bool:
    """Return whether a row has units below all names that the row above has once.

    The first letters of a name, such as `t` below `Time`, abbreviate it and are no unit.
    """
    cells_of_single_names = [
        (name, below)
        for name, below in zip(upper, lower, strict=False)
        if name and below and list(upper).count(name) == 1
    ]
    return bool(cells_of_single_names) and all(
        is_unit(below.strip("[]()")) and not name.lower().startswith(below.lower())
        for name, below in cells_of_single_names
    )


def _refuse_names_in_two_rows(path: Path, upper: Sequence[str], lower: Sequence[str]) -> None:
    """Refuse a header such as `Position`, `Position` above `X`, `Y`: neither row has all names.

    Raises:
        DataError: if words in the lower row distinguish columns of one name in the upper row.
    """
    for name in dict.fromkeys(cell for cell in upper if cell):
        words = [below for above, below in zip(upper, lower, strict=False) if above == name]
        is_distinguished = len(words) > 1 and all(words) and not _has_repeated_cells(words)
        if is_distinguished and not any(is_unit(word.strip("[]()")) for word in words):
            raise DataError(
                f"{path}: two rows together name the columns: '{name}' above"
                f" {', '.join(words)}; write the names in one row, for example '{name} {words[0]}',"
                " or name all columns in order: residnet new --names t,x,y,..."
            )


def _has_repeated_cells(row: Sequence[str]) -> bool:
    filled_cells = [cell for cell in row if cell]
    return len(set(filled_cells)) < len(filled_cells)

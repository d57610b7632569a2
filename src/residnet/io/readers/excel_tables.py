"""Sheets of Excel files as tables: header, units and decimal commas are detected."""

from __future__ import annotations

import re
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from residnet.core.errors import DataError, UsageError
from residnet.core.names import suggest_name
from residnet.core.units import is_unit
from residnet.io.readers.base import optional_import, wrap_read_errors
from residnet.io.readers.text_tables import find_header, make_names_unique

if TYPE_CHECKING:
    import pandas as pd

_HEADER_SEARCH_ROWS = 60
"""Rows of a sheet in which the header is searched."""
_MIN_TABLE_COLUMNS = 3
"""Smallest number of columns of a table that occurs several times in a sheet."""
_MAX_CACHED_WORKBOOKS = 1_000
"""Largest number of files whose names of sheets are in the cache."""
_MAX_CACHED_CELLS = 1_000_000
"""Largest number of cells in the cache of sheets, about 40 MB."""

_FileVersion = tuple[str, int, int, int]
"""Path, inode, size in bytes and time of the last change in ns of a file."""
# a draft reads each sheet three times: the preview, the guesses and the check of the channel map
_cached_cells: OrderedDict[tuple[_FileVersion, str], pd.DataFrame] = OrderedDict()
_cached_sheet_names: OrderedDict[_FileVersion, list[str]] = OrderedDict()


def read_excel_sheet(path: Path, sheet: str | None, rows: int | None = None) -> pd.DataFrame:
    """Read a sheet and detect its row of column names.

    Args:
        path: Excel file.
        sheet: name of the sheet; None takes the first one.
        rows: largest number of rows to read; None reads all.

    Returns:
        The cells below the header. `attrs` has `n_lines_above` (rows above the values) and
        `unit_rows` (cells of the rows between names and values).

    Raises:
        UsageError: if the sheet does not exist.
        DataError: if the file cannot be read, or the sheet has several tables.
    """
    import pandas as pd

    names = list_sheet_names(path)
    if sheet is not None and sheet not in names:
        raise UsageError(f"{path}: no sheet '{sheet}'{suggest_name(sheet, names)}")
    cells = _read_cells(path, sheet if sheet is not None else names[0], rows)
    head_rows = [
        ["" if pd.isna(cell) else str(cell).strip() for cell in row]
        for row in cells.head(_HEADER_SEARCH_ROWS).itertuples(index=False)
    ]
    header_row, first_value_row = find_header(head_rows) or (0, 1)
    # the names in the first rows made all columns object columns
    table = cells.iloc[first_value_row:].infer_objects()
    unit_rows = head_rows[header_row + 1 : first_value_row]
    names = head_rows[header_row] if head_rows else []
    if header_row > 0 and _is_unit_row(names):
        unit_rows = head_rows[header_row:first_value_row]
        names = _join_grouped_names(head_rows[:header_row])
    _refuse_several_tables(path, table, names, first_value_row)
    table.columns = pd.Index(make_names_unique(names))
    table = _convert_decimal_commas(table.dropna(how="all"))
    table.attrs |= {
        "n_lines_above": first_value_row,
        "unit_rows": unit_rows,
    }
    return table


def _read_cells(path: Path, sheet: str, rows: int | None) -> pd.DataFrame:
    """Return the cells of a sheet, from the cache if the file has not changed since.

    Args:
        path: Excel file.
        sheet: name of the sheet.
        rows: largest number of rows to read; None reads all.
    """
    import pandas as pd

    with wrap_read_errors(path, "an Excel file"):
        key = (_get_file_version(path), sheet)
        if key in _cached_cells:
            _cached_cells.move_to_end(key)
            return _cached_cells[key].head(rows) if rows is not None else _cached_cells[key]
        cells: pd.DataFrame = pd.read_excel(
            path, sheet_name=sheet, nrows=rows, engine="openpyxl", header=None
        )
    is_complete = rows is None or len(cells) < rows
    if is_complete and cells.size <= _MAX_CACHED_CELLS:
        _cached_cells[key] = cells
        while sum(sheet_cells.size for sheet_cells in _cached_cells.values()) > _MAX_CACHED_CELLS:
            _cached_cells.popitem(last=False)
    return cells


def _get_file_version(path: Path) -> _FileVersion:
    """Return what identifies the content of a file."""
    status = path.stat()
    return (str(path.absolute()), status.st_ino, status.st_size, status.st_mtime_ns)


def _refuse_several_tables(
    path: Path, table: pd.DataFrame, names: Sequence[str], first_value_row: int
) -> None:
    """Refuse a sheet with several tables of the same columns, such as a table for each test.

    Args:
        path: Excel file.
        table: cells below the column names.
        names: column names.
        first_value_row: number of rows above the values.

    Raises:
        DataError: if the column names occur again in a later row, or further right.
    """
    filled = [name for name in names if name]
    if len(filled) < _MIN_TABLE_COLUMNS:
        return
    instruction = "copy each table to a separate file, and give the folder of the files"
    first_name = names.index(filled[0])
    is_repeated = table.iloc[:, first_name].map(lambda cell: str(cell).strip() == filled[0])
    for position in is_repeated.to_numpy().nonzero()[0]:
        cells = [str(cell).strip() for cell in table.iloc[position]]
        if all(name in ("", cell) for name, cell in zip(names, cells, strict=True)):
            raise DataError(
                f"{path}: row {first_value_row + position + 1} has the column names again"
                f" ('{filled[0]}', '{filled[1]}', ...), a sheet has one log; {instruction}"
            )
    half = len(filled) // 2
    if half >= _MIN_TABLE_COLUMNS and filled[0] in filled[1:]:
        width = filled.index(filled[0], 1)
        if width >= _MIN_TABLE_COLUMNS and all(
            name == filled[k % width] for k, name in enumerate(filled)
        ):
            raise DataError(
                f"{path}: has {len(filled) // width} tables side by side, each with '{filled[0]}',"
                f" '{filled[1]}', ..., a sheet has one log; {instruction}"
            )


def _is_unit_row(row: Sequence[str]) -> bool:
    """Return whether all filled cells of a row are units, some of them in brackets."""
    return all(is_unit(cell.strip("[]()")) for cell in row if cell)


def _join_grouped_names(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return column names from the rows above the units.

    The last row has the names. Where it is incomplete, the row before it names groups of columns in
    merged cells, of which the first one is filled: `Position` above `X`, `Y`.

    Args:
        rows: cells of the rows above the units, at least one row.
    """
    lower_names = list(rows[-1])
    if all(lower_names) or len(rows) < 2:
        return lower_names
    names = []
    group = ""
    for group_cell, name in zip(rows[-2], lower_names, strict=True):
        group = group_cell or (group if name else "")
        names.append(f"{group} {name}".strip())
    return names


_DECIMAL_COMMA = re.compile(r"\s*[-+]?\d+(,\d+)?([eE][-+]?\d+)?\s*")
"""A number in a cell of text, with a decimal comma or none."""
_CLEAR_COMMA = re.compile(r"\s*[-+]?(0,\d+|\d+,(\d{1,2}|\d{4,})([eE].*)?)\s*")
"""A number whose comma cannot separate thousands."""


def _convert_decimal_commas(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table whose columns of texts such as `1,091` are numbers.

    A number has no decimal sign in a cell of Excel unless it is a text. A comma before three digits
    may also separate thousands, so that one column has to have a clear decimal comma.
    """
    import pandas as pd

    converted: dict[int, pd.Series] = {}
    has_clear_comma = False
    for position, (_, column) in enumerate(table.items()):
        if not pd.api.types.is_object_dtype(column) and not pd.api.types.is_string_dtype(column):
            continue
        texts = column[column.map(lambda cell: isinstance(cell, str))]
        if texts.empty or not texts.map(lambda text: "," in text).any():
            continue
        if texts.map(lambda text: _DECIMAL_COMMA.fullmatch(text) is not None).all():
            has_clear_comma |= bool(
                texts.map(lambda text: _CLEAR_COMMA.fullmatch(text) is not None).any()
            )
            numbers = column.map(
                lambda cell: float(cell.replace(",", ".")) if isinstance(cell, str) else cell
            )
            converted[position] = pd.to_numeric(numbers, errors="coerce")
    if not has_clear_comma:
        return table
    columns = [
        converted.get(position, column) for position, (_, column) in enumerate(table.items())
    ]
    result: pd.DataFrame = pd.concat(columns, axis=1)
    result.columns = table.columns
    return result


def join_excel_sheets(path: Path, tables: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """Join the sheets of one recording: their rows in order of time, equal times in one row.

    Args:
        path: Excel file.
        tables: sheets by name; the first column of each is the time.

    Returns:
        The joined table; a column is empty in rows of other sheets. `attrs` as in
        `read_excel_sheet`.

    Raises:
        DataError: if the sheets have different names of their first columns, or a common further
            column.
    """
    import pandas as pd

    parts = []
    column_names: list[str] = []
    unit_rows: list[list[str]] = []
    time_name = ""
    for name, table in tables.items():
        names = [str(column) for column in table.columns]
        if not time_name:
            time_name = names[0]
            column_names = [time_name]
        if names[0] != time_name:
            raise DataError(
                f"{path}: the first column of sheet '{name}' is '{names[0]}', expected the time"
                f" '{time_name}' like in sheet '{next(iter(tables))}'; give the sheets the same"
                " column of time"
            )
        common_names = set(names[1:]) & set(column_names)
        if common_names:
            raise DataError(
                f"{path}: column '{min(common_names)}' is in sheet '{name}' and in an earlier one;"
                " rename it in one of them"
            )
        for k, units in enumerate(table.attrs["unit_rows"]):
            if k == len(unit_rows):
                # the first sheet gives the unit of the time
                unit_rows.append(list(units[:1]))
            missing = len(column_names) - len(unit_rows[k])
            unit_rows[k] += [*[""] * missing, *units[1:]]
        column_names += names[1:]
        timed = table.copy()
        timed.attrs = {}
        timed[time_name] = pd.to_numeric(timed[time_name], errors="coerce")
        timed = timed.dropna(subset=[time_name])
        # merging needs unique keys
        parts.append(timed.drop_duplicates(time_name).set_index(time_name))
    joined: pd.DataFrame = pd.concat(parts, axis=1).sort_index().reset_index(names=time_name)
    first_table = next(iter(tables.values()))
    joined.attrs = {"n_lines_above": first_table.attrs["n_lines_above"], "unit_rows": unit_rows}
    return joined


def list_sheet_names(path: Path) -> list[str]:
    """Return the names of the sheets of an Excel file, in order.

    Raises:
        UsageError: if openpyxl is not installed.
        DataError: if the file cannot be read.
    """
    with optional_import("excel", "openpyxl", "an Excel sheet"):
        import openpyxl
    with wrap_read_errors(path, "an Excel file"):
        version = _get_file_version(path)
        if version not in _cached_sheet_names:
            # a workbook that is not closed keeps the file open
            workbook = openpyxl.load_workbook(path, read_only=True)
            _cached_sheet_names[version] = [str(sheet.title) for sheet in workbook.worksheets]
            workbook.close()
        if len(_cached_sheet_names) > _MAX_CACHED_WORKBOOKS:
            _cached_sheet_names.popitem(last=False)
        return list(_cached_sheet_names[version])

"""Sheets of Excel files as tables: header, units and decimal commas are detected."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from residnet.core.errors import DataError, UsageError
from residnet.core.names import suggest_name
from residnet.core.units import is_unit
from residnet.io.readers.excel_cells import list_worksheets
from residnet.io.readers.several_tests import find_test, read_excel_cells
from residnet.io.readers.text_tables import find_header, make_names_unique

if TYPE_CHECKING:
    import pandas as pd

_HEADER_SEARCH_ROWS = 60
"""Rows of a sheet in which the header is searched."""
_MIN_TABLE_COLUMNS = 3
"""Smallest number of columns of a table that occurs several times in a sheet."""


def read_excel_sheet(path: Path, sheet: str | None, rows: int | None = None) -> pd.DataFrame:
    """Read a sheet and detect its row of column names.

    Args:
        path: Excel file, or one of its tests.
        sheet: name of the sheet; None takes the sheet of the test, or the first one.
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
    cells, row_offset = read_excel_cells(path, sheet, rows)
    head_rows = [
        ["" if pd.isna(cell) else str(cell).strip() for cell in row]
        for row in cells.head(_HEADER_SEARCH_ROWS).itertuples(index=False)
    ]
    header_row, first_value_row = find_header(head_rows) or (0, 1)
    table = cells.iloc[first_value_row:]
    # a recorder that is switched on again writes names and units again
    head_texts = {tuple(row) for row in head_rows[header_row:first_value_row] if any(row)}
    is_repeated = [
        isinstance(row[0], str)
        and tuple("" if pd.isna(cell) else str(cell).strip() for cell in row) in head_texts
        for row in table.itertuples(index=False)
    ]
    # the names in the first rows made all columns object columns
    table = table[~np.array(is_repeated, dtype=bool)].infer_objects()
    unit_rows = head_rows[header_row + 1 : first_value_row]
    names = head_rows[header_row] if head_rows else []
    if header_row > 0 and _is_unit_row(names):
        unit_rows = head_rows[header_row:first_value_row]
        names = _join_grouped_names(head_rows[:header_row])
    _refuse_tables_side_by_side(path, names)
    table.columns = pd.Index(make_names_unique(names))
    table = _convert_decimal_commas(table.dropna(how="all"))
    table.attrs |= {
        "n_lines_above": first_value_row + row_offset,
        "unit_rows": unit_rows,
    }
    return table


def _refuse_tables_side_by_side(path: Path, names: Sequence[str]) -> None:
    """Refuse a sheet whose column names occur again further right, and that is not divided.

    Raises:
        DataError: if the names belong to several tables.
    """
    filled = [name for name in names if name]
    if len(filled) < _MIN_TABLE_COLUMNS:
        return
    half = len(filled) // 2
    if half >= _MIN_TABLE_COLUMNS and filled[0] in filled[1:]:
        width = filled.index(filled[0], 1)
        if width >= _MIN_TABLE_COLUMNS and all(
            name == filled[k % width] for k, name in enumerate(filled)
        ):
            raise DataError(
                f"{path}: has {len(filled) // width} tables side by side, each with '{filled[0]}',"
                f" '{filled[1]}', ..., a sheet has one log; copy each table to a separate file, and"
                " give the folder of the files"
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
    """Return the names of the sheets of an Excel file, or of one of its tests, in order.

    Raises:
        UsageError: if openpyxl is not installed.
        DataError: if the file cannot be read.
    """
    test = find_test(path)
    return [*test.sections] if test is not None else list_worksheets(path)

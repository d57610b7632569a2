"""The first rows of a table that nobody described: its columns of numbers and of text."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from residnet.core.errors import DataError, UsageError
from residnet.core.units import known_unit
from residnet.data.readers.base import require_file
from residnet.data.readers.tables import excel_sheet, json_rows, parquet_rows, sheet_names
from residnet.data.readers.texts import first_rows

if TYPE_CHECKING:
    import pandas as pd

_ROWS = 20_000
_BRACKETS = re.compile(r"[\[(]")


@dataclass(frozen=True)
class Sheet:
    """The first rows of one table.

    Attributes:
        path: of the file.
        about: settings of its reader beside time and channels: kind, delimiter, decimal.
        header: names of all columns.
        numbers: values [T] of the columns that hold numbers.
        texts: columns that hold text, dates among them.
        empty: columns that hold nothing.
        columns: what the file calls a column, where its name here has a unit that stands below.
    """

    path: Path
    about: dict[str, Any]
    header: tuple[str, ...]
    numbers: dict[str, np.ndarray]
    texts: dict[str, pd.Series]
    empty: tuple[str, ...]
    columns: dict[str, str]

    def column(self, name: str) -> str:
        """Return what the file calls a column."""
        return self.columns.get(name, name)


def peek(path: Path, rows: int = _ROWS) -> Sheet:
    """Return the first rows of a table, 20,000 where `rows` does not say otherwise.

    Raises:
        UsageError: where there is no file.
        DataError: where it is empty or no table.
    """
    import pandas as pd

    require_file(path)
    if path.suffix.lower() == ".parquet":
        table, about = parquet_rows(path, rows), {"kind": "parquet"}
    elif path.suffix.lower() == ".xlsx":
        table, about = _excel(path, rows)
    elif path.suffix.lower() in (".jsonl", ".ndjson"):
        table, about = json_rows(path, rows), {"kind": "json_lines"}
    else:
        table, about = first_rows(path, rows)
    columns = _described(table)
    table.columns = pd.Index(list(columns))
    if table.empty:
        raise DataError(f"{path}: holds a header and no rows; leave it out")
    numbers: dict[str, np.ndarray] = {}
    texts: dict[str, pd.Series] = {}
    empty = []
    for i, name in enumerate(table.columns):
        column = table.iloc[:, i]
        if column.isna().all():
            empty.append(name)
            continue
        values = pd.to_numeric(column, errors="coerce").to_numpy(dtype=float, na_value=np.nan)
        spoilt = np.isnan(values).sum() > column.isna().sum()
        if spoilt or column.dtype == bool or pd.api.types.is_datetime64_any_dtype(column):
            texts[name] = column
        else:
            numbers[name] = values
    renamed = {name: column for name, column in columns.items() if name != column}
    return Sheet(path, about, tuple(table.columns), numbers, texts, tuple(empty), renamed)


def _described(table: pd.DataFrame) -> dict[str, str]:
    """Return the names of columns with the units that stand beneath them -> their names alone."""
    names = [str(name).strip() for name in table.columns]
    rows = [[_unit_in(cell) for cell in row] for row in table.attrs.get("between", [])]
    units = max(rows, key=lambda row: sum(map(bool, row)), default=[])
    units = units if 2 * sum(map(bool, units)) >= len([name for name in names if name]) else []
    told = [*units, *[""] * len(names)]
    return {
        f"{name} [{unit}]" if unit and not _BRACKETS.search(name) else name: name
        for name, unit in zip(names, told, strict=False)
    }


def _unit_in(cell: str) -> str:
    """Return the unit that a cell beneath a name holds; empty where it holds none."""
    unit = cell.strip(" []()")
    try:
        known_unit(unit)
    except UsageError:
        return ""
    return unit


def _excel(path: Path, rows: int) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Return the first sheet with two columns of numbers, else the first, and its settings."""
    names = sheet_names(path)
    tables = ((name, excel_sheet(path, name, rows)) for name in names)
    for number, (name, table) in enumerate(tables):
        if len(table.select_dtypes("number").columns) > 1:
            return table, {"kind": "excel", **({"sheet": name} if number else {})}
    return excel_sheet(path, None, rows), {"kind": "excel"}

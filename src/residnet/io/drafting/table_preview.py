"""Previews of tables: first rows, names with units, sheets."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from residnet.core.errors import DataError, ResidnetError, UsageError
from residnet.core.names import truncate
from residnet.core.units import is_unit
from residnet.io.drafting.problems import raise_unreadable
from residnet.io.drafting.questions import READER_KEY, DraftNotes
from residnet.io.readers.base import locate_file, require_file
from residnet.io.readers.excel_tables import join_excel_sheets, list_sheet_names, read_excel_sheet
from residnet.io.readers.json_tables import read_json_head
from residnet.io.readers.motion_capture import list_mocap_bodies
from residnet.io.readers.several_tests import list_joined_sheets
from residnet.io.readers.tables import TABLE_KINDS, read_parquet_head
from residnet.io.readers.text_tables import HeaderlessTableError, read_table_head
from residnet.preprocessing.channel_values import mask_fill_values

if TYPE_CHECKING:
    import pandas as pd

_HEAD_READERS = {"parquet": read_parquet_head, "json_lines": read_json_head}
_OPENING_BRACKET = re.compile(r"[\[(]")
_NAME_OVER_UNIT = re.compile(r"(?P<name>.*\S)\s+/\s+(?P<unit>\S.*)")
_MAX_FULL_PREVIEWS = 24
"""Number of tables whose values are loaded; of other tables only the first rows are."""


def preview_named_tables(
    files: Sequence[Path], draft_notes: DraftNotes
) -> tuple[list[TablePreview], dict[Path, ResidnetError], Sequence[str]]:
    """Load the first rows of tables, whose names are asked for if the files have none.

    Returns:
        The previews, the error of each table that cannot be read, and the names of all columns;
        empty if the tables have lines of names.

    Raises:
        UsageError: if the tables have several formats.
        DataError: if no table can be read, or its columns have no names.
    """
    key = (*READER_KEY, "names")
    if draft_notes.has_answer(key):
        answer = draft_notes.require_answer(key, "", DataError("the names are empty"))
    else:
        mocap_body = _ask_mocap_body(files[0], draft_notes)
        try:
            return *preview_tables(files, mocap_body=mocap_body), ()
        except DataError as error:
            refusal = error
        errors = [*getattr(refusal, "errors", {files[0]: refusal}).values()]
        n_columns = {getattr(error, "n_columns", 0) for error in errors}
        headerless = errors[0]
        if not isinstance(headerless, HeaderlessTableError) or len(n_columns) > 1:
            raise refusal
        text = f"{files[0].name} has {headerless.n_columns} columns without names; names, in order"
        if headerless.proposed_names:
            answer = draft_notes.ask_question(
                key,
                text,
                ", ".join(headerless.proposed_names),
                "the files have no line of names; these words stand above the numbers",
            )
        else:
            answer = draft_notes.require_answer(key, text, refusal)
    # names with blanks are separated by commas
    separator = r"[,;]" if re.search(r"[,;]", answer) else r"\s+"
    names = [name.strip() for name in re.split(separator, answer) if name.strip()]
    return *preview_tables(files, names), names


def _ask_mocap_body(path: Path, draft_notes: DraftNotes) -> str | None:
    """Ask for the vessel among several rigid bodies of a motion-capture system.

    Returns:
        The name of the body; None for files with one body, and for other tables.
    """
    file = locate_file(path)
    if TABLE_KINDS.get(file.suffix.lower(), "csv") != "csv":
        return None
    bodies = list_mocap_bodies(file)
    if len(bodies) < 2:
        return None
    names = truncate(", ".join(bodies), 80)
    reason = f"the export has {len(bodies)} rigid bodies ({names}); {bodies[0]} moves most"
    text = f"rigid body of the vessel in {path.name}"
    return draft_notes.ask_question(
        (*READER_KEY, "mocap_body"), text, bodies[0], reason, tuple(bodies[:20])
    )


def preview_tables(
    files: Sequence[Path], names: Sequence[str] | None = None, mocap_body: str | None = None
) -> tuple[list[TablePreview], dict[Path, ResidnetError]]:
    """Load the first rows of tables, 20,000 rows of up to 48 tables and 50 of the others.

    Returns:
        The previews, first one with the settings of most tables, and the error of each table that
        cannot be read.

    Raises:
        UsageError: if the tables have several formats.
        DataError: if no table can be read.
    """
    stride = max(1, len(files) // _MAX_FULL_PREVIEWS)
    previews: list[TablePreview] = []
    errors: dict[Path, ResidnetError] = {}
    for number, path in enumerate(files):
        try:
            rows = 20_000 if number % stride == 0 else 50
            previews.append(preview_table(path, rows, names, mocap_body))
        except DataError as error:
            errors[path] = error
    if not previews:
        raise_unreadable(errors)
    numeric_previews = [sheet for sheet in previews if len(sheet.numeric_columns) > 1]
    if not numeric_previews:
        path = previews[0].path
        names = ", ".join(previews[0].column_names[:12])
        raise DataError(
            f"{path}: fewer than two columns contain numbers (columns: {names}); check the"
            " export of the table"
        )
    if len({sheet.reader_settings["kind"] for sheet in numeric_previews}) > 1:
        raise UsageError("the tables have several formats, one was expected; give those of one")
    # the most detailed settings: a table of integers, for example, has no decimal sign
    all_settings = [sheet.reader_settings for sheet in numeric_previews]
    main_preview = max(
        numeric_previews,
        key=lambda sheet: (len(sheet.reader_settings), all_settings.count(sheet.reader_settings)),
    )
    return [main_preview, *(sheet for sheet in previews if sheet is not main_preview)], errors


@dataclass(frozen=True)
class TablePreview:
    """First rows of one table.

    Attributes:
        path: path of the file.
        reader_settings: settings `kind`, `delimiter`, `decimal` and `sheet` of its reader.
        column_names: names of all columns, with a unit from the row below in brackets.
        numeric_columns: column -> numbers [T].
        text_columns: column -> texts [T], including dates.
        empty_columns: names of columns without values.
        original_names: column -> name in the file, if they differ.
        other_sheets: further sheets of the file with numbers.
    """

    path: Path
    reader_settings: dict[str, Any]
    column_names: tuple[str, ...]
    numeric_columns: dict[str, np.ndarray]
    text_columns: dict[str, pd.Series]
    empty_columns: tuple[str, ...]
    original_names: dict[str, str]
    other_sheets: tuple[str, ...] = ()

    def original_name(self, name: str) -> str:
        """Return the name of a column in the file."""
        return self.original_names.get(name, name)


def preview_table(
    path: Path,
    rows: int = 20_000,
    names: Sequence[str] | None = None,
    mocap_body: str | None = None,
) -> TablePreview:
    """Load the first rows of a table.

    Args:
        path: file of the table.
        rows: largest number of rows to load.
        names: names of all columns of a text table without a line of names.
        mocap_body: rigid body of an export of a motion-capture system; None reads all.

    Raises:
        DataError: if the table has no rows or cannot be read.
    """
    import pandas as pd

    require_file(path)
    table_kind = TABLE_KINDS.get(locate_file(path).suffix.lower(), "csv")
    if table_kind in _HEAD_READERS:
        table = _HEAD_READERS[table_kind](path, rows)
        reader_settings = {"kind": table_kind}
    else:
        table, reader_settings = (
            _preview_excel(path, rows)
            if table_kind == "excel"
            else read_table_head(path, rows, names, mocap_body)
        )
    columns = _append_units(table)
    other_sheets = table.attrs.get("other_sheets", ())
    table.columns = pd.Index(list(columns))
    # pandas would copy the attrs of a table to each of its columns
    table.attrs = {}
    if table.empty:
        raise DataError(f"{path}: has a header and no rows; leave the file out")
    numeric_columns: dict[str, np.ndarray] = {}
    text_columns: dict[str, pd.Series] = {}
    empty_columns = []
    for name, (_, column) in zip(columns, table.items(), strict=True):
        is_empty = column.isna().to_numpy()
        if is_empty.all():
            empty_columns.append(name)
            continue
        values = pd.to_numeric(column, errors="coerce").to_numpy(dtype=float, na_value=np.nan)
        has_text = np.isnan(values).sum() > is_empty.sum()
        values = mask_fill_values(values)
        if has_text or column.dtype == bool or pd.api.types.is_datetime64_any_dtype(column):
            text_columns[name] = column
        else:
            numeric_columns[name] = values
    renamed = {name: column for name, column in columns.items() if name != column}
    return TablePreview(
        path,
        reader_settings,
        tuple(table.columns),
        numeric_columns,
        text_columns,
        tuple(empty_columns),
        renamed,
        other_sheets,
    )


def _append_units(table: pd.DataFrame) -> dict[str, str]:
    """Return the column names with units from the row below or from cells -> original names."""
    cell_units = table.attrs.get("units", ())
    names = [str(name).strip() for name in table.columns]
    unit_rows = [
        [_parse_unit_cell(cell) for cell in row] for row in table.attrs.get("unit_rows", [])
    ]
    units = max(unit_rows, key=lambda row: sum(map(bool, row)), default=[])
    units = units if 2 * sum(map(bool, units)) >= len([name for name in names if name]) else []
    units = cell_units if any(cell_units) else units
    original_names = {}
    for name, unit_below in zip(names, [*units, *[""] * len(names)], strict=False):
        # notation of physics: a quantity divided by its unit, `u / m/s`
        match = _NAME_OVER_UNIT.fullmatch(name)
        bare_name, unit = (
            (match["name"], _parse_unit_cell(match["unit"])) if match else (name, unit_below)
        )
        original_names[
            f"{bare_name} [{unit}]" if unit and not _OPENING_BRACKET.search(name) else name
        ] = name
    return original_names


def _parse_unit_cell(cell: str) -> str:
    """Return the unit in a cell below a column name, or an empty string."""
    unit = cell.strip(" []()")
    return unit if is_unit(unit) else ""


def are_parts_of_recording(sheets: Sequence[pd.DataFrame]) -> bool:
    """Return whether sheets are parts of one recording: only the column of time is in several."""
    import pandas as pd

    names = [[str(name) for name in sheet.columns] for sheet in sheets]
    other_names = [name for columns in names for name in columns[1:] if name]
    return (
        len(sheets) > 1
        and len({columns[0] for columns in names}) == 1
        and len(set(other_names)) == len(other_names)
        and all(
            pd.to_numeric(sheet.iloc[:, 0], errors="coerce").dropna().is_monotonic_increasing
            for sheet in sheets
        )
    )


def _preview_excel(path: Path, rows: int) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Load the first sheet with two or more columns of numbers, otherwise the first sheet.

    Further sheets of the same recording are joined.
    """
    names = list_sheet_names(path)
    tables = {name: read_excel_sheet(path, name, rows) for name in names}
    if list_joined_sheets(path):
        return join_excel_sheets(path, tables), {"kind": "excel"}
    numeric_sheets = [
        n for n, table in tables.items() if len(table.select_dtypes("number").columns) > 1
    ]
    if are_parts_of_recording([tables[name] for name in numeric_sheets]):
        joined_sheets = join_excel_sheets(path, {name: tables[name] for name in numeric_sheets})
        return joined_sheets, {"kind": "excel", "sheet": tuple(numeric_sheets)}
    name = next(iter([*numeric_sheets, *names]))
    table = tables[name]
    table.attrs["other_sheets"] = tuple(numeric_sheets[1:])
    return table, {"kind": "excel", **({"sheet": name} if name != names[0] else {})}

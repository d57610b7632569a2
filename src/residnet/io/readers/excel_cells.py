"""Cells of Excel files, read once while a file does not change."""

from __future__ import annotations

from collections import OrderedDict
from pathlib import Path
from typing import TYPE_CHECKING

from residnet.io.readers.base import optional_import, wrap_read_errors

if TYPE_CHECKING:
    import pandas as pd

_MAX_CACHED_WORKBOOKS = 1_000
"""Largest number of files whose names of sheets are in the cache."""
_MAX_CACHED_CELLS = 1_000_000
"""Largest number of cells in the cache of sheets, about 40 MB."""

_FileVersion = tuple[str, int, int, int]
"""Path, inode, size in bytes and time of the last change in ns of a file."""
# a draft reads each sheet three times: the preview, the guesses and the check of the channel map
_cached_cells: OrderedDict[tuple[_FileVersion, str], pd.DataFrame] = OrderedDict()
_cached_sheet_names: OrderedDict[_FileVersion, list[str]] = OrderedDict()


def read_cells(path: Path, sheet: str, rows: int | None) -> pd.DataFrame:
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


def list_worksheets(path: Path) -> list[str]:
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

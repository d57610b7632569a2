"""Tables read piece by piece: the wanted columns of csv and Parquet files."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from residnet.core.errors import DataError, UsageError
from residnet.core.names import nearest, shown
from residnet.data.readers.encoding import as_utf8
from residnet.data.readers.files import missing_package
from residnet.data.readers.tables.header import BLANKS, found_header, header_with, numbered
from residnet.data.readers.tables.lines import check_lines

if TYPE_CHECKING:
    import pandas as pd


# pieces of this many rows stay in the cache while they are parsed
_PIECE = 20_000
_SEARCHED = 60
"""Rows of a sheet among which names are looked for."""
Pieces = Iterator["tuple[pd.DataFrame, float]"]


def _positions(
    path: Path, header: Sequence[str], columns: Sequence[str], hint: str = ""
) -> list[int]:
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
        raise UsageError(f"{path}: no column '{column}'{nearest(column, names)}{hint}")
    return [names.index(column) for column in columns]


def read_csv(
    path: Path,
    columns: Sequence[str],
    delimiter: str,
    decimal: str,
    encoding: str | None = None,
) -> Pieces:
    """Yield the wanted columns of a text table piece by piece, with the share of the file read.

    Args:
        path: the file.
        columns: names of the wanted columns, in order.
        delimiter: between cells.
        decimal: sign of the decimals.
        encoding: of the text; None finds it.

    Raises:
        UsageError: where a column is missing.
        DataError: where the file is empty, not text of this encoding or not a regular table.
    """
    with as_utf8(path, encoding) as file:
        yield from _csv_pieces(path, file, columns, delimiter, decimal)


def _csv_pieces(
    path: Path, file: Path, columns: Sequence[str], delimiter: str, decimal: str
) -> Pieces:
    """Yield the wanted columns of a table whose text stands in `file` as UTF-8."""
    import pandas as pd

    try:
        head = header_with(path, delimiter, file, columns)
        one = f" (only one column found; is the delimiter really '{delimiter}'?)"
        header = head.names
        where = _positions(path, header, columns, one if len(header) == 1 else "")
        # one column more than the header: cells beyond it would shift or vanish silently (a decimal
        # comma in a comma table does that)
        wide, size = len(header), max(1, file.stat().st_size)
        cut, comments = check_lines(path, delimiter, header, head.above, file)
        with file.open("rb") as stream_of_bytes:
            form = _form(delimiter, decimal, (head.above, *comments), wide)
            pieces = pd.read_csv(stream_of_bytes, **form)
            for table, last in _with_last(pieces):
                beyond = np.flatnonzero(table[wide].notna().to_numpy())
                if beyond.size:
                    line = int(table.index[beyond[0]]) + head.above + 1
                    raise DataError(
                        f"{path}: line {line} has more cells than the {wide} columns of"
                        f" the header ({beyond.size} such lines); check `delimiter` and `decimal`"
                    )
                wanted = table[where]
                wanted.attrs["above"] = head.above - 1
                if last and cut:
                    wanted = wanted.iloc[:-1]
                    wanted.attrs["cut"] = True
                yield wanted, min(1.0, stream_of_bytes.tell() / size)
    except UnicodeDecodeError as error:
        raise DataError(
            f"{path}: not UTF-8 text (byte {error.start}); save the file as UTF-8, or give its"
            " `encoding`"
        ) from error
    except pd.errors.EmptyDataError:
        return
    except pd.errors.ParserError as error:
        reason = shown(" ".join(str(error).split()), 200)
        raise DataError(
            f"{path}: not a regular table, its header has {len(header)} columns ({reason}); check"
            " `delimiter` and `decimal`"
        ) from error


def _form(delimiter: str, decimal: str, skipped: Sequence[int], wide: int) -> dict[str, Any]:
    """Return how pandas reads the values of a table, one column beyond the header's included.

    `skipped` are the number of lines above the values, and the numbers of lines of comments.
    """
    return {
        # a byte order mark is no part of the first name
        "encoding": "utf-8-sig",
        "sep": r"\s+" if delimiter == BLANKS else delimiter,
        "decimal": decimal,
        "header": None,
        "skiprows": [*range(skipped[0]), *skipped[1:]],
        "names": list(range(wide + 1)),
        "index_col": False,
        "skip_blank_lines": False,
        "skipinitialspace": True,
        "low_memory": False,
        "chunksize": _PIECE,
    }


def _with_last(pieces: Iterable[pd.DataFrame]) -> Iterator[tuple[pd.DataFrame, bool]]:
    """Return each piece, and whether it is the last."""
    waiting: pd.DataFrame | None = None
    for piece in pieces:
        if waiting is not None:
            yield waiting, False
        waiting = piece
    if waiting is not None:
        yield waiting, True


def column_names(path: Path) -> tuple[str, ...]:
    """Return the columns of a Parquet file, or the first line of a text; empty for others."""
    if path.suffix.lower() == ".parquet":
        import pyarrow as pa
        import pyarrow.parquet as pq

        try:
            return tuple(pq.read_schema(path).names)
        except (pa.ArrowException, OSError):
            return ()
    if path.suffix.lower() in (".xlsx", ".jsonl", ".ndjson"):
        return ()
    with path.open("rb") as stream:
        return (stream.readline(1 << 16).decode(errors="replace").strip(),)


def read_parquet(path: Path, columns: Sequence[str]) -> Pieces:
    """Yield the wanted columns of a Parquet file piece by piece, with the share of the rows read.

    Args:
        path: the file.
        columns: names of the wanted columns, in order.

    Raises:
        UsageError: where a column is missing.
        DataError: where the file cannot be read.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        _positions(path, pq.read_schema(path).names, columns)
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            rows, read = max(1, file.metadata.num_rows), 0
            for batch in file.iter_batches(batch_size=_PIECE, columns=sorted(set(columns))):
                read += batch.num_rows
                table = pa.Table.from_batches([batch]).to_pandas(ignore_metadata=True)
                yield table[list(columns)], read / rows
    except (
        pa.ArrowException,
        OSError,
        ValueError,
        TypeError,
        LookupError,
        ArithmeticError,
        MemoryError,
    ) as error:
        # damaged metadata reaches every layer of the library
        raise DataError(
            f"{path}: not a readable Parquet file"
            f" ({shown(str(error) or type(error).__name__, 200)})"
        ) from error


def read_excel(path: Path, columns: Sequence[str], sheet: str | None) -> Pieces:
    """Yield the wanted columns of a sheet in one piece.

    Args:
        path: the file.
        columns: names of the wanted columns, in order.
        sheet: its name; None takes the first.

    Raises:
        UsageError: where a column or the sheet is missing, or openpyxl is not installed.
        DataError: where the file cannot be read.
    """
    table = excel_sheet(path, sheet)
    where = _positions(path, [str(name) for name in table.columns], columns)
    wanted = table.iloc[:, where]
    wanted.attrs["above"] = table.attrs["above"] - 1
    yield wanted, 1.0


def excel_sheet(path: Path, sheet: str | None, rows: int | None = None) -> pd.DataFrame:
    """Return a sheet as its cells are, with the line above its values that holds names as names.

    Its `attrs` hold `above`, the number of lines above the values, and `between`, the cells of the
    lines between names and values.

    Args:
        path: the file.
        sheet: its name; None takes the first.
        rows: how many are read; None for all.

    Raises:
        UsageError: where there is no such sheet, or openpyxl is not installed.
        DataError: where the file cannot be read.
    """
    import pandas as pd

    names = sheet_names(path)
    if sheet is not None and sheet not in names:
        raise UsageError(f"{path}: no sheet '{sheet}'{nearest(sheet, names)}")
    try:
        cells = pd.read_excel(
            path, sheet_name=sheet or 0, nrows=rows, engine="openpyxl", header=None
        )
    # a damaged archive fails in every layer of the library
    except Exception as error:
        raise _damaged(path, error) from error
    return _below_names(cells)


def sheet_names(path: Path) -> list[str]:
    """Return the names of the sheets of an Excel file, in order.

    Raises:
        UsageError: where openpyxl is not installed.
        DataError: where the file cannot be read.
    """
    try:
        import openpyxl
    except ImportError as error:
        raise missing_package("excel", "openpyxl", "an Excel sheet") from error
    try:
        return [str(name) for name in openpyxl.load_workbook(path, read_only=True).sheetnames]
    except Exception as error:
        raise _damaged(path, error) from error


def _damaged(path: Path, error: Exception) -> DataError:
    return DataError(
        f"{path}: damaged or not an Excel file ({type(error).__name__}:"
        f" {shown(' '.join(str(error).split()), 200)})"
    )


def _below_names(cells: pd.DataFrame) -> pd.DataFrame:
    """Return the values of a sheet under the names of its columns."""
    import pandas as pd

    first = [
        ["" if pd.isna(cell) else str(cell).strip() for cell in row]
        for row in cells.head(_SEARCHED).itertuples(index=False)
    ]
    at, values = found_header(first) or (0, 1)
    table = cells.iloc[values:].infer_objects()
    table.columns = pd.Index(numbered(first[at] if first else []))
    # with the names among them, all columns were of objects
    table = table.dropna(how="all")
    table.attrs |= {"above": values, "between": first[at + 1 : values]}
    return table

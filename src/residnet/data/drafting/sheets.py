"""The first rows of a table whose form nobody described: delimiter, decimals, encoding, times."""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from residnet.core.errors import DataError
from residnet.core.names import shown
from residnet.core.units import to_si
from residnet.data.drafting.units import written_unit
from residnet.data.drafting.words import words_of
from residnet.data.readers.base import require_file
from residnet.data.readers.tables.dates import DateClock, date_order, looks_dated
from residnet.data.readers.tables.pieces import excel_sheet

if TYPE_CHECKING:
    import pandas as pd

ENDINGS = (".csv", ".tsv", ".txt", ".dat", ".xlsx", ".parquet")
"""Endings of tables."""

_ROWS = 20_000
_HEAD = 1 << 16
_JAPANESE = re.compile(r"[\u3040-\u30ff\u4e00-\u9fff]")
_LATIN = re.compile(r"[\x00-\x7fÀ-ÿ°º²³µ·±´×–’]*")
_COMMA = re.compile(r"\s*-?\d+,\d+(?:[eE][-+]?\d+)?\s*")
_DAY = r"\d\s*[-./年]\s*\w{1,9}\s*[-./月]"
_POINT = re.compile(r"\s*-?\d+\.\d+(?:[eE][-+]?\d+)?\s*")


@dataclass(frozen=True)
class Sheet:
    """The first rows of one table.

    Attributes:
        path: of the file.
        about: settings of its reader beside time and channels: kind, delimiter, decimal, encoding.
        header: names of all columns.
        numbers: values [T] of the columns that hold numbers.
        texts: columns that hold text, dates among them.
        empty: columns that hold nothing.
    """

    path: Path
    about: dict[str, Any]
    header: tuple[str, ...]
    numbers: dict[str, np.ndarray]
    texts: dict[str, pd.Series]
    empty: tuple[str, ...]


def peek(path: Path, rows: int = _ROWS) -> Sheet:
    """Return the first rows of a table, 20,000 where `rows` does not say otherwise.

    Raises:
        UsageError: where there is no file.
        DataError: where it is empty or no table.
    """
    import pandas as pd

    require_file(path)
    if path.suffix.lower() == ".parquet":
        table, about = _parquet(path, rows), {"kind": "parquet"}
    elif path.suffix.lower() == ".xlsx":
        table, about = excel_sheet(path, None, rows), {"kind": "excel"}
    else:
        table, about = _csv(path, rows)
    table.columns = pd.Index([str(name).strip() for name in table.columns])
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
    return Sheet(path, about, tuple(table.columns), numbers, texts, tuple(empty))


def _parquet(path: Path, rows: int) -> pd.DataFrame:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table: pd.DataFrame = next(pq.ParquetFile(path).iter_batches(batch_size=rows)).to_pandas()
        return table
    except (pa.ArrowException, OSError, StopIteration) as error:
        reason = str(error).splitlines()[0] if str(error) else "no rows"
        raise DataError(f"{path}: not a readable Parquet table ({reason})") from error


def _csv(path: Path, rows: int) -> tuple[pd.DataFrame, dict[str, Any]]:
    import pandas as pd

    with path.open("rb") as stream:
        head = stream.read(_HEAD)
    encoding = _encoding(head)
    lines = head.decode(encoding, errors="replace").removeprefix("\ufeff").splitlines()
    lines = lines[:-1] if len(head) == _HEAD else lines
    if not lines or not lines[0].strip() or b"\x00" in head:
        raise DataError(
            f"{path}: the file is empty or no text; a table with a header line was expected"
        )
    delimiter = _delimiter(lines)
    decimal = "," if delimiter != "," and _decimal_comma(lines, delimiter) else "."
    try:
        table = pd.read_csv(
            path,
            sep=delimiter,
            decimal=decimal,
            nrows=rows,
            encoding="utf-8-sig" if encoding == "utf-8" else encoding,
            skipinitialspace=True,
            index_col=False,
            low_memory=False,
        )
    except (ValueError, csv.Error) as error:
        reason = shown(" ".join(str(error).split()), 200)
        raise DataError(f"{path}: not a regular table ({reason})") from error
    about: dict[str, Any] = {"kind": "csv"}
    about |= {"delimiter": delimiter} if delimiter != "," else {}
    about |= {"decimal": ","} if decimal == "," else {}
    about |= {"encoding": encoding} if encoding != "utf-8" else {}
    return table, about


def _encoding(head: bytes) -> str:
    """Return the encoding of a text from its first bytes."""
    whole = head[: head.rfind(b"\n") + 1] or head
    try:
        whole.decode("utf-8")
        return "utf-8"
    except UnicodeDecodeError:
        # a Latin letter and the next one may look like one Japanese sign, but not the other way
        if _LATIN.fullmatch(whole.decode("cp1252", errors="replace")):
            return "cp1252"
    try:
        japanese = _JAPANESE.search(whole.decode("cp932"))
    except UnicodeDecodeError:
        japanese = None
    return "cp932" if japanese else "cp1252"


def _cells(line: str, delimiter: str) -> list[str]:
    """Return the cells of one line; a line that is no table's is one cell."""
    try:
        return next(csv.reader([line], delimiter=delimiter), [])
    except csv.Error:
        return [line]


def _delimiter(lines: list[str]) -> str:
    """Return the sign that stands equally often in every line, and most often."""
    sample = [line for line in lines[:50] if line.strip()]

    def regular(sign: str) -> tuple[int, int]:
        counts = [len(_cells(line, sign)) for line in sample]
        alike = sum(count == counts[0] for count in counts) if counts[0] > 1 else 0
        return alike, counts[0]

    return max((",", ";", "\t", "|"), key=regular)


def _decimal_comma(lines: list[str], delimiter: str) -> bool:
    cells = [cell for line in lines[1:50] for cell in _cells(line, delimiter)]
    return sum(bool(_COMMA.fullmatch(cell)) for cell in cells) > sum(
        bool(_POINT.fullmatch(cell)) for cell in cells
    )


@dataclass(frozen=True)
class Clock:
    """The time of a table.

    Attributes:
        settings: `time` of a table's reader.
        seconds: times [T] of the first rows.
        guess: what is not sure about it; empty where all is.
        columns: that it takes.
    """

    settings: dict[str, Any]
    seconds: np.ndarray
    guess: str
    columns: tuple[str, ...]


def clock_of(sheet: Sheet) -> Clock:
    """Return the time of a table.

    Raises:
        DataError: where no column holds any.
    """
    named = [name for name in sheet.header if words_of(name).has("time")]
    dated = {name: cells for name, cells in sheet.texts.items() if looks_dated(cells)}
    if dated:
        return _dated(sheet, dated)
    rising = [
        name
        for name, values in sheet.numbers.items()
        if values.size > 1 and bool((np.diff(values[np.isfinite(values)]) > 0.0).all())
    ]
    chosen = next((name for name in rising if name in named), next(iter(rising), None))
    if chosen is None:
        if not named:
            raise DataError(
                f"{sheet.path}: no column is called time or increases as time does; name it in a"
                " channel map (--config)"
            )
        chosen = next((name for name in named if name in sheet.numbers), named[0])
        if chosen not in sheet.numbers:
            raise DataError(f"{sheet.path}: column '{chosen}' holds no times that can be read")
    values = sheet.numbers[chosen]
    unit = written_unit(chosen, "s")
    guess = ""
    if unit is None:
        unit, guess = _time_unit(values)
    if chosen not in named:
        guess = f"no column is called time; this one increases as time does. {guess}".strip()
    return Clock({"column": chosen, "unit": unit}, values * to_si(unit), guess, (chosen,))


def _dated(sheet: Sheet, dated: dict[str, pd.Series]) -> Clock:
    """Return the time from one column of dates with times, or from two."""
    clocks = [
        name for name, cells in dated.items() if cells.astype("string").str.contains(":|時").all()
    ]
    days = [name for name in dated if name not in clocks]
    if not clocks:
        raise DataError(f"{sheet.path}: column '{days[0]}' holds dates without a time of day")
    whole = [name for name in clocks if _has(dated[name], _DAY)]
    column = (whole or clocks)[0]
    settings: dict[str, Any] = {"column": column, "unit": "date"}
    day = None if whole or not days else days[0]
    texts = dated[column]
    if day is not None:
        settings["date"] = day
        texts = dated[day].astype("string") + " " + texts.astype("string")
    order = date_order(texts)
    guess = ""
    if order is None and (whole or day):
        order = "dmy"
        guess = "day and month of the dates can be told apart nowhere in the first rows"
    settings |= {"order": order} if order in ("dmy", "mdy") else {}
    clock = DateClock(None, None)
    seconds = clock.seconds(dated[column], None if day is None else dated[day])
    return Clock(settings, seconds, guess, (column,) if day is None else (column, day))


def _has(cells: pd.Series, pattern: str) -> bool:
    """Return whether every filled cell holds a pattern."""
    return bool(cells.dropna().astype("string").str.contains(pattern, regex=True).all())


def _time_unit(values: np.ndarray) -> tuple[str, str]:
    """Return the unit of times without one, and why it is a guess."""
    known = values[np.isfinite(values)]
    step, size = float(np.median(np.diff(known))), float(np.median(np.abs(known)))
    for unit, scale in (("s", 1.0), ("ms", 1e3), ("us", 1e6), ("ns", 1e9)):
        if 6.3e8 * scale <= size <= 3.8e9 * scale:
            return unit, f"times of this size are Unix time in {unit}"
    for unit, longest in (("s", 5.0), ("ms", 5e3), ("us", 5e6)):
        if step <= longest:
            return unit, f"the header has no unit; steps of {step:g} would be {unit}"
    return "ns", f"the header has no unit; steps of {step:g} would be ns"

"""Reader of foreign tables (csv, Parquet): a channel map names each column, its unit, sign and frame.

Everything foreign is converted here, once: units to SI, signs and frames to NED and body axes forward-starboard-down, psi unwrapped.
"""

from __future__ import annotations

import csv
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal, final

import numpy as np
from pydantic import Field, field_validator

from residnet.core.config import Config
from residnet.core.errors import DataError, UsageError
from residnet.core.log import Log
from residnet.core.names import nearest, si_unit, to_si
from residnet.data.readers.base import LogReader, provenance, require_file, require_increasing, require_samples, require_values
from residnet.data.readers.channel_map import ChannelMap, factor

if TYPE_CHECKING:
    import pandas as pd


class TimeColumn(Config):
    """The column that holds time, and its unit."""

    column: str
    unit: str = "s"

    @field_validator("unit")
    @classmethod
    def _measures_time(cls, unit: str) -> str:
        factor(unit, "s")
        return unit


class _TableConfig(Config, ABC):
    """What csv and Parquet have in common; `channels` maps canonical names (or names of your own) to columns, all of which must exist.

    `manoeuvre` is the kind of manoeuvre of every file, `folder` takes the name of each file's folder, null says that nobody knows.
    """

    time: TimeColumn
    channels: dict[str, ChannelMap] = Field(min_length=1)
    manoeuvre: str | None = None

    @field_validator("channels")
    @classmethod
    def _fits_names(cls, channels: dict[str, ChannelMap]) -> dict[str, ChannelMap]:
        for name, entry in channels.items():
            entry.require_fit(name)
        return channels

    @abstractmethod
    def build(self) -> LogReader:
        """The reader."""


@final
class CsvConfig(_TableConfig):
    """Text tables with one header line."""

    kind: Literal["csv"] = "csv"
    delimiter: str = Field(default=",", min_length=1, max_length=1)
    decimal: Literal[".", ","] = "."

    def build(self) -> TableReader:
        """The reader."""
        return TableReader(self, lambda path, names: _read_csv(path, names, self.delimiter, self.decimal), lambda i: f"line {i + 2}")


@final
class ParquetConfig(_TableConfig):
    """Parquet tables that residnet did not write."""

    kind: Literal["parquet"] = "parquet"

    def build(self) -> TableReader:
        """The reader."""
        return TableReader(self, _read_parquet, lambda i: f"row {i + 1}")


@final
class TableReader(LogReader):
    """Reads a table by its channel map.

    Args:
        config: time column, channel map and manoeuvre.
        load: (path, columns) -> the columns side by side, in that order; raises UsageError where one is missing.
        row: index of a row of the table -> how the file's user would call it.
    """

    def __init__(self, config: CsvConfig | ParquetConfig, load: Callable[[Path, Sequence[str]], pd.DataFrame], row: Callable[[int], str]) -> None:
        self._config, self._load, self._row = config, load, row

    def read(self, path: Path) -> Log:
        """The log in `path`; see `LogReader.read`.

        Rows without a measurement at either end, and blank rows, are dropped and counted; other rows keep NaN where a channel was not measured.

        Raises:
            UsageError: where the file or a column is missing.
            DataError: where the file is empty, a cell is no finite number, a channel holds no number, or time is missing, repeats or runs backwards.
        """
        require_file(path)
        maps = self._config.channels
        columns = [self._config.time.column, *(entry.column for entry in maps.values())]
        table = self._load(path, columns)
        values = [self._numbers(path, table.iloc[:, i], column) for i, column in enumerate(columns)]
        kept = self._measured(path, values[0], np.stack(values[1:]))
        t = values[0][kept] * to_si(self._config.time.unit)
        require_samples(path, t)
        require_increasing(path, t, lambda i: self._row(int(kept[i])))
        channels = {}
        for (name, entry), raw in zip(maps.items(), values[1:], strict=True):
            require_values(path, name, entry.column, raw[kept])
            channels[name] = entry.convert(name, raw[kept])
        manoeuvre = path.resolve().parent.name if self._config.manoeuvre == "folder" else self._config.manoeuvre
        units = {name: si_unit(entry.unit) for name, entry in maps.items()}
        return Log(path.stem, t, channels, units, manoeuvre or "unknown", meta=provenance(path, len(table), len(table) - kept.size))

    def _numbers(self, path: Path, column: pd.Series, name: str) -> np.ndarray:
        """Cells of one column as float64 [T], NaN where empty."""
        import pandas as pd

        numeric = column if pd.api.types.is_numeric_dtype(column) else pd.to_numeric(column.astype("string"), errors="coerce")
        values = numeric.to_numpy(dtype=np.float64, na_value=np.nan)
        bad = np.flatnonzero((np.isnan(values) & column.notna().to_numpy()) | np.isinf(values))
        if bad.size:
            i = int(bad[0])
            raise DataError(
                f"{path}: {self._row(i)}, column '{name}': '{column.iloc[i]}' is not a finite number ({bad.size} such cells in the column); "
                "leave cells without a measurement empty, and check `delimiter` and `decimal`"
            )
        return values

    def _measured(self, path: Path, t: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Indices of the rows to keep; values [n, T]."""
        known, clock = np.isfinite(values).any(axis=0), np.isfinite(t)
        undated = np.flatnonzero(known & ~clock)
        if undated.size:
            name = self._config.time.column
            raise DataError(
                f"{path}: {self._row(int(undated[0]))} has measurements but no time in column '{name}' ({undated.size} such rows); "
                "delete them or restore their time"
            )
        if not known.any():
            return np.flatnonzero(known)
        first, last = np.flatnonzero(known)[[0, -1]]
        inside = np.arange(t.size)
        return np.flatnonzero(clock & (inside >= first) & (inside <= last))


def _positions(path: Path, header: Sequence[str], columns: Sequence[str], hint: str = "") -> list[int]:
    """Where the wanted columns stand in the header."""
    for column in columns:
        count = list(header).count(column)
        if count == 0:
            raise UsageError(f"{path}: no column '{column}'{nearest(column, header)}{hint}")
        if count > 1:
            raise DataError(f"{path}: column '{column}' stands {count} times in the header; rename the copies so that one is meant")
    return [list(header).index(column) for column in columns]


def _read_csv(path: Path, columns: Sequence[str], delimiter: str, decimal: str) -> pd.DataFrame:
    import pandas as pd

    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            header = [cell.strip() for cell in next(csv.reader(stream, delimiter=delimiter), [])]
        if not any(header):
            raise DataError(f"{path}: the file is empty or its first line is blank; a header line with column names was expected")
        hint = f" (only one column found; is the delimiter really '{delimiter}'?)" if len(header) == 1 else ""
        where = _positions(path, header, columns, hint)
        # one column more than the header: cells beyond it would shift or vanish silently (a decimal comma in a comma table does that)
        wide = len(header)
        table = pd.read_csv(
            path,
            sep=delimiter,
            decimal=decimal,
            header=None,
            skiprows=1,
            names=list(range(wide + 1)),
            index_col=False,
            skip_blank_lines=False,
            skipinitialspace=True,
            low_memory=False,
            encoding="utf-8-sig",
        )
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: not UTF-8 text (byte {error.start}); save the file as UTF-8") from error
    except pd.errors.ParserError as error:
        raise DataError(
            f"{path}: not a regular table, its header has {len(header)} columns ({' '.join(str(error).split())}); check `delimiter` and `decimal`"
        ) from error
    beyond = np.flatnonzero(table[wide].notna().to_numpy())
    if beyond.size:
        raise DataError(
            f"{path}: line {int(beyond[0]) + 2} has more cells than the {wide} columns of the header ({beyond.size} such lines); "
            "check `delimiter` and `decimal`"
        )
    return table[where]


def _read_parquet(path: Path, columns: Sequence[str]) -> pd.DataFrame:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        where = _positions(path, pq.read_schema(path).names, columns)
        table = pq.read_table(path, columns=sorted(set(columns))).to_pandas(ignore_metadata=True)
    except pa.ArrowException as error:
        raise DataError(f"{path}: not a readable Parquet file ({str(error).splitlines()[0]})") from error
    return table[[columns[i] for i in range(len(where))]]

"""The reader of foreign tables (csv, Parquet), each column by its entry in a channel map.

Everything foreign is converted here, once: units to SI, signs and frames to NED and body axes
forward-starboard-down, psi unwrapped.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal, final

import numpy as np
from pydantic import Field, field_validator

from residnet.core.config import Config
from residnet.core.errors import DataError
from residnet.core.log import Log
from residnet.core.names import shown, si_unit
from residnet.data.readers.base import (
    LogReader,
    provenance,
    require_file,
)
from residnet.data.readers.files import progress
from residnet.data.readers.recording import remark
from residnet.data.readers.spool import LARGE
from residnet.data.readers.tables.channel_map import ChannelMap, factor
from residnet.data.readers.tables.pieces import Pieces, read_csv, read_parquet
from residnet.data.readers.tables.rows import Rows

if TYPE_CHECKING:
    import pandas as pd


class TimeColumn(Config):
    """The column that holds time, and its unit.

    Attributes:
        column: name of the column.
        unit: unit of its numbers, for example `ms`.
    """

    column: str
    unit: str = "s"

    @field_validator("unit")
    @classmethod
    def _measures_time(cls, unit: str) -> str:
        factor(unit, "s")
        return unit


class _TableConfig(Config, ABC):
    """The part that csv and Parquet have in common.

    Attributes:
        time: column of the time.
        channels: canonical names (or names of your own) and the columns that they are taken from,
            all of which must exist.
        manoeuvre: kind of manoeuvre of every file; `folder` takes the name of each file's folder,
            null says that it is not known.
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
        """Build the reader of such tables."""


@final
class CsvConfig(_TableConfig):
    """Text tables with one header line.

    Attributes:
        delimiter: between cells.
        decimal: sign of the decimals, `.` or `,`.
    """

    kind: Literal["csv"] = "csv"
    delimiter: str = Field(default=",", min_length=1, max_length=1)
    decimal: Literal[".", ","] = "."

    def build(self) -> TableReader:
        """Build the reader of csv files."""
        return TableReader(
            self,
            lambda path, names: read_csv(path, names, self.delimiter, self.decimal),
            lambda i: f"line {i + 2}",
        )


@final
class ParquetConfig(_TableConfig):
    """Parquet tables that residnet did not write."""

    kind: Literal["parquet"] = "parquet"

    def build(self) -> TableReader:
        """Build the reader of Parquet files."""
        return TableReader(self, read_parquet, lambda i: f"row {i + 1}")


@final
class TableReader(LogReader):
    """Reads a table by its channel map, piece by piece.

    Args:
        config: time column, channel map and manoeuvre.
        load: (path, columns) -> pieces of the columns side by side, in that order, each with the
            share of the file that is read by then; raises UsageError where a column is missing.
        row: index of a row of the table -> how the file's user would call it.
    """

    def __init__(
        self,
        config: CsvConfig | ParquetConfig,
        load: Callable[[Path, Sequence[str]], Pieces],
        row: Callable[[int], str],
    ) -> None:
        self._config, self._load, self._row = config, load, row

    def read(self, path: Path) -> Log:
        """Return the log in `path`.

        See `LogReader.read`. A large file's channels lie in temporary files, not in memory.

        Rows without a measurement at either end, and blank rows, are dropped and counted; other
        rows keep NaN where a channel was not measured.

        Raises:
            UsageError: where the file or a column is missing.
            DataError: where the file is empty, a cell is no finite number, a channel holds no
                number, or time is missing, repeats or runs backwards.
        """
        require_file(path)
        maps = self._config.channels
        columns = [self._config.time.column, *(entry.column for entry in maps.values())]
        size = path.stat().st_size
        rows = Rows(
            path,
            (self._config.time.column, self._config.time.unit),
            maps,
            self._row,
            on_disk=size > LARGE,
        )
        read, cut = 0, False
        with progress(path.name, size, 1.0) as advance:
            for piece, share in self._load(path, columns):
                cut |= bool(piece.attrs.get("cut"))
                rows.add(
                    [
                        self._numbers(path, piece.iloc[:, i], column, read)
                        for i, column in enumerate(columns)
                    ],
                    read,
                )
                read += len(piece)
                advance(share)
        t, channels = rows.finish()
        manoeuvre = (
            path.resolve().parent.name
            if self._config.manoeuvre == "folder"
            else self._config.manoeuvre
        )
        units = {name: si_unit(entry.unit) for name, entry in maps.items()}
        meta = provenance(path, read + cut, read + cut - t.size)
        if cut:
            meta["findings"] = [
                remark("note", "cut_line", "the file ends within its last line, which is left out")
            ]
        return Log(path.stem, t, channels, units, manoeuvre or "unknown", meta=meta)

    def _numbers(self, path: Path, column: pd.Series, name: str, first: int) -> np.ndarray:
        """Return the cells of one column as float64 [T], NaN where empty.

        `first` is the index of the first row.
        """
        import pandas as pd

        numeric = (
            column
            if pd.api.types.is_numeric_dtype(column)
            else pd.to_numeric(column.astype("string"), errors="coerce")
        )
        values = numeric.to_numpy(dtype=np.float64, na_value=np.nan)
        if np.isfinite(values).all():
            return values
        bad = np.flatnonzero((np.isnan(values) & column.notna().to_numpy()) | np.isinf(values))
        if bad.size:
            i = int(bad[0])
            raise DataError(
                f"{path}: {self._row(first + i)}, column '{name}': '{shown(column.iloc[i])}' is not"
                f" a finite number ({bad.size} such cells in {len(column)} rows); leave cells"
                " without a measurement empty, and check `delimiter` and `decimal`"
            )
        return values

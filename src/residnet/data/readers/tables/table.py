"""The reader of foreign tables (csv, Parquet), each column by its entry in a channel map.

Everything foreign is converted here, once: units to SI, signs and frames to NED and body axes
forward-starboard-down, psi unwrapped.
"""

from __future__ import annotations

import codecs
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal, final

import numpy as np
from pydantic import Field, field_validator, model_validator

from residnet.core.config import Config
from residnet.core.errors import DataError
from residnet.core.log import Log
from residnet.core.names import shown
from residnet.core.units import known_unit
from residnet.data.readers.base import (
    LogReader,
    provenance,
    require_file,
)
from residnet.data.readers.files import progress
from residnet.data.readers.recording import remark
from residnet.data.readers.spool import LARGE
from residnet.data.readers.tables.angles import degrees_of, side_signs
from residnet.data.readers.tables.attitudes import with_heading
from residnet.data.readers.tables.channel_map import QUATERNION, ChannelMap, factor
from residnet.data.readers.tables.dates import DateClock, Order, zone_of
from residnet.data.readers.tables.fixes import LATITUDE, LONGITUDE, with_positions
from residnet.data.readers.tables.json_lines import read_json_lines
from residnet.data.readers.tables.pieces import Pieces, read_csv, read_excel, read_parquet
from residnet.data.readers.tables.rows import Rows

if TYPE_CHECKING:
    import pandas as pd

DATE = "date"
"""Stands for a unit where a column holds dates."""


class TimeColumn(Config):
    """The column that holds time, and its unit.

    Attributes:
        column: name of the column.
        unit: unit of its numbers, for example `ms`; `date` for dates and times of day, as
            `2024-05-03T12:00:00.5+02:00`, `03.05.2024 12:00:00,5` or `12:00:00.5`.
        date: column with the dates, where `column` holds times of day; null for none.
        zone: time zone of dates that name none, for example `Europe/Berlin`; null leaves them
            without one.
        order: of day, month and year in dates: `dmy`, `mdy` or `ymd`; null takes it from the cells.
    """

    column: str
    unit: str = "s"
    date: str | None = None
    zone: str | None = None
    order: Order | None = None

    @field_validator("unit")
    @classmethod
    def _measures_time(cls, unit: str) -> str:
        if unit == DATE:
            return unit
        factor(unit, "s")
        return known_unit(unit, "s")

    @field_validator("zone")
    @classmethod
    def _known_zone(cls, zone: str | None) -> str | None:
        return zone if zone is None else zone_of(zone).key

    @model_validator(mode="after")
    def _dates(self) -> TimeColumn:
        given = [name for name in ("date", "zone", "order") if getattr(self, name) is not None]
        if given and self.unit != DATE:
            raise ValueError(f"{given[0]} is for dates; set unit: {DATE}")
        return self

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns that hold time."""
        return (self.column,) if self.date is None else (self.column, self.date)


class _TableConfig(Config, ABC):
    """The part that csv and Parquet have in common.

    Attributes:
        time: column of the time.
        channels: canonical names (or names of your own) and the columns that they are taken from,
            all of which must exist; `latitude` and `longitude` become x, y where these are not
            there, and `qx`, `qy`, `qz`, `qw` become the heading psi where there is none.
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
        parts = [name for name in QUATERNION if name in channels]
        if parts and len(parts) < len(QUATERNION):
            lost = ", ".join(name for name in QUATERNION if name not in channels)
            raise ValueError(f"an attitude needs all of {', '.join(QUATERNION)}; add {lost}")
        return channels

    @abstractmethod
    def build(self) -> LogReader:
        """Build the reader of such tables."""


@final
class CsvConfig(_TableConfig):
    """Text tables with a line of column names; lines above it, and units beneath it, are skipped.

    The names' line is the first one that holds the time's and all channels' columns.

    Attributes:
        delimiter: between cells; a blank stands for any number of blanks and tabulators.
        decimal: sign of the decimals, `.` or `,`.
        encoding: of the text, for example `cp1252` for a file that an older Windows wrote; null
            finds it by the bytes themselves, UTF-16 and Japanese (cp932) included.
    """

    kind: Literal["csv"] = "csv"
    delimiter: str = Field(default=",", min_length=1, max_length=1)
    decimal: Literal[".", ","] = "."
    encoding: str | None = None

    @field_validator("encoding")
    @classmethod
    def _known_encoding(cls, encoding: str | None) -> str | None:
        if encoding is None:
            return None
        try:
            return codecs.lookup(encoding).name
        except LookupError as error:
            raise ValueError(
                f"no encoding is called '{encoding}'; usual are utf-8, utf-16, cp1252 and cp932"
            ) from error

    def build(self) -> TableReader:
        """Build the reader of csv files."""
        return TableReader(
            self,
            lambda path, names: read_csv(path, names, self.delimiter, self.decimal, self.encoding),
            lambda i: f"line {i + 2}",
        )


@final
class ExcelConfig(_TableConfig):
    """Sheets of Excel files (.xlsx); lines above the column names, and units beneath, are skipped.

    Attributes:
        sheet: name of the sheet; null takes the first.
    """

    kind: Literal["excel"] = "excel"
    sheet: str | None = None

    def build(self) -> TableReader:
        """Build the reader of Excel sheets."""
        return TableReader(
            self,
            lambda path, names: read_excel(path, names, self.sheet),
            lambda i: f"row {i + 2}",
        )


@final
class ParquetConfig(_TableConfig):
    """Parquet tables that residnet did not write."""

    kind: Literal["parquet"] = "parquet"

    def build(self) -> TableReader:
        """Build the reader of Parquet files."""
        return TableReader(self, read_parquet, lambda i: f"row {i + 1}")


@final
class JsonLinesConfig(_TableConfig):
    """Files with a JSON object a line (.jsonl, .ndjson); a column is a key, `nav.lat` one within.

    Entries of lists are counted from zero: `imu.q[0]`.
    """

    kind: Literal["json_lines"] = "json_lines"

    def build(self) -> TableReader:
        """Build the reader of JSON lines."""
        return TableReader(self, read_json_lines, lambda i: f"object {i + 1}")


def _is_text_position(name: str, cells: pd.Series) -> bool:
    """Return whether a column holds positions that are no numbers."""
    import pandas as pd

    return name in (LATITUDE, LONGITUDE) and not pd.api.types.is_numeric_dtype(cells)


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
        config: _TableConfig,
        load: Callable[[Path, Sequence[str]], Pieces],
        row: Callable[[int], str],
    ) -> None:
        self._config, self._load, self._row = config, load, row

    def read(self, path: Path) -> Log:
        """Return the log in `path`.

        See `LogReader.read`. A large file's channels lie in temporary files, not in memory.

        Fill values far from all else (-999, 9.97e36) count as missing, and are counted. Rows
        without a measurement at either end, and blank rows, are dropped and counted; other
        rows keep NaN where a channel was not measured.

        Raises:
            UsageError: where the file or a column is missing.
            DataError: where the file is empty, a cell is no finite number or none that a vessel can
                have, a channel holds no number, or time is missing, repeats or runs backwards.
        """
        require_file(path)
        maps = self._config.channels
        time, dates = self._config.time, None
        if time.unit == DATE:
            dates = DateClock(time.zone, time.order)
        columns = [*time.columns, *(entry.column for entry in maps.values())]
        sides = [entry.hemisphere for entry in maps.values() if entry.hemisphere]
        place = {column: i for i, column in enumerate([*columns, *sides])}
        size = path.stat().st_size
        rows = Rows(
            path,
            (time.column, "s" if dates else time.unit),
            maps,
            self._row,
            on_disk=size > LARGE,
        )
        read, cut = 0, False
        with progress(path.name, size, 1.0) as advance:
            for piece, share in self._load(path, [*columns, *sides]):
                cut |= bool(piece.attrs.get("cut"))
                # rows are called by their lines in the file
                row, first = read + int(piece.attrs.get("above", 0)), len(time.columns)
                clock = (
                    self._dated(path, piece.iloc[:, :first], dates)
                    if dates
                    else self._numbers(path, piece.iloc[:, 0], time.column, row)
                )
                measured = [
                    self._angles(path, piece, name, place)
                    if entry.is_angle or _is_text_position(name, piece.iloc[:, i])
                    else self._numbers(path, piece.iloc[:, i], entry.column, row)
                    for i, (name, entry) in enumerate(maps.items(), start=first)
                ]
                rows.add([clock, *measured], row)
                read += len(piece)
                advance(share)
        t, channels = rows.finish()
        manoeuvre = (
            path.resolve().parent.name
            if self._config.manoeuvre == "folder"
            else self._config.manoeuvre
        )
        units = {name: entry.si(name) for name, entry in maps.items()}
        channels, units, placed = with_positions(path, channels, units)
        channels, units = with_heading(path, channels, units, maps)
        meta = provenance(path, read + cut, read + cut - t.size)
        findings = [*(dates.remarks if dates else []), *rows.remarks(), *placed]
        if cut:
            findings.append(
                remark("note", "cut_line", "the file ends within its last line, which is left out")
            )
        if findings:
            meta["findings"] = findings
        if dates and dates.epoch_ns is not None:
            meta |= {"epoch": dates.epoch_ns * 1e-9, "epoch_ns": dates.epoch_ns}
        return Log(path.stem, t, channels, units, manoeuvre or "unknown", meta=meta)

    @staticmethod
    def _dated(path: Path, cells: pd.DataFrame, dates: DateClock) -> np.ndarray:
        """Return the times of one piece in s, from its column of times and that of its dates."""
        try:
            return dates.seconds(cells.iloc[:, 0], cells.iloc[:, 1] if cells.shape[1] > 1 else None)
        except DataError as error:
            raise DataError(f"{path}: column '{cells.columns[0]}': {error}") from None

    def _angles(
        self, path: Path, piece: pd.DataFrame, name: str, place: Mapping[str, int]
    ) -> np.ndarray:
        """Return the angles [T] in degrees of one column, with the side that another tells."""
        entry = self._config.channels[name]
        column = entry.column
        if known_unit(entry.unit) != "deg":
            raise DataError(f"{path}: column '{column}' is written in degrees; set unit: deg")
        try:
            angles = degrees_of(piece.iloc[:, place[column]], name, entry.form, entry.letter_o)
            if entry.hemisphere is not None:
                column = entry.hemisphere
                angles = angles * side_signs(piece.iloc[:, place[column]], name, entry.letter_o)
        except DataError as error:
            raise DataError(f"{path}: column '{column}': {error}") from None
        return angles

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

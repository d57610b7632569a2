"""The reader of foreign tables (csv, Parquet), each column by its entry in a channel map.

Everything foreign is converted here, once: units to SI, signs and frames to NED and body axes
forward-starboard-down, psi unwrapped.
"""

from __future__ import annotations

import csv
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal, final

import numpy as np
from pydantic import Field, field_validator

from residnet.core.config import Config
from residnet.core.errors import DataError, UsageError
from residnet.core.log import Log
from residnet.core.names import nearest, shown, si_unit, to_si
from residnet.data.readers.base import (
    LogReader,
    provenance,
    require_file,
    require_increasing,
    require_samples,
    require_values,
)
from residnet.data.readers.files import progress
from residnet.data.readers.recording import remark
from residnet.data.readers.spool import LARGE, Spool
from residnet.data.readers.tables.channel_map import ChannelMap, factor
from residnet.data.readers.tables.lines import check_lines

if TYPE_CHECKING:
    import pandas as pd

Pieces = Iterator["tuple[pd.DataFrame, float]"]
# pieces of this many rows stay in the cache while they are parsed
_PIECE = 20_000


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

    `manoeuvre` is the kind of manoeuvre of every file, `folder` takes the name of each file's
    folder, null says that nobody knows.

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
            lambda path, names: _read_csv(path, names, self.delimiter, self.decimal),
            lambda i: f"line {i + 2}",
        )


@final
class ParquetConfig(_TableConfig):
    """Parquet tables that residnet did not write."""

    kind: Literal["parquet"] = "parquet"

    def build(self) -> TableReader:
        """Build the reader of Parquet files."""
        return TableReader(self, _read_parquet, lambda i: f"row {i + 1}")


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
        rows = _Rows(path, self._config, self._row, on_disk=size > LARGE)
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


@final
class _Rows:
    """The rows of a table as they come: measured ones are kept, in SI.

    What must hold over the whole table is checked on the way.
    """

    def __init__(
        self,
        path: Path,
        config: CsvConfig | ParquetConfig,
        row: Callable[[int], str],
        *,
        on_disk: bool,
    ) -> None:
        self._path, self._config, self._row = path, config, row
        self._spool = Spool(1 + len(config.channels), on_disk=on_disk)
        self._kept, self._until = 0, 0
        self._any = dict.fromkeys(config.channels, False)
        self._heading = np.nan
        self._places: list[tuple[int, range | np.ndarray]] = []

    def add(self, values: list[np.ndarray], first: int) -> None:
        """Return one more piece: time and channels as they stand in the table.

        `first` is the index of the first row.

        Raises:
            DataError: where a row has measurements but no time.
        """
        finite = [np.isfinite(one) for one in values[1:]]
        known, clock = np.logical_or.reduce(finite), np.isfinite(values[0])
        undated = np.flatnonzero(known & ~clock)
        if undated.size:
            raise DataError(
                f"{self._path}: {self._row(first + int(undated[0]))} has measurements but no time"
                f" in column '{self._config.time.column}' ({undated.size} such rows); delete them"
                " or restore their time"
            )
        keep = clock
        if not self._until:
            keep = keep & np.logical_or.accumulate(known)
        if not keep.any():
            return
        whole = bool(keep.all())
        index = slice(None) if whole else np.flatnonzero(keep)
        self._places.append(
            (self._kept, range(first, first + len(keep)) if whole else np.flatnonzero(keep) + first)
        )
        channels = []
        for (name, entry), raw, there in zip(
            self._config.channels.items(), values[1:], finite, strict=True
        ):
            self._any[name] |= bool(there.any())
            channels.append(self._continued(name, entry.convert(name, raw[index])))
        self._spool.add([values[0][index] * to_si(self._config.time.unit), *channels])
        measured = np.flatnonzero(known[index])
        if measured.size:
            self._until = self._kept + int(measured[-1]) + 1
        self._kept += int(keep.sum())

    def finish(self) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Return the time and channels up to the last measurement.

        Raises:
            DataError: where there are too few rows, time does not increase, or a channel holds no
                number.
        """
        t, *values = (column[: self._until] for column in self._spool.finish())
        require_samples(self._path, t)
        require_increasing(self._path, t, lambda i: self._row(self._table_row(i)))
        for (name, entry), there in zip(
            self._config.channels.items(), self._any.values(), strict=True
        ):
            if not there:
                require_values(self._path, name, entry.column, np.full(t.size, np.nan))
        return t, dict(zip(self._config.channels, values, strict=True))

    def _continued(self, name: str, values: np.ndarray) -> np.ndarray:
        """Return a piece of a channel; a heading goes on from the piece before."""
        if name != "psi":
            return values
        known = np.flatnonzero(np.isfinite(values))
        if not known.size:
            return values
        if np.isfinite(self._heading):
            turns = np.rint((values[known[0]] - self._heading) / (2.0 * np.pi))
            values = values - 2.0 * np.pi * turns if turns else values
        self._heading = float(values[known[-1]])
        return values

    def _table_row(self, i: int) -> int:
        """Return the index in the table of a kept row."""
        start, places = next(
            (start, places) for start, places in reversed(self._places) if start <= i
        )
        return int(places[i - start])


def _positions(
    path: Path, header: Sequence[str], columns: Sequence[str], hint: str = ""
) -> list[int]:
    """Return where the wanted columns stand in the header."""
    for column in columns:
        count = list(header).count(column)
        if count == 0:
            raise UsageError(f"{path}: no column '{column}'{nearest(column, header)}{hint}")
        if count > 1:
            raise DataError(
                f"{path}: column '{column}' stands {count} times in the header; rename the copies"
                " so that one is meant"
            )
    return [list(header).index(column) for column in columns]


def _read_csv(path: Path, columns: Sequence[str], delimiter: str, decimal: str) -> Pieces:
    import pandas as pd

    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            header = [cell.strip() for cell in next(csv.reader(stream, delimiter=delimiter), [])]
        if not any(header):
            raise DataError(
                f"{path}: the file is empty or its first line is blank; a header line with column"
                " names was expected"
            )
        hint = (
            f" (only one column found; is the delimiter really '{delimiter}'?)"
            if len(header) == 1
            else ""
        )
        where = _positions(path, header, columns, hint)
        # one column more than the header: cells beyond it would shift or vanish silently (a decimal
        # comma in a comma table does that)
        wide, size = len(header), max(1, path.stat().st_size)
        cut = check_lines(path, delimiter, wide)
        with path.open("rb") as stream_of_bytes:
            pieces = pd.read_csv(
                stream_of_bytes,
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
                chunksize=_PIECE,
            )
            for table, last in _with_last(pieces):
                beyond = np.flatnonzero(table[wide].notna().to_numpy())
                if beyond.size:
                    raise DataError(
                        f"{path}: line {int(table.index[beyond[0]]) + 2} has more cells than the"
                        f" {wide} columns of the header ({beyond.size} such lines); check"
                        " `delimiter` and `decimal`"
                    )
                kept = table[where]
                if last and cut:
                    kept = kept.iloc[:-1]
                    kept.attrs["cut"] = True
                yield kept, min(1.0, stream_of_bytes.tell() / size)
    except UnicodeDecodeError as error:
        raise DataError(
            f"{path}: not UTF-8 text (byte {error.start}); save the file as UTF-8"
        ) from error
    except pd.errors.EmptyDataError:
        return
    except pd.errors.ParserError as error:
        said = shown(" ".join(str(error).split()), 200)
        raise DataError(
            f"{path}: not a regular table, its header has {len(header)} columns ({said}); check"
            " `delimiter` and `decimal`"
        ) from error


def _with_last(pieces: Iterable[pd.DataFrame]) -> Iterator[tuple[pd.DataFrame, bool]]:
    """Return each piece, and whether it is the last."""
    held: pd.DataFrame | None = None
    for piece in pieces:
        if held is not None:
            yield held, False
        held = piece
    if held is not None:
        yield held, True


def _read_parquet(path: Path, columns: Sequence[str]) -> Pieces:
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

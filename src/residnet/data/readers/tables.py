"""Readers of tables (csv, Parquet, Excel, JSON lines), each column by its entry in a channel map.

Everything foreign is converted here, once: units to SI, signs and frames to NED and body axes
forward-starboard-down, psi unwrapped.
"""

from __future__ import annotations

import codecs
import json
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, final

import numpy as np
from pydantic import Field, field_validator, model_validator

from residnet.core.config import Config
from residnet.core.errors import DataError, UsageError
from residnet.core.log import Log
from residnet.core.names import nearest, shown
from residnet.core.units import known_unit, to_si
from residnet.data.channels import beyond_belief, fills, largest
from residnet.data.motion import with_true_wind
from residnet.data.readers.base import (
    Advance,
    ConfiguredReader,
    package,
    progress,
    provenance,
    readable,
    require_file,
    require_increasing,
    require_samples,
    require_values,
    unwrap,
)
from residnet.data.readers.quantities import (
    COSINE,
    QUATERNION,
    SINE,
    ChannelMap,
    factor,
    fixes_on_plane,
    unit_quaternion,
    yaw_of,
)
from residnet.data.readers.recording import Remark, remark
from residnet.data.readers.texts import as_utf8, found_header, numbered, plain, positions, read_csv
from residnet.data.readers.written import (
    Order,
    degrees_of,
    first_of_copies,
    parse_texts,
    side_signs,
    steady_clock,
    zone_of,
)

if TYPE_CHECKING:
    import pandas as pd

DATE = "date"
"""Stands for a unit where a column holds dates."""
TABLES = {
    **dict.fromkeys((".csv", ".tsv", ".txt", ".dat"), "csv"),
    ".xlsx": "excel",
    ".parquet": "parquet",
    **dict.fromkeys((".jsonl", ".ndjson", ".json"), "json_lines"),
}
"""Ending of a table -> its kind of reader; a table does not say what its columns are."""
FIX = ("latitude", "longitude")
_SEARCHED = 60
"""Rows of a sheet among which names are looked for."""
_LONGEST = 16
"""Most entries of a list in JSON that become columns."""
_TABLE = 20
"""Rows of a JSON document that are no note beside its log but a table; by choice."""


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


class TableConfig(ConfiguredReader, ABC):
    """The part that all tables have in common.

    Attributes:
        time: column of the time.
        channels: canonical names (or names of your own) and the columns that they are taken from,
            all of which must exist; `latitude` and `longitude` become x, y where these are not
            there, `qx`, `qy`, `qz`, `qw` become the heading psi where there is none, and of any
            angle its cosine and sine do, as `psi_cos` and `psi_sin`.
        manoeuvre: kind of manoeuvre of every file; `folder` takes the name of each file's folder,
            null says that it is not known.
    """

    time: TimeColumn
    channels: dict[str, ChannelMap] = Field(min_length=1)
    manoeuvre: str | None = None
    row: ClassVar[str] = "row {0}"
    """How a user calls a row of the table, by its number from 1, and from 2 behind a header."""

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
    def load(self, path: Path, columns: Sequence[str], advance: Advance) -> pd.DataFrame:
        """Return the columns side by side, in order; `advance` is told the share that is read.

        Its `attrs` may hold `above`, lines above the values beside one header, and `cut`, whether
        the file ends within a last row that is left out.

        Raises:
            UsageError: where a column is missing.
            DataError: where the file cannot be read.
        """

    def read(self, path: Path) -> Log:
        """Return the log in `path`.

        See `LogReader.read`. Fill values far from all else (-999, 9.97e36) count as missing, and
        are counted. Rows without a measurement at either end, and blank rows, are dropped and
        counted; other rows keep NaN where a channel was not measured.
        """
        import pandas as pd

        require_file(path)
        time, maps = self.time, self.channels
        columns = [*time.columns, *(entry.column for entry in maps.values())]
        sides = [entry.hemisphere for entry in maps.values() if entry.hemisphere]
        with progress(path.name, path.stat().st_size, 1.0) as advance:
            table = self.load(path, [*columns, *sides], advance)
        # pandas copies all that is told of a table for each of its columns
        about, table.attrs = table.attrs, {}
        above, cut = about.get("above", 0), bool(about.get("cut"))
        rows = len(table) + cut
        cells = dict(zip([*columns, *sides], (cells for _, cells in table.items()), strict=True))
        self._require_units(path, about.get("units", ()))
        t, start, findings = self._times(path, cells, above)
        raw = {name: self._values(path, name, cells, above) for name in maps}
        # each column is let go where its channel is made
        del table, cells
        measured = np.zeros(t.size, dtype=bool)
        for values in raw.values():
            measured |= np.isfinite(values)
        undated = np.flatnonzero(measured & ~np.isfinite(t))
        if undated.size:
            raise DataError(
                f"{path}: {self._row(undated[0] + above)} has measurements but no time in column"
                f" '{time.column}' ({undated.size} such rows); delete them or restore their"
                " time"
            )
        for name, values in raw.items():
            raw[name], said = self._plausible(path, name, values, above)
            findings += said
        ends = np.flatnonzero(measured)[[0, -1]] if measured.any() else np.array([0, -1])
        kept = ends[0] + np.flatnonzero(np.isfinite(t[ends[0] : ends[1] + 1]))
        require_samples(path, kept)
        if (np.diff(t[kept]) < 0.0).all():
            kept = kept[::-1]
            text = "the rows stand with the newest first, and are read from the last one on"
            findings.append(remark("note", "newest_first", text))
        recorded = [*raw.values()]
        fresh = first_of_copies(t[kept], (_at(values, kept) for values in recorded))
        if not fresh.all():
            text = f"{int((~fresh).sum())} rows repeat the one before them and are left out"
            findings.append(remark("note", "copied_rows", text, rows=float((~fresh).sum())))
            kept = kept[fresh]
        held = [name for name in raw if maps[name].hold]
        for name in held:
            raw[name] = pd.Series(raw[name]).ffill().to_numpy()
        if held and len(held) < len(raw):
            # a row of commands alone belongs to the next sample of the motion
            moving = [values[kept] for name, values in raw.items() if name not in held]
            kept = kept[np.isfinite(np.stack(moving)).any(axis=0)]
        tick = None if time.unit == DATE else to_si(time.unit)
        clock, said = steady_clock(t[kept], (_at(values, kept) for values in recorded), tick)
        findings += said
        del recorded, values
        require_increasing(path, clock, lambda i: self._row(int(kept[i]) + above))
        channels: dict[str, np.ndarray] = {}
        for name in maps:
            own = _at(raw.pop(name), kept)
            channels[name] = maps[name].convert(name, own)
            require_values(path, name, maps[name].column, channels[name])
            made_up = int((np.isfinite(own) & ~np.isfinite(channels[name])).sum())
            if name == "psi" and made_up:
                text = (
                    f"{made_up} headings were interpolated by the recorder from 359 to 1 deg by way"
                    " of 180; they are left empty"
                )
                findings.append(remark("note", "heading_interpolated", text))
        channels, said = _placed(path, channels, maps)
        findings += said
        if channels.keys() >= {*QUATERNION} and "psi" not in channels:
            # where qw has the frame `enu`, the heading counts anticlockwise from east
            yaw = yaw_of(*unit_quaternion(*(channels.pop(name) for name in QUATERNION)))
            if not np.isfinite(yaw).any():
                columns = [maps[name].column for name in QUATERNION]
                raise DataError(f"{path}: {', '.join(columns)} hold no attitude, all are empty")
            channels["psi"] = unwrap(np.pi / 2.0 - yaw if maps["qw"].frame == "enu" else yaw)
        for name in [one.removesuffix(COSINE) for one in channels if one.endswith(COSINE)]:
            if name + SINE in channels and name not in channels:
                sine, cosine = channels.pop(name + SINE), channels.pop(name + COSINE)
                channels[name] = unwrap(np.arctan2(sine, cosine))
        made = {"x": "m", "y": "m"}
        units = {n: maps[n].si(n) if n in maps else made.get(n, "rad") for n in channels}
        if cut:
            text = "the file ends within its last line, which is left out"
            findings.append(remark("note", "cut_line", text))
        meta = provenance(path, rows, rows - kept.size)
        meta |= {"findings": findings} if findings else {}
        if start is not None:
            first = start + int(np.rint(clock[0] * 1e9))
            meta |= {"epoch": first * 1e-9, "epoch_ns": first}
        kind = self.manoeuvre
        kind = path.resolve().parent.name if kind == "folder" else kind
        log = Log(path.stem, clock, channels, units, kind or "unknown", meta=meta)
        return with_true_wind(log)

    def _require_units(self, path: Path, written: Sequence[str]) -> None:
        """Stop where cells name another unit than the channel map; `written` are those of cells."""
        time, maps = self.time, self.channels.values()
        clock = [(name, time.unit) for name in time.columns]
        # with a scale, the map says what its numbers mean
        mapped = [(one.column, "" if one.scale != 1.0 else one.unit) for one in maps]
        for (column, unit), told in zip([*clock, *mapped], written, strict=False):
            if told and unit and told != known_unit(unit):
                raise DataError(
                    f"{path}: the cells of column '{column}' are in {told}, not in {unit}; set"
                    f" unit: {told}"
                )

    def _row(self, i: int) -> str:
        return self.row.format(i + 1, i + 2)

    def _times(
        self, path: Path, cells: Mapping[str, pd.Series], above: int
    ) -> tuple[np.ndarray, int | None, list[Remark]]:
        """Return the times [T] in s, from Unix time in ns where there are dates, and remarks."""
        time = self.time
        texts = cells[time.column]
        if time.unit != DATE:
            return self._numbers(path, texts, time.column, above) * to_si(time.unit), None, []
        if time.date is not None:
            days = cells[time.date].astype("string").str.strip()
            texts = days + " " + texts.astype("string").str.strip()
        try:
            stamps = parse_texts(texts, zone=time.zone, order=time.order, dates=True)
        except DataError as error:
            raise DataError(f"{path}: column '{time.column}': {error}") from None
        known = np.ones(len(texts), dtype=bool) if stamps.known is None else stamps.known
        start = int(stamps.ns[known][0]) if known.any() else 0
        t = np.where(known, (stamps.ns - start) * 1e-9, np.nan)
        return t, start if stamps.absolute else None, list(stamps.remarks)

    def _values(
        self, path: Path, name: str, cells: Mapping[str, pd.Series], above: int
    ) -> np.ndarray:
        """Return one channel [T] as it stands in the table, NaN where empty."""
        import pandas as pd

        entry = self.channels[name]
        column = entry.column
        written = name in FIX and not pd.api.types.is_numeric_dtype(cells[column])
        if not entry.is_angle and not written:
            return self._numbers(path, cells[column], column, above)
        if known_unit(entry.unit) != "deg":
            raise DataError(f"{path}: column '{column}' is written in degrees; set unit: deg")
        try:
            angles = degrees_of(cells[column], name, entry.form, entry.letter_o)
            if entry.hemisphere is not None:
                column = entry.hemisphere
                angles = angles * side_signs(cells[column], name, entry.letter_o)
        except DataError as error:
            raise DataError(f"{path}: column '{column}': {error}") from None
        return angles

    def _numbers(self, path: Path, column: pd.Series, name: str, above: int) -> np.ndarray:
        """Return the cells of one column as float64 [T], NaN where empty."""
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
                f"{path}: {self._row(i + above)}, column '{name}': '{shown(column.iloc[i])}' is not"
                f" a finite number ({bad.size} such cells in {len(column)} rows); leave cells"
                " without a measurement empty, and check `delimiter` and `decimal`"
            )
        return values

    def _plausible(
        self, path: Path, name: str, values: np.ndarray, above: int
    ) -> tuple[np.ndarray, list[Remark]]:
        """Return a channel [T] without fill values; stop at one that no vessel can have."""
        entry, findings = self.channels[name], []
        filled = fills(values)
        if filled.any():
            count = int(filled.sum())
            text = f"{count} cells of {name} hold a fill value and count as missing"
            findings.append(remark("note", "fill_values", text, count=count))
            values = np.where(filled, np.nan, values)
        unit = entry.si(name)
        bad = np.flatnonzero(beyond_belief(entry.in_si(name, values), unit))
        if bad.size:
            i = int(bad[0])
            raise DataError(
                f"{path}: {self._row(i + above)}, column '{entry.column}': {values[i]:g} makes"
                f" {name} larger than {largest(unit):g} {unit}, which no vessel reaches"
                f" ({bad.size} such cells); correct or empty them, or correct the unit"
            )
        return values, findings


@final
class CsvConfig(TableConfig):
    """Text tables with a line of column names; lines above it, and units beneath it, are skipped.

    The names' line is the first one that holds the time's and all channels' columns.

    Attributes:
        delimiter: between cells; a blank stands for any number of blanks and tabulators.
        decimal: sign of the decimals, `.` or `,`.
        encoding: of the text, for example `cp1252` for a file that an older Windows wrote; null
            finds it by the bytes themselves, UTF-16, cp932 and gb18030 included.
    """

    kind: Literal["csv"] = "csv"
    delimiter: str = Field(default=",", min_length=1, max_length=1)
    decimal: Literal[".", ","] = "."
    encoding: str | None = None
    row: ClassVar[str] = "line {1}"

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

    def load(self, path: Path, columns: Sequence[str], advance: Advance) -> pd.DataFrame:
        return read_csv(path, columns, self.delimiter, self.decimal, self.encoding, advance)


@final
class ExcelConfig(TableConfig):
    """Sheets of Excel files (.xlsx); lines above the column names, and units beneath, are skipped.

    Attributes:
        sheet: name of the sheet; null takes the first.
    """

    kind: Literal["excel"] = "excel"
    sheet: str | None = None
    row: ClassVar[str] = "row {1}"

    def load(self, path: Path, columns: Sequence[str], advance: Advance) -> pd.DataFrame:
        table = excel_sheet(path, self.sheet)
        wanted = table.iloc[:, positions(path, [str(name) for name in table.columns], columns)]
        wanted.attrs["above"] = table.attrs["above"] - 1
        return plain(wanted)


@final
class ParquetConfig(TableConfig):
    """Parquet tables that residnet did not write."""

    kind: Literal["parquet"] = "parquet"

    def load(self, path: Path, columns: Sequence[str], advance: Advance) -> pd.DataFrame:
        import pyarrow.parquet as pq

        positions(path, _parquet_names(path), columns)
        with readable(path, "a Parquet file"):
            with pq.ParquetFile(path, page_checksum_verification=True) as file:
                table = file.read(columns=sorted(set(columns)))
            wanted: pd.DataFrame = table.to_pandas(ignore_metadata=True)[list(columns)]
            return wanted


@final
class JsonLinesConfig(TableConfig):
    """Files with a JSON object a line (.jsonl, .ndjson), or a document (.json) that holds a table.

    A column is a key, `nav.lat` one within; entries of lists are counted from zero: `imu.q[0]`. The
    table of a document is its longest list of objects, or the lists of one length beside each
    other.
    """

    kind: Literal["json_lines"] = "json_lines"
    row: ClassVar[str] = "object {0}"

    def load(self, path: Path, columns: Sequence[str], advance: Advance) -> pd.DataFrame:
        """Return the columns of JSON lines; an object without a key has an empty cell there."""
        import pandas as pd

        lines = _JsonLines(path)
        rows = list(lines)
        known = {key for row in rows for key in row}
        for name in columns:
            if name not in known and rows:
                raise UsageError(f"{path}: no key '{name}'{nearest(name, list(known))}")
        table = pd.DataFrame({i: [row.get(n) for row in rows] for i, n in enumerate(columns)})
        table = table.infer_objects()
        table.columns = pd.Index(list(columns))
        table.attrs["cut"] = lines.cut
        return plain(table)


def _at(values: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return values [T] at rows [K]; themselves, and no copy, where these are all in order."""
    every = rows.size == values.size and rows[0] == 0
    return values if every else np.asarray(values[rows])


def _placed(
    path: Path, channels: dict[str, np.ndarray], maps: Mapping[str, ChannelMap]
) -> tuple[dict[str, np.ndarray], list[Remark]]:
    """Return channels with x, y in place of latitude and longitude, and where they count from."""
    if not channels.keys() >= {*FIX} or {"x", "y"} & channels.keys():
        return channels, []
    latitude, longitude = (channels[name] for name in FIX)
    north, east, origin, none = fixes_on_plane(latitude, longitude)
    most = float(np.abs(latitude[np.isfinite(latitude)]).max(initial=0.0))
    if maps["latitude"].si("latitude") != "rad" or most > np.pi / 2:
        raise DataError(
            f"{path}: latitude reaches {np.degrees(most):.4g} deg, which none does; give the unit"
            " of its column (deg), and `form: ddmm` for degrees and minutes in one number"
        )
    if origin is None:
        raise DataError(f"{path}: latitude and longitude hold no fix")
    where = [float(np.degrees(angle)) for angle in origin]
    text = (
        f"x, y are north and east of the first fix, latitude {where[0]:.6f} deg, longitude"
        f" {where[1]:.6f} deg"
    )
    remarks = [remark("note", "origin", text, latitude=origin[0], longitude=origin[1])]
    if none:
        text = f"{none} fixes at latitude 0, longitude 0 are no fixes; left empty"
        remarks.append(remark("note", "no_fix", text, count=float(none)))
    rest = {name: values for name, values in channels.items() if name not in FIX}
    return {"x": north, "y": east, **rest}, remarks


def excel_sheet(path: Path, sheet: str | None, rows: int | None = None) -> pd.DataFrame:
    """Return a sheet as its cells are, with the line above its values that holds names as names.

    Its `attrs` hold `above`, the number of lines above the values, and `between`, the cells of the
    lines between names and values.

    Args:
        sheet: its name; None takes the first.
        rows: how many are read; None for all.
    """
    import pandas as pd

    names = sheet_names(path)
    if sheet is not None and sheet not in names:
        raise UsageError(f"{path}: no sheet '{sheet}'{nearest(sheet, names)}")
    with readable(path, "an Excel file"):
        cells = pd.read_excel(
            path, sheet_name=sheet or 0, nrows=rows, engine="openpyxl", header=None
        )
    first = [
        ["" if pd.isna(cell) else str(cell).strip() for cell in row]
        for row in cells.head(_SEARCHED).itertuples(index=False)
    ]
    at, values = found_header(first) or (0, 1)
    # with the names among them, all columns were of objects
    table = cells.iloc[values:].infer_objects()
    table.columns = pd.Index(numbered(first[at] if first else []))
    table = table.dropna(how="all")
    table.attrs |= {"above": values, "between": first[at + 1 : values]}
    return table


def sheet_names(path: Path) -> list[str]:
    """Return the names of the sheets of an Excel file, in order.

    Raises:
        UsageError: where openpyxl is not installed.
        DataError: where the file cannot be read.
    """
    with package("excel", "openpyxl", "an Excel sheet"):
        import openpyxl
    with readable(path, "an Excel file"):
        return [str(name) for name in openpyxl.load_workbook(path, read_only=True).sheetnames]


def _parquet_names(path: Path) -> list[str]:
    import pyarrow.parquet as pq

    with readable(path, "a Parquet file"):
        try:
            return list(pq.read_schema(path).names)
        except UnicodeDecodeError as error:
            name = shown(bytes(error.object).decode("latin-1"), 60)
            raise DataError(
                f"{path}: '{name}', the name of a column, is no UTF-8 text; rename it where it is"
                " written"
            ) from error


def parquet_rows(path: Path, rows: int) -> pd.DataFrame:
    """Return the first rows of a Parquet file.

    Raises:
        DataError: where it cannot be read.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    with readable(path, "a Parquet file"):
        # an index of pandas is a column as its reader sees it
        batch = next(pq.ParquetFile(path).iter_batches(batch_size=rows))
        table: pd.DataFrame = pa.Table.from_batches([batch]).to_pandas(ignore_metadata=True)
        return table


def json_rows(path: Path, rows: int) -> pd.DataFrame:
    """Return the first rows of a file of JSON lines, a column for each key."""
    import pandas as pd

    found = list(islice(_JsonLines(path), rows))
    if not found:
        raise DataError(f"{path}: the file is empty; an object a line was expected")
    return plain(pd.DataFrame(found).infer_objects())


def column_names(path: Path) -> tuple[str, ...]:
    """Return what tells tables of the same columns: their names, or the first line of a text."""
    kind = TABLES.get(path.suffix.lower(), "csv")
    if kind == "parquet":
        return tuple(_parquet_names(path))
    if kind != "csv":
        return ()
    with path.open("rb") as stream:
        return (stream.readline(1 << 16).decode(errors="replace").strip(),)


@final
class _JsonLines:
    """The objects of a file, flat: `nav.lat` is a key within, `imu.q[0]` an entry of a list."""

    def __init__(self, path: Path) -> None:
        self._path, self.cut = path, False

    def __iter__(self) -> Iterator[dict[str, Any]]:
        number = 0
        with as_utf8(self._path) as file, file.open("rb") as stream:
            if (table := _table_in(self._path, file)) is not None:
                yield from map(_flat, table)
                return
            for line_number, line in enumerate(stream, start=1):
                text = line.decode("utf-8-sig", errors="replace").strip()
                try:
                    if text:
                        value = json.loads(text)
                        if not isinstance(value, dict):
                            raise ValueError("no object")
                        yield from _rows_of(value)
                        number += 1
                except (ValueError, RecursionError) as error:
                    # a recorder that was switched off ends within a line
                    self.cut = number > 0 and not line.endswith(b"\n")
                    if self.cut:
                        return
                    raise DataError(
                        f"{self._path}: line {line_number}, '{shown(text, 60)}', is no JSON object;"
                        " give files with one object a line"
                    ) from error


def _table_in(path: Path, file: Path) -> Sequence[Mapping[str, Any]] | None:
    """Return the objects of the table that one JSON document holds; None for an object a line."""
    if path.suffix.lower() != ".json":
        return None
    try:
        document = json.loads(file.read_text("utf-8-sig", errors="replace"))
    except (ValueError, RecursionError):
        return None
    tables = dict(_tables(document))
    if not tables:
        raise DataError(
            f"{path}: holds no table; a list of objects, or lists of one length by name, were"
            " expected"
        )
    longest = max(tables, key=lambda name: len(tables[name]))
    others = [name for name, rows in tables.items() if len(rows) >= _TABLE and name != longest]
    if others:
        held = ", ".join(f"{name} ({len(tables[name])} rows)" for name in [longest, *others])
        raise DataError(
            f"{path}: holds several tables, {held}; write each into a file of its own, all with a"
            " time: files whose names differ in that word alone are read as one log"
        )
    return tables[longest]


def _tables(value: Any, name: str = "") -> Iterator[tuple[str, Sequence[Mapping[str, Any]]]]:
    """Yield name and rows of the tables in a value: lists of objects, and lists side by side."""
    if isinstance(value, list) and value and all(isinstance(row, dict) for row in value):
        yield name, value
    if not isinstance(value, dict):
        return
    columns = {key: cells for key, cells in value.items() if isinstance(cells, list)}
    bare = {n: c for n, c in columns.items() if not any(isinstance(cell, dict) for cell in c)}
    longest = max(map(len, bare.values()), default=0)
    bare = {key: cells for key, cells in bare.items() if len(cells) == longest}
    if len(bare) > 1:
        yield name, [dict(zip(bare, row, strict=True)) for row in zip(*bare.values(), strict=True)]
    for key, inner in value.items():
        yield from _tables(inner, f"{name}.{key}" if name else str(key))


def _rows_of(value: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the rows that an object holds: one, or one for each update of Signal K."""
    updates = value.get("updates")
    if not isinstance(updates, list) or "context" not in value:
        yield _flat(value)
        return
    for update in updates:
        told = {entry["path"]: entry["value"] for entry in update.get("values", [])}
        yield _flat({"timestamp": update.get("timestamp")} | told)


def _flat(value: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    out: dict[str, Any] = {}
    if value.get("type") == "Point" and isinstance(value.get("coordinates"), list):
        # of GeoJSON (RFC 7946, section 3.1.1)
        pair = zip(("longitude", "latitude"), value["coordinates"], strict=False)
        value = dict(pair)
    for key, entry in value.items():
        name = f"{before}{key}"
        if isinstance(entry, dict):
            out |= _flat(entry, f"{name}.")
        elif isinstance(entry, list):
            # scans and pictures are no channels
            entry = entry if len(entry) <= _LONGEST else []
            out |= _flat({f"{name}[{i}]": part for i, part in enumerate(entry)})
        else:
            out[name] = entry
    return out

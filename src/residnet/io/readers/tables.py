"""Readers of tables (csv, Parquet, Excel, JSON lines) with a channel map.

All conversions take place here: units to SI, signs and frames to NED and to body axes (forward,
starboard, down); psi is unwrapped.
"""

from __future__ import annotations

import codecs
import re
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal, final

import numpy as np
from pydantic import Field, field_validator, model_validator

from residnet.core.config import Config, Seconds
from residnet.core.errors import DataError, UsageError
from residnet.core.frames import rotate, unwrap_angle
from residnet.core.log import Log, Remark, make_remark
from residnet.core.names import suggest_name, truncate
from residnet.core.units import canonical_unit, to_si
from residnet.io.readers.angles import hemisphere_signs, parse_degrees
from residnet.io.readers.base import (
    ConfiguredReader,
    ProgressCallback,
    describe_provenance,
    locate_file,
    reading_progress,
    require_file,
    require_increasing,
    require_samples,
    require_values,
    wrap_read_errors,
)
from residnet.io.readers.cell_values import is_value
from residnet.io.readers.clock_repair import find_unique_rows, repair_clock
from residnet.io.readers.excel_tables import join_excel_sheets, read_excel_sheet
from residnet.io.readers.json_tables import JsonObjectReader
from residnet.io.readers.manoeuvre_kinds import resolve_manoeuvre
from residnet.io.readers.motion_capture import (
    BowAxis,
    MocapAxes,
    VerticalAxis,
    list_bow_axes,
    read_mocap,
)
from residnet.io.readers.quantities import (
    COSINE_SUFFIX,
    EARTH_VELOCITIES,
    PLANAR_QUATERNION,
    QUATERNION,
    SINE_SUFFIX,
    ChannelMap,
    complete_quaternion,
    conversion_factor,
    normalize_quaternion,
    project_fixes,
    quaternion_tilt,
    quaternion_yaw,
    require_speed_units,
    resolve_drift_angle,
)
from residnet.io.readers.several_tests import describe_short_sections, list_joined_sheets
from residnet.io.readers.text_tables import (
    coerce_numeric,
    count_numbers,
    find_column_positions,
    read_csv,
)
from residnet.io.readers.timestamps import DateOrder, parse_texts, parse_zone
from residnet.preprocessing.channel_values import (
    find_lost_poses,
    is_ais_sentinel,
    is_fill_value,
    is_implausible,
    max_magnitude,
)
from residnet.preprocessing.motion import add_true_wind

if TYPE_CHECKING:
    import pandas as pd

DATE_UNIT = "date"
"""Value of `unit` for columns of dates."""
TABLE_KINDS = {
    **dict.fromkeys((".csv", ".tsv", ".txt", ".dat"), "csv"),
    ".xlsx": "excel",
    ".parquet": "parquet",
    **dict.fromkeys((".jsonl", ".ndjson", ".json"), "json_lines"),
}
"""File extension -> `kind` of the reader for tables, which need a channel map."""
FIX_CHANNELS = ("latitude", "longitude")


class TimeColumn(Config):
    """Column of time and its unit, or the constant time between rows.

    Attributes:
        column: name of the column; null for a table without one.
        step: time between two rows of a table without a column of time, for example `0.1 s`.
        unit: unit of the numbers, for example `ms`; `date` for dates and times of day, for example
            `2024-05-03T12:00:00.5+02:00`, `03.05.2024 12:00:00,5` or `12:00:00.5`.
        date: column of dates if `column` has times of day; null if there is none.
        zone: time zone of dates without one, for example `Europe/Berlin`; null takes them as UTC.
        order: order of day, month and year in dates: `dmy`, `mdy` or `ymd`; null detects it.
    """

    column: str | None = None
    step: Seconds | None = Field(default=None, gt=0)
    unit: str = "s"
    date: str | None = None
    zone: str | None = None
    order: DateOrder | None = None

    @field_validator("unit")
    @classmethod
    def _validate_time_unit(cls, unit: str) -> str:
        if unit == DATE_UNIT:
            return unit
        conversion_factor(unit, "s")
        return canonical_unit(unit, "s")

    @field_validator("zone")
    @classmethod
    def _validate_zone(cls, zone: str | None) -> str | None:
        return zone if zone is None else parse_zone(zone).key

    @model_validator(mode="after")
    def _validate_date_settings(self) -> TimeColumn:
        if (self.column is None) == (self.step is None):
            raise ValueError(
                "give `column`, the name of the column of time, or `step`, the time between rows"
            )
        date_settings = [
            name for name in ("date", "zone", "order") if getattr(self, name) is not None
        ]
        if date_settings and self.unit != DATE_UNIT:
            raise ValueError(f"{date_settings[0]} applies to dates only; set unit: {DATE_UNIT}")
        return self

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns of time and date; empty with a constant step."""
        return tuple(name for name in (self.column, self.date) if name is not None)


@dataclass
class _ParsedTable:
    """The numbers of a table before rows are selected and units converted.

    Attributes:
        t: times [T] in s, NaN in rows without a time.
        start_ns: Unix time in ns that `t` counts from; None for a clock without dates.
        raw: channel -> values [T] in the unit of its column, NaN for empty cells.
        is_measured: whether a row has a value of any channel [T].
        findings: remarks on the contents.
        n_lines_above: lines above the values minus one header, to number rows in messages.
        n_rows: number of rows in the file.
        is_truncated: whether the file ends within a row, which is dropped.
    """

    t: np.ndarray
    start_ns: int | None
    raw: dict[str, np.ndarray]
    is_measured: np.ndarray
    findings: list[Remark]
    n_lines_above: int
    n_rows: int
    is_truncated: bool


class TableConfig(ConfiguredReader, ABC):
    """Base class of the readers of tables.

    Attributes:
        time: column of time.
        channels: channel name (canonical or user-defined) -> column, which must exist. `latitude`
            and `longitude` become x and y unless these are mapped; `qx`, `qy`, `qz`, `qw` become
            the heading psi unless it is mapped; the cosine and sine of an angle (`psi_cos` and
            `psi_sin`) become the angle; `speed` U and `drift_angle` beta become the velocities
            u = U cos(beta) and v = -U sin(beta), unless u or v is mapped.
        manoeuvre: type of manoeuvre of every file; `folder` takes the name of each file's folder;
            `auto` infers it from the name of the file, else from rudder angle and heading; null
            means unknown.
        select: column -> value of the rows that are read, for tables of several vessels, such as
            {MMSI: 211000000}.
    """

    time: TimeColumn
    channels: dict[str, ChannelMap] = Field(min_length=1)
    manoeuvre: str | None = None
    select: dict[str, str | int | float] = Field(default_factory=dict)
    row_format: ClassVar[str] = "row {0}"
    """Format of a row number in messages: {0} counts rows from 1, {1} also counts one header."""

    @field_validator("channels")
    @classmethod
    def _validate_channels(cls, channels: dict[str, ChannelMap]) -> dict[str, ChannelMap]:
        for name, entry in channels.items():
            entry.require_valid_channel(name)
        require_speed_units({name: entry.unit for name, entry in channels.items()})
        quaternion_names = [name for name in QUATERNION if name in channels]
        if quaternion_names and (*quaternion_names,) not in (QUATERNION, PLANAR_QUATERNION):
            missing_names = ", ".join(name for name in QUATERNION if name not in channels)
            raise ValueError(
                f"a quaternion needs all of {', '.join(QUATERNION)}, or qz and qw of a planar"
                f" motion; add {missing_names}"
            )
        earth_velocities = [
            name for name in EARTH_VELOCITIES if name in channels and channels[name].frame == "ned"
        ]
        has_heading = {"psi", "psi" + COSINE_SUFFIX, "qw"} & channels.keys()
        if earth_velocities and (len(earth_velocities) < 2 or not has_heading):
            raise ValueError(
                f"channel {earth_velocities[0]}: velocities in earth axes need both u (north) and"
                " v (east) with frame: ned, and a heading psi"
            )
        return channels

    @abstractmethod
    def load(self, path: Path, columns: Sequence[str], advance: ProgressCallback) -> pd.DataFrame:
        """Read columns of a file.

        Args:
            path: file of the table.
            columns: names of the columns to read.
            advance: callback that receives the fraction of the file that has been read.

        Returns:
            The columns in the requested order. `attrs` may have `n_lines_above` (lines above the
            values minus one header), `is_truncated` (whether an incomplete last row was dropped)
            and `units` (unit in the cells of each column).

        Raises:
            UsageError: if a column is missing.
            DataError: if the file cannot be read.
        """

    def read(self, path: Path) -> Log:
        """Read one log.

        See `LogReader.read`. Isolated fill values (-999, 9.97e36) become NaN and are counted. Blank
        rows, and rows without a measurement at both ends, are dropped and counted. In other rows a
        channel without a measurement is NaN.
        """
        require_file(path)
        channel_maps = self.channels
        table = self._parse_table(path)
        findings = table.findings
        n_lines_above = table.n_lines_above
        sample_rows = self._select_sample_rows(path, table)
        clock_resolution = None if self.time.unit == DATE_UNIT else to_si(self.time.unit)
        clock, new_findings = repair_clock(
            table.t[sample_rows],
            (_take_rows(values, sample_rows) for values in table.raw.values()),
            clock_resolution,
        )
        findings += new_findings
        require_increasing(
            path, clock, lambda i: self._format_row(int(sample_rows[i]) + n_lines_above)
        )
        channels = self._convert_channels(path, table, sample_rows)
        channels, new_findings = _to_local_plane(path, channels, channel_maps)
        findings += new_findings
        _add_yaw_of_quaternion(path, channels, channel_maps)
        _add_angles_of_components(channels)
        if "u" in channels and channel_maps["u"].frame == "ned":
            channels["u"], channels["v"] = rotate(channels["u"], channels["v"], -channels["psi"])
        channels = resolve_drift_angle(channels)
        derived_units = {"x": "m", "y": "m", "u": "m/s", "v": "m/s"}
        units = {
            n: channel_maps[n].si_unit_of(n) if n in channel_maps else derived_units.get(n, "rad")
            for n in channels
        }
        if table.is_truncated:
            text = "the file ends within its last line, which is left out"
            findings.append(make_remark("note", "cut_line", text))
        meta = describe_provenance(path, table.n_rows, table.n_rows - sample_rows.size)
        meta |= {"findings": findings} if findings else {}
        if table.start_ns is not None:
            first_epoch_ns = table.start_ns + int(np.rint(clock[0] * 1e9))
            meta |= {"epoch": first_epoch_ns * 1e-9, "epoch_ns": first_epoch_ns}
        log = Log(path.stem, clock, channels, units, meta=meta)
        return add_true_wind(log.replace(manoeuvre=resolve_manoeuvre(self.manoeuvre, path, log)))

    def _parse_table(self, path: Path) -> _ParsedTable:
        """Load the configured columns and convert their cells to numbers.

        Raises:
            DataError: if a row has measurements but no time, or a cell cannot be parsed.
        """
        time = self.time
        channel_maps = self.channels
        columns = [*time.columns, *(entry.column for entry in channel_maps.values())]
        hemisphere_columns = [
            entry.hemisphere for entry in channel_maps.values() if entry.hemisphere
        ]
        with reading_progress(path.name, locate_file(path).stat().st_size, 1.0) as advance:
            table = self.load(path, [*columns, *hemisphere_columns, *self.select], advance)
        # pandas would copy the attrs of a table to each of its columns
        attributes = table.attrs
        table.attrs = {}
        n_lines_above = attributes.get("n_lines_above", 0)
        is_truncated = bool(attributes.get("is_truncated"))
        n_rows = len(table) + is_truncated
        cells = dict(
            zip(
                [*columns, *hemisphere_columns, *self.select],
                (cells for _, cells in table.items()),
                strict=True,
            )
        )
        self._require_matching_units(path, attributes.get("units", ()))
        t, start_ns, findings = self._parse_times(path, cells, len(table), n_lines_above)
        findings += describe_short_sections(path)
        raw = {name: self._parse_channel(path, name, cells, n_lines_above) for name in channel_maps}
        is_selected, new_findings = self._select_rows(path, cells, len(table))
        findings += new_findings
        if not is_selected.all():
            t = np.where(is_selected, t, np.nan)
            raw = {name: np.where(is_selected, values, np.nan) for name, values in raw.items()}
        findings += _mask_lost_poses(raw)
        # free the table before the channels are copied
        del table, cells
        is_measured = np.zeros(t.size, dtype=bool)
        for values in raw.values():
            is_measured |= np.isfinite(values)
        undated_rows = np.flatnonzero(is_measured & ~np.isfinite(t))
        if undated_rows.size:
            raise DataError(
                f"{path}: {self._format_row(undated_rows[0] + n_lines_above)} has measurements but"
                f" no time in column '{time.column}' ({undated_rows.size} such rows); delete them"
                " or restore their time"
            )
        for name, values in raw.items():
            raw[name], new_findings = self._mask_implausible(path, name, values, n_lines_above)
            findings += new_findings
        n_blank_rows = attributes.get("n_blank_lines", 0)
        n_blank_rows += int((is_selected & ~is_measured & ~np.isfinite(t)).sum())
        if n_blank_rows:
            text = f"{n_blank_rows} rows are blank and are left out"
            findings.append(make_remark("note", "blank_rows", text, rows=float(n_blank_rows)))
        return _ParsedTable(
            t, start_ns, raw, is_measured, findings, n_lines_above, n_rows, is_truncated
        )

    def _select_sample_rows(self, path: Path, table: _ParsedTable) -> np.ndarray:
        """Return the numbers of the rows that become samples, in order of time.

        Channels with `hold` are filled in `table.raw`, and remarks are added to its findings.

        Raises:
            DataError: if there are too few rows.
        """
        import pandas as pd

        raw = table.raw
        is_measured = table.is_measured
        ends = np.flatnonzero(is_measured)[[0, -1]] if is_measured.any() else np.array([0, -1])
        is_timed = np.isfinite(table.t[ends[0] : ends[1] + 1])
        sample_rows: np.ndarray = ends[0] + np.flatnonzero(is_timed)
        require_samples(path, sample_rows)
        if (np.diff(table.t[sample_rows]) < 0.0).all():
            sample_rows = sample_rows[::-1]
            text = "the rows are in reverse order of time; the order is corrected"
            table.findings.append(make_remark("note", "newest_first", text))
        is_not_duplicate = find_unique_rows(
            table.t[sample_rows], (_take_rows(values, sample_rows) for values in raw.values())
        )
        if not is_not_duplicate.all():
            text = f"{int((~is_not_duplicate).sum())} rows repeat the previous row and are left out"
            table.findings.append(
                make_remark("note", "copied_rows", text, rows=float((~is_not_duplicate).sum()))
            )
            sample_rows = sample_rows[is_not_duplicate]
        hold_names = [name for name in raw if self.channels[name].hold]
        for name in hold_names:
            raw[name] = pd.Series(raw[name]).ffill().to_numpy()
        if hold_names and len(hold_names) < len(raw):
            # a row with commands only has no sample of the motion; its values are held
            measured_channels = [
                values[sample_rows] for name, values in raw.items() if name not in hold_names
            ]
            sample_rows = sample_rows[np.isfinite(np.stack(measured_channels)).any(axis=0)]
        return sample_rows

    def _convert_channels(
        self, path: Path, table: _ParsedTable, sample_rows: np.ndarray
    ) -> dict[str, np.ndarray]:
        """Convert the sampled rows of each channel to SI units; `table.raw` is emptied.

        Raises:
            DataError: if a channel has no values.
        """
        channels: dict[str, np.ndarray] = {}
        for name, channel_map in self.channels.items():
            # the raw channel is removed, so that two copies of one channel exist at most
            raw_channel = _take_rows(table.raw.pop(name), sample_rows)
            channels[name] = channel_map.convert(name, raw_channel)
            require_values(path, name, channel_map.column, channels[name])
            n_interpolated = int((np.isfinite(raw_channel) & ~np.isfinite(channels[name])).sum())
            if name == "psi" and n_interpolated:
                text = (
                    f"{n_interpolated} headings were interpolated by the recorder from 359 deg"
                    " over 180 deg to 1 deg; they count as missing"
                )
                table.findings.append(make_remark("note", "heading_interpolated", text))
        return channels

    def _require_matching_units(self, path: Path, cell_units: Sequence[str]) -> None:
        """Raise `DataError` if cells contain another unit than the channel map declares.

        Args:
            path: file of the table.
            cell_units: unit in the cells of each column, or an empty string.
        """
        time = self.time
        time_units = [(name, time.unit) for name in time.columns]
        # a column with a scale factor may contain counts of any unit
        channel_units = [
            (item.column, "" if item.scale != 1.0 else item.unit) for item in self.channels.values()
        ]
        for (column, unit), cell_unit in zip(
            [*time_units, *channel_units], cell_units, strict=False
        ):
            if cell_unit and unit and cell_unit != canonical_unit(unit):
                raise DataError(
                    f"{path}: the cells of column '{column}' are in {cell_unit}, not in {unit}; set"
                    f" unit: {cell_unit}"
                )

    def _select_rows(
        self, path: Path, cells: Mapping[str, pd.Series], rows: int
    ) -> tuple[np.ndarray, list[Remark]]:
        """Return which of the `rows` rows are read, bool [T], and a remark on the others.

        Raises:
            DataError: if no row has the selected value.
        """
        is_selected = np.ones(rows, dtype=bool)
        remarks = []
        for column, value in self.select.items():
            # a number may be stored as 211000000 or 211000000.0
            texts = cells[column].astype("string").str.strip().str.removesuffix(".0")
            text = str(value).removesuffix(".0")
            is_selected &= (texts == text).to_numpy(dtype=bool, na_value=False)
            others = [str(name) for name in texts[~is_selected].dropna().unique()]
            if not is_selected.any():
                names = truncate(", ".join(others), 80)
                raise DataError(
                    f"{path}: no row has {text} in column '{column}' (it has {names}); correct"
                    " `select`"
                )
            if others:
                count = int((~is_selected).sum())
                names = truncate(", ".join(others), 80)
                text = (
                    f"{count} rows with another '{column}' than {text} are left out ({names}): one"
                    " config reads one vessel (key `select`)"
                )
                remarks.append(make_remark("note", "other_vessels", text, rows=float(count)))
        return is_selected, remarks

    def _format_row(self, i: int) -> str:
        return self.row_format.format(i + 1, i + 2)

    def _parse_times(
        self, path: Path, cells: Mapping[str, pd.Series], rows: int, n_lines_above: int
    ) -> tuple[np.ndarray, int | None, list[Remark]]:
        """Convert the column of time, or count `rows` in constant steps.

        Returns:
            Times [T] in s; the Unix time in ns that they count from (None without dates); remarks.
        """
        time = self.time
        if time.step is not None:
            return time.step * np.arange(rows), None, []
        assert time.column is not None
        texts = cells[time.column]
        if time.unit != DATE_UNIT:
            return (
                self._parse_numbers(path, texts, time.column, n_lines_above) * to_si(time.unit),
                None,
                [],
            )
        if time.date is not None:
            days = cells[time.date].astype("string").str.strip()
            texts = days + " " + texts.astype("string").str.strip()
        try:
            stamps = parse_texts(texts, zone=time.zone, order=time.order, has_only_dates=True)
        except DataError as error:
            raise DataError(f"{path}: column '{time.column}': {error}") from None
        is_valid = np.ones(len(texts), dtype=bool) if stamps.valid is None else stamps.valid
        start_ns = int(stamps.ns[is_valid][0]) if is_valid.any() else 0
        t = np.where(is_valid, (stamps.ns - start_ns) * 1e-9, np.nan)
        return t, start_ns if stamps.is_absolute else None, list(stamps.remarks)

    def _parse_channel(
        self, path: Path, name: str, cells: Mapping[str, pd.Series], n_lines_above: int
    ) -> np.ndarray:
        """Return one channel [T] in the unit of its column, NaN for empty cells."""
        import pandas as pd

        entry = self.channels[name]
        column = entry.column
        is_text = name in FIX_CHANNELS and not pd.api.types.is_numeric_dtype(cells[column])
        if not entry.is_angle and not is_text:
            return self._parse_numbers(path, cells[column], column, n_lines_above)
        if canonical_unit(entry.unit) != "deg":
            raise DataError(f"{path}: the angles in column '{column}' are degrees; set unit: deg")
        try:
            angles = parse_degrees(cells[column], name, entry.form, entry.letter_o)
            if entry.hemisphere is not None:
                column = entry.hemisphere
                angles = angles * hemisphere_signs(cells[column], name, entry.letter_o)
        except DataError as error:
            raise DataError(f"{path}: column '{column}': {error}") from None
        return angles

    def _parse_numbers(
        self, path: Path, column: pd.Series, name: str, n_lines_above: int
    ) -> np.ndarray:
        """Return the cells of one column as float64 [T], NaN for empty cells."""
        import pandas as pd

        numeric = (
            column
            if pd.api.types.is_numeric_dtype(column)
            else pd.to_numeric(column.astype("string"), errors="coerce")
        )
        values = numeric.to_numpy(dtype=np.float64, na_value=np.nan)
        if np.isfinite(values).all():
            return values
        invalid_rows = np.flatnonzero(
            (np.isnan(values) & column.notna().to_numpy()) | np.isinf(values)
        )
        if invalid_rows.size:
            i = int(invalid_rows[0])
            raise DataError(
                f"{path}: {self._format_row(i + n_lines_above)}, column '{name}':"
                f" '{truncate(column.iloc[i])}' is not a finite number ({invalid_rows.size} such"
                f" cells in {len(column)} rows); leave cells without a measurement empty, and check"
                " `delimiter` and `decimal`"
            )
        return values

    def _mask_implausible(
        self, path: Path, name: str, values: np.ndarray, n_lines_above: int
    ) -> tuple[np.ndarray, list[Remark]]:
        """Return a channel [T] without fill values, and remarks.

        Raises:
            DataError: if a value exceeds what any vessel reaches.
        """
        entry = self.channels[name]
        findings = []
        is_fill = is_fill_value(values) | is_ais_sentinel(name, entry.unit, values)
        if is_fill.any():
            count = int(is_fill.sum())
            text = f"{count} cells of {name} hold a fill value and count as missing"
            findings.append(make_remark("note", "fill_values", text, count=count))
            values = np.where(is_fill, np.nan, values)
        unit = entry.si_unit_of(name)
        implausible_rows = np.flatnonzero(is_implausible(entry.magnitude_in_si(name, values), unit))
        if implausible_rows.size:
            i = int(implausible_rows[0])
            raise DataError(
                f"{path}: {self._format_row(i + n_lines_above)}, column '{entry.column}':"
                f" {values[i]:g} makes {name} larger than {max_magnitude(unit):g} {unit}, which no"
                f" vessel reaches ({implausible_rows.size} such cells); correct or empty them, or"
                " correct the unit"
            )
        return values, findings


def _mask_lost_poses(channels: dict[str, np.ndarray]) -> list[Remark]:
    """Replace zeros of a lost pose by NaN in the channels [T], in place; returns a remark."""
    angles = ["psi"] if "psi" in channels else [n for n in QUATERNION if n in channels]
    if not angles or not {"x", "y"} <= channels.keys():
        return []
    is_lost = find_lost_poses(channels["x"], channels["y"], [channels[name] for name in angles])
    if not is_lost.any():
        return []
    for name in {"x", "y", *angles, "z", "phi", "theta"} & channels.keys():
        channels[name] = np.where(is_lost & (channels[name] == 0.0), np.nan, channels[name])
    count = int(is_lost.sum())
    text = (
        f"position and heading are exactly 0 in {count} rows, where the vessel is elsewhere: its"
        " tracking was lost; these samples count as missing"
    )
    return [make_remark("note", "lost_poses", text, count=float(count))]


@final
class CsvConfig(TableConfig):
    """Reader of text tables.

    The header is the first line that contains the names of all required columns. Lines above it,
    and units below it, are skipped. Without such a line `names` names the columns; the values begin
    at the first line with as many numbers.

    Attributes:
        names: names of all columns in order, for files without a line of names.
        delimiter: separator of cells; a blank means any number of blanks and tabs.
        decimal: decimal sign, `.` or `,`.
        encoding: encoding of the text, for example `cp1252` for files of older Windows programs;
            null detects it.
        mocap_up: axis that points up in an export of OptiTrack Motive, Qualisys (6D) or Vicon with
            rigid bodies, `y` or `z`; null for other tables. Positions are `north [m]` and
            `east [m]`, with x to the north, and `height [m]`, or `depth [m]` of a vessel that
            dives; the quaternion is `q_x` to `q_w`.
        mocap_bow: axis of the rigid body that points forward.
        mocap_body: name of the rigid body to read; null reads all, the name before each column.
    """

    kind: Literal["csv"] = "csv"
    names: tuple[str, ...] | None = Field(default=None, min_length=1)
    delimiter: str = Field(default=",", min_length=1, max_length=1)
    decimal: Literal[".", ","] = "."
    encoding: str | None = None
    mocap_up: VerticalAxis | None = None
    mocap_bow: BowAxis = "x"
    mocap_body: str | None = None
    row_format: ClassVar[str] = "line {1}"

    @field_validator("encoding")
    @classmethod
    def _validate_encoding(cls, encoding: str | None) -> str | None:
        if encoding is None:
            return None
        try:
            return codecs.lookup(encoding).name
        except LookupError as error:
            raise ValueError(
                f"no encoding is called '{encoding}'; common ones are utf-8, utf-16, cp1252 and"
                " cp932"
            ) from error

    @model_validator(mode="after")
    def _validate_mocap_axes(self) -> CsvConfig:
        if self.mocap_up is not None and self.mocap_bow not in list_bow_axes(self.mocap_up):
            axes = ", ".join(list_bow_axes(self.mocap_up))
            raise ValueError(
                f"mocap_bow: '{self.mocap_bow}' is vertical with mocap_up: {self.mocap_up};"
                f" expected one of {axes}"
            )
        return self

    def load(self, path: Path, columns: Sequence[str], advance: ProgressCallback) -> pd.DataFrame:
        if self.mocap_up is not None:
            axes = MocapAxes(self.mocap_up, self.mocap_bow)
            table = read_mocap(path, axes, self.mocap_body)
            selected = table.iloc[:, find_column_positions(path, list(table.columns), columns)]
            selected.attrs = dict(table.attrs)
            return selected
        return read_csv(
            path, columns, self.delimiter, self.decimal, self.encoding, advance, self.names
        )


@final
class ExcelConfig(TableConfig):
    """Reader of sheets in Excel files (.xlsx).

    Rows above the column names, and units below them, are skipped. Numbers in cells of text may
    have a decimal comma.

    Attributes:
        sheet: name of the sheet; null takes the first one, and reads each test of a file with
            several tests as a log, also tests with several sheets each. Several names are the
            sheets of one recording, whose first columns are the time: their rows are merged in
            order of time.
    """

    kind: Literal["excel"] = "excel"
    sheet: str | tuple[str, ...] | None = None
    row_format: ClassVar[str] = "row {1}"

    def select_logs(self, paths: Sequence[Path]) -> list[Path]:
        """Return the files in place of their tests if the config names the sheet to read."""
        if self.sheet is None:
            return list(paths)
        return list(dict.fromkeys(locate_file(path) for path in paths))

    def load(self, path: Path, columns: Sequence[str], advance: ProgressCallback) -> pd.DataFrame:
        sheets = self.sheet if isinstance(self.sheet, tuple) else list_joined_sheets(path)
        table = (
            join_excel_sheets(path, {name: read_excel_sheet(path, name) for name in sheets})
            if sheets
            else read_excel_sheet(path, None if self.sheet is None else str(self.sheet))
        )
        selected = table.iloc[
            :, find_column_positions(path, [str(name) for name in table.columns], columns)
        ]
        selected.attrs["n_lines_above"] = table.attrs["n_lines_above"] - 1
        return coerce_numeric(selected)


@final
class ParquetConfig(TableConfig):
    """Reader of Parquet tables that residnet did not write."""

    kind: Literal["parquet"] = "parquet"

    def load(self, path: Path, columns: Sequence[str], advance: ProgressCallback) -> pd.DataFrame:
        import pyarrow.parquet as pq

        find_column_positions(path, _read_parquet_names(path), columns)
        with wrap_read_errors(path, "a Parquet file"):
            with pq.ParquetFile(path, page_checksum_verification=True) as file:
                table = file.read(columns=sorted(set(columns)))
            selected: pd.DataFrame = table.to_pandas(ignore_metadata=True)[list(columns)]
            return selected


@final
class JsonLinesConfig(TableConfig):
    """Reader of JSON: one object per line (.jsonl, .ndjson), or a document (.json) with a table.

    A column is a key; `nav.lat` is a nested key, `imu.q[0]` the first entry of a list. The table of
    a document is its longest list of objects, or a group of lists of equal length.
    """

    kind: Literal["json_lines"] = "json_lines"
    row_format: ClassVar[str] = "object {0}"

    def load(self, path: Path, columns: Sequence[str], advance: ProgressCallback) -> pd.DataFrame:
        """Read columns; an object without a key has an empty cell."""
        import pandas as pd

        lines = JsonObjectReader(path)
        rows = list(lines)
        keys = {key for row in rows for key in row}
        for name in columns:
            if name not in keys and rows:
                raise UsageError(f"{path}: no key '{name}'{suggest_name(name, list(keys))}")
        table = pd.DataFrame({i: [row.get(n) for row in rows] for i, n in enumerate(columns)})
        table = table.infer_objects()
        table.columns = pd.Index(list(columns))
        table.attrs["is_truncated"] = lines.is_truncated
        return coerce_numeric(table)


def _take_rows(values: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return the values [T] at rows [K], without a copy if these are all rows in order."""
    is_identity = rows.size == values.size and rows[0] == 0
    return values if is_identity else np.asarray(values[rows])


def _add_yaw_of_quaternion(
    path: Path, channels: dict[str, np.ndarray], channel_maps: Mapping[str, ChannelMap]
) -> None:
    """Replace the channels of a quaternion by the heading psi, unless psi is mapped.

    With a depth z the roll and pitch angles phi and theta are added.

    Raises:
        DataError: if no row has a quaternion.
    """
    if not channels.keys() >= {*PLANAR_QUATERNION} or "psi" in channels:
        return
    part_names = [name for name in QUATERNION if name in channels]
    parts = [channels.pop(name) for name in part_names]
    quaternion = normalize_quaternion(*complete_quaternion(parts))
    yaw = quaternion_yaw(*quaternion)
    if not np.isfinite(yaw).any():
        columns = [channel_maps[name].column for name in part_names]
        raise DataError(
            f"{path}: {', '.join(columns)} contain no quaternion, all rows are empty;"
            " remove them from the channel map, or leave the file out"
        )
    # the frame of a quaternion is set at qw: in `enu` yaw is counter-clockwise from east
    is_enu = channel_maps["qw"].frame == "enu"
    channels["psi"] = unwrap_angle(np.pi / 2.0 - yaw if is_enu else yaw)
    if "z" in channels:
        # about the axis to port of a body in `enu`, a positive pitch lowers the bow
        roll, pitch = quaternion_tilt(*quaternion)
        channels.setdefault("phi", unwrap_angle(roll))
        channels.setdefault("theta", -pitch if is_enu else pitch)


def _add_angles_of_components(channels: dict[str, np.ndarray]) -> None:
    """Replace the cosine and sine of each angle by the angle, unless the angle is mapped."""
    names = [
        cosine_name.removesuffix(COSINE_SUFFIX)
        for cosine_name in channels
        if cosine_name.endswith(COSINE_SUFFIX)
    ]
    for name in names:
        if name + SINE_SUFFIX in channels and name not in channels:
            sine = channels.pop(name + SINE_SUFFIX)
            cosine = channels.pop(name + COSINE_SUFFIX)
            channels[name] = unwrap_angle(np.arctan2(sine, cosine))


def _to_local_plane(
    path: Path, channels: dict[str, np.ndarray], channel_maps: Mapping[str, ChannelMap]
) -> tuple[dict[str, np.ndarray], list[Remark]]:
    """Replace latitude and longitude by x and y on a local tangent plane.

    Args:
        path: file of the log, for messages.
        channels: channels in SI.
        channel_maps: entries of the channel map.

    Returns:
        The channels, and remarks on the origin of the plane.

    Raises:
        DataError: if the angles are no latitudes, or no fix exists.
    """
    if not channels.keys() >= {*FIX_CHANNELS} or {"x", "y"} & channels.keys():
        return channels, []
    latitude, longitude = (channels[name] for name in FIX_CHANNELS)
    north, east, origin, n_null_fixes = project_fixes(latitude, longitude)
    max_latitude = float(np.abs(latitude[np.isfinite(latitude)]).max(initial=0.0))
    if channel_maps["latitude"].si_unit_of("latitude") != "rad" or max_latitude > np.pi / 2:
        raise DataError(
            f"{path}: latitude reaches {np.degrees(max_latitude):.4g} deg, at most 90 deg is"
            " possible; give the unit of its column (deg), and `form: ddmm` for degrees and minutes"
            " in one number"
        )
    if origin is None:
        raise DataError(
            f"{path}: latitude and longitude contain no fix; remove them from the channel map, or"
            " leave the file out"
        )
    origin_deg = [float(np.degrees(angle)) for angle in origin]
    text = (
        f"x, y are north and east of the first fix, latitude {origin_deg[0]:.6f} deg, longitude"
        f" {origin_deg[1]:.6f} deg"
    )
    remarks = [make_remark("note", "origin", text, latitude=origin[0], longitude=origin[1])]
    if n_null_fixes:
        text = f"{n_null_fixes} positions at latitude 0, longitude 0 are no fixes; they are missing"
        remarks.append(make_remark("note", "no_fix", text, count=float(n_null_fixes)))
    other_channels = {name: values for name, values in channels.items() if name not in FIX_CHANNELS}
    return {"x": north, "y": east, **other_channels}, remarks


def _read_parquet_names(path: Path) -> list[str]:
    import pyarrow.parquet as pq

    with wrap_read_errors(path, "a Parquet file"):
        try:
            return list(pq.read_schema(path).names)
        except UnicodeDecodeError as error:
            name = truncate(bytes(error.object).decode("latin-1"), 60)
            raise DataError(
                f"{path}: the column name '{name}' is no UTF-8 text; rename the column in the"
                " program that writes it"
            ) from error


def read_parquet_head(path: Path, rows: int) -> pd.DataFrame:
    """Return the first rows of a Parquet file.

    Raises:
        DataError: if the file cannot be read.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    with wrap_read_errors(path, "a Parquet file"):
        # an index of pandas counts as a column
        batch = next(pq.ParquetFile(path).iter_batches(batch_size=rows))
        table: pd.DataFrame = pa.Table.from_batches([batch]).to_pandas(ignore_metadata=True)
        return table


_MAX_COMMENT_LINES = 50
"""Largest number of lines of comments above a table."""


def read_column_names(path: Path) -> tuple[str, ...]:
    """Return a key that is equal for tables with the same columns.

    It is the column names of a Parquet file, the first line of a text below its comments, and empty
    for other formats.
    """
    path = locate_file(path)
    table_kind = TABLE_KINDS.get(path.suffix.lower(), "csv")
    if table_kind == "parquet":
        return tuple(_read_parquet_names(path))
    if table_kind != "csv":
        return ()
    line = comment = ""
    with path.open("rb") as stream:
        for raw_line in islice(stream, _MAX_COMMENT_LINES):
            comment = line
            line = raw_line[: 1 << 16].decode(errors="replace").strip()
            if not line.startswith(("#", "%", "//")):
                break
    # titles in comments differ from file to file; the last one may have the names
    cells = re.split(r"[\s,;|]+", line)
    if comment and 2 * sum(map(is_value, cells)) > len(cells):
        line = comment
    for start in ("Format Version", "NO_OF_FRAMES"):
        if line.startswith(start):
            # the first line of an export of motion capture has the take or its length
            return (start,)
    # the numbers of tables without a line of names differ from file to file
    n_numbers = count_numbers(line)
    return (f"{n_numbers} columns of numbers" if n_numbers > 1 else line,)

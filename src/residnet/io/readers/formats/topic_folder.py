"""Reader of folders with one csv file per topic, as tools export ROS bags."""

from __future__ import annotations

import contextlib
import csv
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal, final

import numpy as np
from pydantic import Field

from residnet.core.errors import DataError
from residnet.core.log import Remark, make_remark
from residnet.core.names import truncate
from residnet.core.units import to_si
from residnet.io.header_vocabulary import ARRIVAL_COLUMN_NAMES, match_state_channel, parse_name
from residnet.io.readers.base import (
    LARGE_FOLDER_BYTES,
    reading_progress,
    require_file,
    sum_file_sizes,
)
from residnet.io.readers.compose import RecordingConfig
from residnet.io.readers.joined_files import group_trip_files
from residnet.io.readers.recording import (
    ALL_FIELDS,
    FieldFilter,
    RawSeries,
    Recording,
    TimeStamps,
    build_recording,
    normalize_field_path,
)
from residnet.io.readers.text_encoding import detect_encoding_of_head, open_as_utf8
from residnet.io.readers.timestamps import (
    detect_unix_unit,
    infer_time_unit,
    parse_numbers,
    parse_texts,
)

if TYPE_CHECKING:
    import pandas as pd

_ENDINGS = (".csv", ".tsv", ".txt")
_CLOCK_WITH_UNIT = re.compile(r"(?:time|timestamp)s?\s*[\[(]", re.IGNORECASE)
"""Column of time with its unit in brackets."""
_MAX_MULTIPLEXED = 16
"""Largest number of actuators whose values share one column, with an index in another one."""
_MAX_START_SPREAD = 60.0
"""Largest difference in s between the first times of the topics in one recording."""
# names of the columns of a header stamp in ROS 1 and ROS 2
_SECONDS = ("secs", "sec")
_NANOSECONDS = ("nsecs", "nanosec")


def is_topic_folder(path: Path) -> bool:
    """Return whether the csv files in a folder are topics of one recording, not separate logs.

    Topics have columns of header stamps, or different columns and times in one unit. Files of
    several trips are no topics.
    """
    if not path.is_dir():
        return False
    headers: dict[Path, list[str]] = {}
    start_times: dict[Path, float] = {}
    for file in _list_table_files(path)[:200]:
        names, *value_rows = _read_head_cells(file)[:2]
        if names != [""]:
            headers[file] = names
        cells = dict(zip(names, value_rows[0], strict=False)) if value_rows else {}
        with contextlib.suppress(ValueError):
            start_times[file] = float(
                cells.get(_find_clock_column(names, ARRIVAL_COLUMN_NAMES) or "", "")
            )
    if any(_find_stamp_columns(head) is not None for head in headers.values()):
        return True
    trips = group_trip_files({file: tuple(head) for file, head in headers.items()})
    units = {detect_unix_unit(np.array([start_time])) for start_time in start_times.values()}
    if any(len(files) > 1 for files in trips.values()) or len(units) > 1:
        return False
    # other names of clocks occur in logs too, unless all files start at nearly the same date
    has_common_date = units == {"s"} and np.ptp([*start_times.values()]) < _MAX_START_SPREAD
    timed_headers = [
        head
        for head in headers.values()
        if (clock_column := _find_clock_column(head, ARRIVAL_COLUMN_NAMES)) in ARRIVAL_COLUMN_NAMES
        or (clock_column is not None and has_common_date)
    ]
    has_different_headers = (
        len(timed_headers) > 1
        and 2 * len(timed_headers) > len(headers)
        and len(set(map(tuple, timed_headers))) > 1
    )
    return has_different_headers and sum(_is_complete_log(head) for head in timed_headers) < 2


def _list_table_files(folder: Path) -> list[Path]:
    """Return the csv files below a folder in sorted order."""
    folder_contents = sorted(folder.rglob("*"))
    return [file for file in folder_contents if file.suffix.lower() in _ENDINGS and file.is_file()]


def _is_complete_log(columns: list[str]) -> bool:
    """Return whether columns contain the complete motion of a vessel, as in a log."""
    channels = {match_state_channel(parse_name(column)) for column in columns}
    complete_sets = ({"x", "y", "psi"}, {"latitude", "longitude", "psi"}, {"u", "v", "r"})
    return any(complete_set <= channels for complete_set in complete_sets)


@final
class TopicFolderConfig(RecordingConfig):
    """Reader of a folder of csv files, one per topic with its own clock, or of one such file.

    The name of a topic is the path of its file in the folder without extension.

    Attributes:
        time: possible names of the column of arrival times, in order of precedence.
        delimiter: separator of cells.
    """

    kind: Literal["csv_topics"] = "csv_topics"
    time: tuple[str, ...] = Field(default=ARRIVAL_COLUMN_NAMES, min_length=1)
    delimiter: str = Field(default=",", min_length=1, max_length=1)
    formats: ClassVar = {"folder of csv files": lambda path, head: is_topic_folder(path)}

    def load(self, path: Path, field_filter: FieldFilter = ALL_FIELDS) -> Recording:
        """Read topics of a folder.

        In a small folder all topics are read, so that their faults are reported too.
        """
        if not path.is_dir():
            require_file(path)
        files, root = (_list_table_files(path), path) if path.is_dir() else ([path], path.parent)
        if not files:
            raise DataError(f"{path}: has no csv file; give a folder with one csv file per topic")
        size = sum_file_sizes(files)
        bytes_read = 0
        topics: dict[str, RawSeries] = {}
        remarks: list[Remark] = []
        unread_topics: list[str] = []
        # in small folders read all topics to report their faults
        active_filter = ALL_FIELDS if size < LARGE_FOLDER_BYTES else field_filter
        topic_names = [file.relative_to(root).with_suffix("").as_posix() for file in files]
        topic_names = _strip_uninformative_folder(topic_names)
        # ulog2csv starts each file name with the name of the recording
        common_prefix = f"{root.name}_"
        common_prefix = (
            common_prefix if all(name.startswith(common_prefix) for name in topic_names) else ""
        )
        steps = [step for file in files if (step := _estimate_time_step(file, self.time))]
        unit = infer_time_unit(min(steps, default=0.0))
        with reading_progress(path.name, size, size) as advance:
            for file, name in zip(
                files,
                (topic_name.removeprefix(common_prefix) for topic_name in topic_names),
                strict=True,
            ):
                if not active_filter(name):
                    unread_topics.append(name)
                    continue
                with open_as_utf8(file) as text:
                    parsed_topic = self._read_topic(text, name, active_filter, unit)
                if isinstance(parsed_topic, RawSeries):
                    topics[name] = parsed_topic
                else:
                    remarks.append(parsed_topic)
                bytes_read += file.stat().st_size
                advance(bytes_read)
        if not topics:
            raise DataError(
                f"{path}: none of {len(files)} csv files is a topic ({remarks[0]['text']})"
            )
        return build_recording(path, topics, tuple(files), remarks, unread_topics)

    def _read_topic(
        self, file: Path, name: str, field_filter: FieldFilter, unit: str
    ) -> RawSeries | Remark:
        """Read one topic; return a remark instead if the file is no topic.

        Args:
            file: csv file in UTF-8.
            name: name of the topic.
            field_filter: filter of fields.
            unit: unit of times that are no Unix times.
        """
        import pandas as pd

        delimiter = "\t" if file.suffix.lower() == ".tsv" else self.delimiter
        if not file.stat().st_size:
            return make_remark("note", "empty_topic", f"topic {name}: the file is empty")
        try:
            with file.open(newline="", encoding="utf-8-sig") as stream:
                header = [
                    cell.strip() for cell in next(csv.reader(stream, delimiter=delimiter), [])
                ]
            clock_column = _find_clock_column(header, self.time)
            stamp_columns = _find_stamp_columns(header) or _find_stamp_column(header)
            if clock_column is None and stamp_columns is None:
                text = (
                    f"topic {name}: no column of time (expected one of {', '.join(self.time)}, or a"
                    " header stamp); the file is left out"
                )
                return make_remark("note", "no_time", text)
            required_columns = {clock_column, *(stamp_columns or ())}
            column_indices = [
                i
                for i, column in enumerate(header)
                if column in required_columns
                or _is_sender_column(column)
                or parse_name(column).has_all("index")
                or field_filter.accepts_field(name, column)
            ]
            table = pd.read_csv(
                file,
                sep=delimiter,
                header=None,
                skiprows=1,
                names=list(range(len(header))),
                usecols=column_indices,
                index_col=False,
                dtype={header.index(clock_column): str} if clock_column is not None else {},
                encoding="utf-8-sig",
                low_memory=False,
            )
            if table.empty:
                raise pd.errors.EmptyDataError
            columns = {header[i]: table[i] for i in column_indices}
            return _parse_topic(name, columns, clock_column, unit, stamp_columns)
        except pd.errors.EmptyDataError:
            text = f"topic {name}: the file has a header and no rows"
            return make_remark("note", "empty_topic", text)
        except (UnicodeDecodeError, csv.Error, pd.errors.ParserError) as error:
            reason = " ".join(str(error).split())
            text = f"topic {name}: not a regular UTF-8 table ({reason}); left out"
            return make_remark("will mislead", "unreadable", text)
        except DataError as error:
            text = f"topic {name}: {error}; the file is left out"
            return make_remark("will mislead", "no_time", text)


def _strip_uninformative_folder(topic_names: list[str]) -> list[str]:
    """Return topic names without a common folder that names no known quantity."""
    folders = {name.partition("/")[0] for name in topic_names if "/" in name}
    has_single_folder = len(folders) == 1 and all("/" in name for name in topic_names)
    if not has_single_folder or parse_name(*folders).concepts:
        return topic_names
    return _strip_uninformative_folder([name.partition("/")[2] for name in topic_names])


def _read_head_cells(file: Path) -> list[list[str]]:
    """Return the cells of a topic's first lines, of which the last may be incomplete."""
    with file.open("rb") as stream:
        head = stream.read(10_000)
    lines = (
        head.decode(detect_encoding_of_head(head), errors="replace")
        .removeprefix("\ufeff")
        .splitlines()
    )
    return [[cell.strip() for cell in line.split(",")] for line in lines] or [[""]]


def _find_clock_column(header: Sequence[str], clocks: Sequence[str]) -> str | None:
    """Return the column of arrival times, or None.

    Args:
        header: column names.
        clocks: names of clocks in order of precedence, before `time [unit]`.
    """
    matching_names = (name for name in header if _CLOCK_WITH_UNIT.match(name))
    return next((name for name in clocks if name in header), next(matching_names, None))


def _estimate_time_step(file: Path, clocks: Sequence[str]) -> float:
    """Return the median step of the first times of a topic in its own unit; 0 if unknown."""
    names, *rows = _read_head_cells(file)[:-1] or [[""]]
    name = _find_clock_column(names, clocks)
    clock_index = len(names) if name is None else names.index(name)
    try:
        steps = np.diff([float(row[clock_index]) for row in rows if len(row) > clock_index])
    except ValueError:
        return 0.0
    return float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0


def _is_sender_column(column: str) -> bool:
    return normalize_field_path(column).endswith("frame_id")


def _find_stamp_columns(header: list[str]) -> tuple[str, str] | None:
    """Return the columns with seconds and nanoseconds of a header stamp, or None."""
    column_by_key = {normalize_field_path(column): column for column in header}
    for seconds, nanoseconds in zip(_SECONDS, _NANOSECONDS, strict=True):
        for prefix in ("header_stamp_", "stamp_"):
            if prefix + seconds in column_by_key and prefix + nanoseconds in column_by_key:
                return column_by_key[prefix + seconds], column_by_key[prefix + nanoseconds]
    return None


def _find_stamp_column(header: list[str]) -> tuple[str] | None:
    """Return the column of a header stamp in one number, as `rostopic echo -p` writes it."""
    return next(
        ((column,) for column in header if normalize_field_path(column) == "header_stamp"), None
    )


def _parse_header_stamps(columns: Sequence[np.ndarray]) -> TimeStamps | None:
    """Return header stamps from one column, or from columns of seconds and nanoseconds.

    None if the stamps are not set or no Unix time.
    """
    if not all(np.isfinite(values).all() for values in columns) or not columns[0].any():
        return None
    if len(columns) == 2:
        seconds, nanoseconds = columns
        ns = seconds.astype(np.int64) * 10**9 + nanoseconds.astype(np.int64)
        return TimeStamps(ns, parse_numbers(seconds.astype(np.float64)).is_absolute)
    unit = detect_unix_unit(columns[0].astype(np.float64))
    if unit is None:
        return None
    ns_per_count = round(1e9 * to_si(unit))
    if columns[0].dtype.kind in "iu":
        return TimeStamps(columns[0].astype(np.int64) * ns_per_count, True)
    return TimeStamps(np.rint(columns[0] * ns_per_count).astype(np.int64), True)


def _parse_topic(
    name: str,
    columns: dict[str, pd.Series],
    clock_column: str | None,
    unit: str,
    stamp_columns: tuple[str, ...] | None,
) -> RawSeries:
    """Convert the columns of a topic to a series; columns of text other than senders are ignored.

    Args:
        name: name of the topic.
        columns: column -> cells.
        clock_column: column of arrival times.
        unit: unit of times that are no Unix times.
        stamp_columns: column of the header stamp, or columns with its seconds and nanoseconds.

    Raises:
        DataError: if the column of arrival times has other cells.
    """
    arrival = header_stamps = None
    remarks: list[Remark] = []
    if clock_column is not None:
        try:
            arrival = parse_texts(columns[clock_column], unit=unit)
        except DataError:
            if len(columns[clock_column]) < 2:
                raise
            columns = {column: cells.iloc[:-1] for column, cells in columns.items()}
            arrival = parse_texts(columns[clock_column], unit=unit)
            text = f"topic {name}: the last row is incomplete; left out"
            remarks.append(make_remark("note", "cut_short", text, rows=1.0))
    value_columns = {column: cells for column, cells in columns.items() if column != clock_column}
    sender = _parse_sender(value_columns)
    numeric_columns = {}
    for column, cells in value_columns.items():
        numeric_values, column_remarks = _parse_numeric_column(name, column, cells)
        remarks += column_remarks
        if numeric_values is not None:
            numeric_columns[column] = numeric_values
    if stamp_columns is not None and {*stamp_columns} <= numeric_columns.keys():
        header_stamps = _parse_header_stamps([numeric_columns[column] for column in stamp_columns])
    fields = {
        n: v.astype(np.float64, copy=False)
        for n, v in numeric_columns.items()
        if n not in (stamp_columns or ())
    }
    for stamps in (arrival, header_stamps):
        for stamp_remark in () if stamps is None else stamps.remarks:
            remarks.append({**stamp_remark, "text": f"topic {name}: {stamp_remark['text']}"})
    return RawSeries("", _demultiplex(fields), header_stamps, arrival, sender, tuple(remarks))


def _parse_sender(columns: Mapping[str, pd.Series]) -> np.ndarray | None:
    """Return the sender of each row from the first column of frame names in text, or None."""
    import pandas as pd

    for column, cells in columns.items():
        if _is_sender_column(column) and not pd.api.types.is_numeric_dtype(cells.dtype):
            # one string object per name instead of one per row
            names = cells.fillna("").astype(str).astype("category")
            return np.array(names.cat.categories, dtype=object)[names.cat.codes.to_numpy()]
    return None


def _parse_numeric_column(
    topic: str, column: str, cells: pd.Series
) -> tuple[np.ndarray | None, list[Remark]]:
    """Convert the cells of a column to numbers.

    Returns:
        The numbers [T], NaN for other cells; None if half of the cells or more are text, or if the
        column contains senders. Remarks on cells that are not numbers.
    """
    import pandas as pd

    if pd.api.types.is_numeric_dtype(cells.dtype):
        # int64 stamps in ns exceed the 53 bits of a float
        return cells.to_numpy(dtype=None if cells.dtype.kind in "iu" else np.float64), []
    if _is_sender_column(column):
        return None, []
    numeric_values = pd.to_numeric(cells.astype("string"), errors="coerce").to_numpy(
        dtype=np.float64, na_value=np.nan
    )
    is_filled = cells.notna().to_numpy()
    is_not_number = is_filled & np.isnan(numeric_values)
    n_not_numbers = int(is_not_number.sum())
    if 2 * n_not_numbers >= int(is_filled.sum()):
        example = str(cells[is_not_number].iloc[0])
        content_description = "structures" if example.startswith(("{", "[", "(")) else "text"
        text = (
            f"topic {topic}: column '{column}' contains {content_description}"
            f" ('{truncate(example, 40)}'), not numbers; it is left out"
        )
        return None, [make_remark("note", "not_numbers", text, rows=float(len(cells)))]
    if not n_not_numbers:
        return numeric_values, []
    text = (
        f"topic {topic}: column '{column}' has {n_not_numbers} cells that are not numbers; missing"
    )
    return numeric_values, [make_remark("will mislead", "not_numbers", text, cells=n_not_numbers)]


def _demultiplex(fields: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Split multiplexed columns, whose rows belong to the actuator in an index column.

    Args:
        fields: field -> values [T].

    Returns:
        `value[0]`, `value[1]`, ... with zero-order hold, NaN before the first row of an actuator;
        the unchanged fields if no index column alternates.
    """
    for name, index_values in fields.items():
        indices = np.unique(index_values)
        is_alternating = (
            index_values.size > 1 and float((np.diff(index_values) != 0.0).mean()) > 0.5
        )
        if (
            parse_name(name).has_all("index")
            and 1 < indices.size <= _MAX_MULTIPLEXED
            and is_alternating
        ):
            rows = np.arange(index_values.size)
            last_rows = {
                index_value: np.maximum.accumulate(np.where(index_values == index_value, rows, -1))
                for index_value in indices
            }
            return {
                f"{other_name}[{index_value:g}]": np.where(
                    source_rows < 0, np.nan, values[source_rows]
                )
                for other_name, values in fields.items()
                if other_name != name
                for index_value, source_rows in last_rows.items()
            }
    return fields

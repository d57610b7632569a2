"""A folder that holds one csv file per topic, as tools export ROS bags."""

from __future__ import annotations

import contextlib
import csv
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal, final

import numpy as np
from pydantic import Field

from residnet.core.errors import DataError
from residnet.core.names import shown
from residnet.data.drafting.words import state_channel, words_of
from residnet.data.readers.base import LARGE, progress, require_file, total_size
from residnet.data.readers.compose import RecordingConfig
from residnet.data.readers.joined import partners
from residnet.data.readers.recording import (
    EVERYTHING,
    Recording,
    Remark,
    Series,
    Wanted,
    key_of,
    remark,
)
from residnet.data.readers.texts import as_utf8, encoding_of_head
from residnet.data.readers.written import (
    Stamps,
    parse_numbers,
    parse_texts,
    unit_of_steps,
    unix_unit,
    whole_second,
)

if TYPE_CHECKING:
    import pandas as pd

_ENDINGS = (".csv", ".tsv", ".txt")
_ARRIVAL = ("time", "Time", "t", "timestamp", "rosbagTimestamp", "%time", "stamp", "date")
_CLOCK = re.compile(r"(?:time|timestamp)s?\s*[\[(]", re.IGNORECASE)
"""A time whose unit stands behind it."""
_MOST = 16
"""Most actuators whose values stand in one column, told apart by another one."""
_TOGETHER = 60.0
"""Seconds within which the topics of a recording begin, those too that come once a minute."""
# last parts of the names of a header stamp's two columns, in ROS 1 and ROS 2
_SECONDS, _NANOSECONDS = ("secs", "sec"), ("nsecs", "nanosec")


def is_topic_folder(path: Path) -> bool:
    """Return whether a folder's csv files are topics of one recording, and not logs.

    Topics have stamped headers, or headers that differ, and times of one kind; the parts of several
    trips are no topics.
    """
    if not path.is_dir():
        return False
    heads: dict[Path, list[str]] = {}
    begins: dict[Path, float] = {}
    for file in _files(path)[:200]:
        names, *row = _cells(file)[:2]
        if names != [""]:
            heads[file] = names
        clock = _clock_of(names, _ARRIVAL)
        for name, cell in zip(names, *row, strict=False) if row else ():
            if name == clock:
                with contextlib.suppress(ValueError):
                    begins[file] = float(cell)
    if any(_stamp_columns(head) is not None for head in heads.values()):
        return True
    trips = partners({file: tuple(head) for file, head in heads.items()})
    units = {unix_unit(np.array([begin])) for begin in begins.values()}
    if any(len(files) > 1 for files in trips.values()) or len(units) > 1:
        return False
    # a clock of any other name tells a log too: dates that begin together are of one recording
    dated = units == {"s"} and np.ptp([*begins.values()]) < _TOGETHER
    timed = [
        head
        for head in heads.values()
        if (clock := _clock_of(head, _ARRIVAL)) in _ARRIVAL or (clock is not None and dated)
    ]
    apart = len(timed) > 1 and 2 * len(timed) > len(heads) and len(set(map(tuple, timed))) > 1
    return apart and sum(_is_whole_log(head) for head in timed) < 2


def _files(folder: Path) -> list[Path]:
    found = sorted(folder.rglob("*"))
    return [file for file in found if file.suffix.lower() in _ENDINGS and file.is_file()]


def _is_whole_log(columns: list[str]) -> bool:
    """Return whether a header names the motion of a vessel, as a log by itself does."""
    named = {state_channel(words_of(column)) for column in columns}
    whole = ({"x", "y", "psi"}, {"latitude", "longitude", "psi"}, {"u", "v", "r"})
    return any(each <= named for each in whole)


@final
class TopicFolderConfig(RecordingConfig):
    """A folder of csv files, one per topic, each with its own clock; or one such csv file.

    A topic is named by its path below the folder, without the ending.

    Attributes:
        time: columns that may hold the arrival time, in order; every file is searched for them.
        delimiter: between cells.
    """

    kind: Literal["csv_topics"] = "csv_topics"
    time: tuple[str, ...] = Field(default=_ARRIVAL, min_length=1)
    delimiter: str = Field(default=",", min_length=1, max_length=1)
    formats: ClassVar = {"folder of csv files": lambda path, head: is_topic_folder(path)}

    def load(self, path: Path, wanted: Wanted = EVERYTHING) -> Recording:
        """Read the wanted topics of a folder.

        Unwanted topics of a small folder are read too, so that what is wrong with them is reported.

        Raises:
            UsageError: where there is nothing at `path`.
            DataError: where it holds no csv file, or none of them has a time.
        """
        if not path.is_dir():
            require_file(path)
        files, root = (_files(path), path) if path.is_dir() else ([path], path.parent)
        if not files:
            raise DataError(f"{path}: holds no csv file")
        size, done = total_size(files), 0
        topics: dict[str, _Topic] = {}
        remarks: list[Remark] = []
        listed: list[str] = []
        # what is wrong with other topics too is worth a look where that costs little
        take = EVERYTHING if size < LARGE else wanted
        called = [file.relative_to(root).with_suffix("").as_posix() for file in files]
        called = _without_what_says_nothing(called)
        # ulog2csv begins each name with that of the recording
        own = f"{root.name}_"
        own = own if all(name.startswith(own) for name in called) else ""
        steps = [step for file in files if (step := _step_of(file, self.time))]
        unit = unit_of_steps(min(steps, default=0.0))
        with progress(path.name, size, size) as advance:
            for file, name in zip(files, (one.removeprefix(own) for one in called), strict=True):
                if not take(name):
                    listed.append(name)
                    continue
                with as_utf8(file) as text:
                    found = self._topic(text, name, take, unit)
                if isinstance(found, _Topic):
                    topics[name] = found
                else:
                    remarks.append(found)
                done += file.stat().st_size
                advance(done)
        if not topics:
            raise DataError(
                f"{path}: none of {len(files)} csv files holds a topic ({remarks[0]['text']})"
            )
        epoch = whole_second([stamps for topic in topics.values() for stamps in topic.stamps])
        series = {name: topic.series(name, epoch) for name, topic in topics.items()}
        return Recording(path, series, epoch, tuple(files), tuple(remarks), tuple(listed))

    def _topic(self, file: Path, name: str, wanted: Wanted, unit: str) -> _Topic | Remark:
        """Return one topic; a remark where the file holds none."""
        import pandas as pd

        sep = "\t" if file.suffix.lower() == ".tsv" else self.delimiter
        if not file.stat().st_size:
            return remark("note", "empty_topic", f"topic {name}: the file is empty")
        try:
            with file.open(newline="", encoding="utf-8-sig") as stream:
                header = [cell.strip() for cell in next(csv.reader(stream, delimiter=sep), [])]
            clock = _clock_of(header, self.time)
            stamp = _stamp_columns(header)
            if clock is None and stamp is None:
                text = (
                    f"topic {name}: no column for time (looked for {', '.join(self.time)} and a"
                    " header stamp); the file is left out"
                )
                return remark("note", "no_time", text)
            always = {clock, *(stamp or ())}
            kept = [
                i
                for i, column in enumerate(header)
                if column in always
                or _names_sender(column)
                or words_of(column).has("index")
                or wanted.field(name, column)
            ]
            table = pd.read_csv(
                file,
                sep=sep,
                header=None,
                skiprows=1,
                names=list(range(len(header))),
                usecols=kept,
                index_col=False,
                dtype={header.index(clock): str} if clock is not None else {},
                encoding="utf-8-sig",
                low_memory=False,
            )
            if table.empty:
                raise pd.errors.EmptyDataError
            columns = {header[i]: table[i] for i in kept}
            return _Topic(name, columns, (clock, unit), stamp)
        except pd.errors.EmptyDataError:
            text = f"topic {name}: the file has a header and no rows"
            return remark("note", "empty_topic", text)
        except (UnicodeDecodeError, csv.Error, pd.errors.ParserError) as error:
            reason = " ".join(str(error).split())
            text = f"topic {name}: not a regular UTF-8 table ({reason}); left out"
            return remark("will mislead", "unreadable", text)
        except DataError as error:
            text = f"topic {name}: {error}; the file is left out"
            return remark("will mislead", "no_time", text)


def _without_what_says_nothing(called: list[str]) -> list[str]:
    """Return topics without the folder that holds all of them, where its name tells of nothing."""
    folders = {name.partition("/")[0] for name in called if "/" in name}
    alone = len(folders) == 1 and all("/" in name for name in called)
    if not alone or words_of(*folders).about:
        return called
    return _without_what_says_nothing([name.partition("/")[2] for name in called])


def _cells(file: Path) -> list[list[str]]:
    """Return the cells of a topic's first lines, the last of which may be cut short."""
    with file.open("rb") as stream:
        head = stream.read(10_000)
    lines = (
        head.decode(encoding_of_head(head), errors="replace").removeprefix("\ufeff").splitlines()
    )
    return [[cell.strip() for cell in line.split(",")] for line in lines] or [[""]]


def _clock_of(header: Sequence[str], clocks: Sequence[str]) -> str | None:
    """Return the column of the arrival time: the first of the names given, else called a time."""
    called = (name for name in header if _CLOCK.match(name))
    return next((name for name in clocks if name in header), next(called, None))


def _step_of(file: Path, clocks: Sequence[str]) -> float:
    """Return the usual step of the first times of a topic, in its own unit; 0 for none."""
    names, *rows = _cells(file)[:-1] or [[""]]
    name = _clock_of(names, clocks)
    clock = len(names) if name is None else names.index(name)
    try:
        steps = np.diff([float(row[clock]) for row in rows if len(row) > clock])
    except ValueError:
        return 0.0
    return float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0


def _names_sender(column: str) -> bool:
    return key_of(column).endswith("frame_id")


def _stamp_columns(header: list[str]) -> tuple[str, str] | None:
    """Return the columns of a header stamp's seconds and nanoseconds."""
    keys = {key_of(column): column for column in header}
    for seconds, rest in zip(_SECONDS, _NANOSECONDS, strict=True):
        for prefix in ("header_stamp_", "stamp_"):
            if prefix + seconds in keys and prefix + rest in keys:
                return keys[prefix + seconds], keys[prefix + rest]
    return None


@final
class _Topic:
    """One csv as read: times as whole ns, fields as float64."""

    def __init__(
        self,
        name: str,
        columns: dict[str, pd.Series],
        time: tuple[str | None, str],
        stamp: tuple[str, str] | None,
    ) -> None:
        self._remarks: list[Remark] = []
        self._arrival: Stamps | None = None
        self._sender: np.ndarray | None = None
        clock, unit = time
        if clock is not None:
            try:
                self._arrival = parse_texts(columns[clock], unit=unit)
            except DataError:
                if len(columns[clock]) < 2:
                    raise
                columns = {column: cells.iloc[:-1] for column, cells in columns.items()}
                self._arrival = parse_texts(columns[clock], unit=unit)
                text = f"topic {name}: the last row is cut short; left out"
                self._remarks.append(remark("note", "cut_short", text, rows=1.0))
        whole = {}
        for column, cells in columns.items():
            if column != clock and (values := self._numbers(name, column, cells)) is not None:
                whole[column] = values
        self._stamp = None if stamp is None else _header_stamps(whole, stamp)
        self._fields = _told_apart(
            {
                column: values.astype(np.float64, copy=False)
                for column, values in whole.items()
                if column not in (stamp or ())
            }
        )

    @property
    def stamps(self) -> list[Stamps]:
        """The arrival and header stamps that there are."""
        return [stamps for stamps in (self._arrival, self._stamp) if stamps is not None]

    def series(self, name: str, epoch: int | None) -> Series:
        """Return the topic with times in s from the epoch."""
        stamp, arrival = (
            None if stamps is None else stamps.since(epoch)
            for stamps in (self._stamp, self._arrival)
        )
        said = [
            {**noted, "text": f"topic {name}: {noted['text']}"}
            for stamps in self.stamps
            for noted in stamps.remarks
        ]
        remarks = (*self._remarks, *said)
        return Series(name, "", self._fields, stamp, arrival, self._sender, remarks)

    def _numbers(self, name: str, column: str, cells: pd.Series) -> np.ndarray | None:
        """Return a column [T] as numbers; None where it is text, of which senders are kept."""
        import pandas as pd

        if pd.api.types.is_numeric_dtype(cells.dtype):
            # whole stamps keep every bit
            return cells.to_numpy(dtype=None if cells.dtype.kind in "iu" else np.float64)
        if _names_sender(column):
            # one object per name, not per row
            names = cells.fillna("").astype(str).astype("category")
            words = np.array(names.cat.categories, dtype=object)[names.cat.codes.to_numpy()]
            self._sender = words if self._sender is None else self._sender
            return None
        texts = cells.astype("string")
        numbers = pd.to_numeric(texts, errors="coerce").to_numpy(dtype=np.float64, na_value=np.nan)
        filled = cells.notna().to_numpy()
        odd = filled & np.isnan(numbers)
        spoilt = int(odd.sum())
        if 2 * spoilt < int(filled.sum()):
            if spoilt:
                text = (
                    f"topic {name}: column '{column}' holds {spoilt} cells that are not numbers;"
                    " they count as missing"
                )
                said = remark("will mislead", "not_numbers", text, cells=spoilt)
                self._remarks.append(said)
            return np.asarray(numbers)
        sample = str(cells[odd].iloc[0])
        kind = "structures" if sample.startswith(("{", "[", "(")) else "text"
        text = (
            f"topic {name}: column '{column}' holds {kind} ('{shown(sample, 40)}'), not numbers; it"
            " is left out"
        )
        self._remarks.append(remark("note", "not_numbers", text, rows=float(len(cells))))
        return None


def _told_apart(fields: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return `value[0]` and `value[1]` of values [T] in turns, where a column numbers them.

    Each holds in the rows of the others, and is NaN before its first.
    """
    for name, number in fields.items():
        known = np.unique(number)
        turns = number.size > 1 and float((np.diff(number) != 0.0).mean()) > 0.5
        if words_of(name).has("index") and 1 < known.size <= _MOST and turns:
            rows = np.arange(number.size)
            last = {one: np.maximum.accumulate(np.where(number == one, rows, -1)) for one in known}
            return {
                f"{other}[{one:g}]": np.where(at < 0, np.nan, values[at])
                for other, values in fields.items()
                if other != name
                for one, at in last.items()
            }
    return fields


def _header_stamps(numbers: dict[str, np.ndarray], columns: tuple[str, str]) -> Stamps | None:
    """Return a header stamp from its two columns; None where it is empty."""
    if any(column not in numbers for column in columns):
        return None
    seconds, rest = (numbers[column] for column in columns)
    if not np.isfinite(seconds).all() or not np.isfinite(rest).all() or not seconds.any():
        return None
    ns = seconds.astype(np.int64) * 10**9 + rest.astype(np.int64)
    return Stamps(ns, parse_numbers(seconds.astype(np.float64)).absolute)

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
    Level,
    Recording,
    Remark,
    Rows,
    Stamps,
    Wanted,
    key_of,
    recording_of,
    remark,
)
from residnet.data.readers.texts import as_utf8, encoding_of_head
from residnet.data.readers.written import (
    parse_numbers,
    parse_texts,
    unit_of_steps,
    unix_unit,
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
        cells = dict(zip(names, row[0], strict=False)) if row else {}
        with contextlib.suppress(ValueError):
            begins[file] = float(cells.get(_clock_of(names, _ARRIVAL) or "", ""))
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
        """
        if not path.is_dir():
            require_file(path)
        files, root = (_files(path), path) if path.is_dir() else ([path], path.parent)
        if not files:
            raise DataError(f"{path}: holds no csv file")
        size, done = total_size(files), 0
        topics: dict[str, Rows] = {}
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
                if isinstance(found, Rows):
                    topics[name] = found
                else:
                    remarks.append(found)
                done += file.stat().st_size
                advance(done)
        if not topics:
            raise DataError(
                f"{path}: none of {len(files)} csv files holds a topic ({remarks[0]['text']})"
            )
        return recording_of(path, topics, tuple(files), remarks, listed)

    def _topic(self, file: Path, name: str, wanted: Wanted, unit: str) -> Rows | Remark:
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
            return _rows(name, columns, clock, unit, stamp)
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


def _rows(
    name: str,
    columns: dict[str, pd.Series],
    clock: str | None,
    unit: str,
    stamp: tuple[str, str] | None,
) -> Rows:
    """Return one topic: times as whole ns, fields as float64, text left out but for senders."""
    import pandas as pd

    arrival = sender = stamped = None
    remarks: list[Remark] = []

    def note(level: Level, code: str, text: str, **figures: float) -> None:
        remarks.append(remark(level, code, f"topic {name}: {text}", **figures))

    if clock is not None:
        try:
            arrival = parse_texts(columns[clock], unit=unit)
        except DataError:
            if len(columns[clock]) < 2:
                raise
            columns = {column: cells.iloc[:-1] for column, cells in columns.items()}
            arrival = parse_texts(columns[clock], unit=unit)
            note("note", "cut_short", "the last row is cut short; left out", rows=1.0)
    whole: dict[str, np.ndarray] = {}
    for column, cells in columns.items():
        if column == clock:
            continue
        if pd.api.types.is_numeric_dtype(cells.dtype):
            # whole stamps keep every bit
            whole[column] = cells.to_numpy(dtype=None if cells.dtype.kind in "iu" else np.float64)
            continue
        if _names_sender(column):
            if sender is None:
                # one object per name, not per row
                names = cells.fillna("").astype(str).astype("category")
                sender = np.array(names.cat.categories, dtype=object)[names.cat.codes.to_numpy()]
            continue
        texts = cells.astype("string")
        numbers = pd.to_numeric(texts, errors="coerce").to_numpy(dtype=np.float64, na_value=np.nan)
        filled = cells.notna().to_numpy()
        odd = filled & np.isnan(numbers)
        spoilt = int(odd.sum())
        if 2 * spoilt >= int(filled.sum()):
            sample = str(cells[odd].iloc[0])
            kind = "structures" if sample.startswith(("{", "[", "(")) else "text"
            text = f"column '{column}' holds {kind} ('{shown(sample, 40)}'), not numbers; it is"
            note("note", "not_numbers", f"{text} left out", rows=float(len(cells)))
            continue
        whole[column] = numbers
        if spoilt:
            text = f"column '{column}' holds {spoilt} cells that are not numbers; they count as"
            note("will mislead", "not_numbers", f"{text} missing", cells=spoilt)
    if stamp is not None and {*stamp} <= whole.keys():
        seconds, rest = (whole[column] for column in stamp)
        if np.isfinite(seconds).all() and np.isfinite(rest).all() and seconds.any():
            ns = seconds.astype(np.int64) * 10**9 + rest.astype(np.int64)
            stamped = Stamps(ns, parse_numbers(seconds.astype(np.float64)).absolute)
    fields = {
        n: v.astype(np.float64, copy=False) for n, v in whole.items() if n not in (stamp or ())
    }
    for stamps in (arrival, stamped):
        for one in () if stamps is None else stamps.remarks:
            remarks.append({**one, "text": f"topic {name}: {one['text']}"})
    return Rows("", _told_apart(fields), stamped, arrival, sender, tuple(remarks))


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

"""Reader of a folder that holds one csv file per topic, as tools export ROS bags."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Literal, final

import numpy as np
from pydantic import Field

from residnet.core.errors import DataError
from residnet.data.drafting.words import state_channel, words_of
from residnet.data.readers.base import require_file
from residnet.data.readers.composing.composed import RecordingConfig
from residnet.data.readers.composing.wanted import EVERYTHING, Wanted
from residnet.data.readers.encoding import as_utf8, encoding_of_head
from residnet.data.readers.files import progress, total_size
from residnet.data.readers.recording import Recording, Remark, Series, key_of, remark
from residnet.data.readers.spool import LARGE
from residnet.data.readers.stamps import Stamps, parse_numbers
from residnet.data.readers.tables.cells import NANOSECONDS, SECONDS, Cells, names_sender

_ENDINGS = (".csv", ".tsv", ".txt")
_ARRIVAL = ("time", "Time", "t", "timestamp", "rosbagTimestamp", "%time", "stamp", "date")
_CHUNK = 200_000


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

    def load(self, path: Path, wanted: Wanted) -> Recording:
        """Read the wanted topics of a folder.

        Unwanted topics of a small folder are read too, so that what is wrong with them is reported.
        """
        return load_folder(path, wanted, self.time, self.delimiter)


def load_folder(
    path: Path, wanted: Wanted = EVERYTHING, time: tuple[str, ...] = _ARRIVAL, delimiter: str = ","
) -> Recording:
    """Return the recording in a folder of csv files, or in one such file.

    Raises:
        UsageError: where there is nothing at `path`.
        DataError: where it holds no csv file, or none of them has a time.
    """
    if path.is_file():
        files, root = [path], path.parent
    elif path.is_dir():
        files, root = (
            sorted(
                file
                for file in path.rglob("*")
                if file.suffix.lower() in _ENDINGS and file.is_file()
            ),
            path,
        )
    else:
        require_file(path)
    if not files:
        raise DataError(f"{path}: holds no csv file")
    size = total_size(files)
    raw, remarks, listed, done = {}, [], [], 0
    # what is wrong with other topics too is worth a look where that costs little
    take = EVERYTHING if size < LARGE else wanted
    with progress(path.name, size, size) as advance:
        for file in files:
            name = file.relative_to(root).with_suffix("").as_posix()
            if not take(name):
                listed.append(name)
                continue
            with as_utf8(file) as text:
                table, said = _read(text, name, time, delimiter, take)
            remarks += said
            done += file.stat().st_size
            advance(done)
            if table is not None:
                raw[name] = table
    if not raw:
        raise DataError(
            f"{path}: none of {len(files)} csv files holds a topic ({remarks[0]['text']})"
        )
    dated = [
        stamps
        for table in raw.values()
        for stamps in (table.arrival, table.stamp)
        if stamps is not None and stamps.absolute
    ]
    epoch = min((int(stamps.ns.min()) for stamps in dated), default=None)
    whole = None if epoch is None else epoch // 10**9 * 10**9
    return Recording(
        path,
        {name: table.series(name, whole) for name, table in raw.items()},
        whole,
        tuple(files),
        tuple(remarks),
        tuple(listed),
    )


def is_topic_folder(path: Path) -> bool:
    """Return whether a folder's csv files are topics of one recording, and not logs.

    Topics have stamped headers, or headers that differ.
    """
    if not path.is_dir():
        return False
    heads = []
    for file in sorted(
        file for file in path.rglob("*") if file.suffix.lower() in _ENDINGS and file.is_file()
    )[:200]:
        with file.open("rb") as stream:
            head = stream.read(10_000)
        lines = head.decode(encoding_of_head(head), errors="replace").splitlines()
        heads.append(lines[0].removeprefix("\ufeff").strip() if lines else "")
    full = [head for head in heads if head]
    stamped = any(_stamp_columns(head.split(",")) is not None for head in full)
    timed = [head for head in full if set(head.split(",")) & set(_ARRIVAL)]
    apart = len(timed) > 1 and 2 * len(timed) > len(full) and len(set(timed)) > 1
    return stamped or (apart and sum(_is_whole_log(head) for head in timed) < 2)


def _is_whole_log(head: str) -> bool:
    """Return whether a header names position and heading, as a log by itself does."""
    named = {state_channel(words_of(column)) for column in head.split(",")}
    return {"x", "y", "psi"} <= named or {"latitude", "longitude", "psi"} <= named


@final
class _Table:
    """One csv as read: times as whole ns, fields as float64."""

    def __init__(
        self,
        arrival: Stamps | None,
        stamp: Stamps | None,
        fields: dict[str, np.ndarray],
        sender: np.ndarray | None,
        remarks: list[Remark],
    ) -> None:
        self.arrival, self.stamp, self.fields, self.sender, self.remarks = (
            arrival,
            stamp,
            fields,
            sender,
            remarks,
        )

    def series(self, name: str, epoch: int | None) -> Series:
        """Return the table as a series with times in s from the epoch."""

        def seconds(stamps: Stamps | None) -> np.ndarray | None:
            if stamps is None:
                return None
            return (stamps.ns - (epoch if stamps.absolute and epoch is not None else 0)) * 1e-9

        remarks = [*self.remarks]
        for stamps in (self.arrival, self.stamp):
            remarks += [
                {**noted, "text": f"topic {name}: {noted['text']}"}
                for noted in (stamps.remarks if stamps is not None else ())
            ]
        return Series(
            name,
            "",
            self.fields,
            seconds(self.stamp),
            seconds(self.arrival),
            self.sender,
            tuple(remarks),
        )


def _read(
    file: Path, name: str, time: tuple[str, ...], delimiter: str, wanted: Wanted
) -> tuple[_Table | None, list[Remark]]:
    """Return one topic; None and a remark where the file holds none."""
    import pandas as pd

    if not file.stat().st_size:
        return None, [remark("note", "empty_topic", f"topic {name}: the file is empty")]
    sep = "\t" if file.suffix.lower() == ".tsv" else delimiter
    try:
        with file.open(newline="", encoding="utf-8-sig") as stream:
            header = [cell.strip() for cell in next(csv.reader(stream, delimiter=sep), [])]
        clock = next((column for column in time if column in header), None)
        stamp = _stamp_columns(header)
        if clock is None and stamp is None:
            text = (
                f"topic {name}: no column for time (looked for {', '.join(time)} and a header"
                " stamp); the file is left out"
            )
            return None, [remark("note", "no_time", text)]
        columns = _columns(
            file,
            header,
            sep,
            clock,
            lambda column: (
                column in (stamp or ()) or names_sender(column) or wanted.field(name, column)
            ),
        )
    except (UnicodeDecodeError, csv.Error, pd.errors.ParserError) as error:
        return None, [
            remark(
                "will mislead",
                "unreadable",
                f"topic {name}: not a regular UTF-8 table ({' '.join(str(error).split())});"
                " left out",
            )
        ]
    except DataError as error:
        return None, [
            remark("will mislead", "no_time", f"topic {name}: {error}; the file is left out")
        ]
    if not any(one.rows for one in columns.values()):
        return None, [
            remark("note", "empty_topic", f"topic {name}: the file has a header and no rows")
        ]
    return _table(name, columns, clock, stamp), []


def _columns(
    file: Path, header: list[str], sep: str, clock: str | None, wanted: Callable[[str], bool]
) -> dict[str, Cells]:
    """Return the columns of a file that are wanted, and its time, chunk by chunk.

    Raises:
        DataError: where a cell of the time column is no time.
    """
    import pandas as pd

    kept = {
        i: Cells(column, is_time=column == clock)
        for i, column in enumerate(header)
        if column == clock or wanted(column)
    }
    chunks = pd.read_csv(
        file,
        sep=sep,
        header=None,
        skiprows=1,
        names=list(range(len(header))),
        usecols=list(kept),
        index_col=False,
        dtype={header.index(clock): str} if clock is not None else {},
        encoding="utf-8-sig",
        chunksize=_CHUNK,
    )
    for chunk in chunks:
        for i, one in kept.items():
            one.add(chunk[i])
    return {one.name: one for one in kept.values()}


def _table(
    name: str, columns: dict[str, Cells], clock: str | None, stamp: tuple[str, str] | None
) -> _Table:
    """Return the times and fields from the columns of a file."""
    arrival = None if clock is None else columns[clock].times()
    rows = None if arrival is None else len(arrival.ns)
    numbers = {column: cells.numbers()[:rows] for column, cells in columns.items() if cells.numeric}
    stamped = None if stamp is None else _stamps(numbers, stamp)
    sender = next(
        (
            cells.words()[:rows]
            for column, cells in columns.items()
            if not cells.numeric and names_sender(column)
        ),
        None,
    )
    remarks = [
        cells.remark(name)
        for column, cells in columns.items()
        if not cells.numeric and not names_sender(column) and column != clock
    ]
    if clock is not None and columns[clock].cut:
        remarks.append(
            remark(
                "note", "cut_short", f"topic {name}: the last row is cut short; left out", rows=1.0
            )
        )
    for column, cells in columns.items():
        if cells.numeric and cells.spoilt:
            text = (
                f"topic {name}: column '{column}' holds {cells.spoilt} cells that are not numbers;"
                " they count as missing"
            )
            remarks.append(remark("will mislead", "not_numbers", text, cells=cells.spoilt))
    taken = {*(stamp or ()), clock}
    return _Table(
        arrival,
        stamped,
        {column: values for column, values in numbers.items() if column not in taken},
        sender,
        remarks,
    )


def _stamp_columns(header: list[str]) -> tuple[str, str] | None:
    """Return the columns of a header stamp's seconds and nanoseconds."""
    keys = {key_of(column): column for column in header}
    for seconds, rest in zip(SECONDS, NANOSECONDS, strict=True):
        for prefix in ("header_stamp_", "stamp_"):
            if prefix + seconds in keys and prefix + rest in keys:
                return keys[prefix + seconds], keys[prefix + rest]
    return None


def _stamps(numbers: dict[str, np.ndarray], columns: tuple[str, str]) -> Stamps | None:
    """Return a header stamp from its two columns; None where it is empty."""
    if any(column not in numbers for column in columns):
        return None
    seconds, rest = (numbers[column] for column in columns)
    if not np.isfinite(seconds).all() or not np.isfinite(rest).all() or not seconds.any():
        return None
    ns = seconds.astype(np.int64) * 10**9 + rest.astype(np.int64)
    dated = parse_numbers(seconds.astype(np.float64)).absolute
    return Stamps(ns, dated, dated)

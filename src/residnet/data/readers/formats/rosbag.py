"""ROS 1 bags, ROS 2 bags (SQLite, MCAP) and MCAP files, through rosbags; no ROS is needed."""

from __future__ import annotations

import dataclasses
from array import array
from collections.abc import Callable, Iterator
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, final

import numpy as np

from residnet.core.errors import UsageError
from residnet.data.readers.base import (
    REPORT_EVERY,
    files_of,
    package,
    progress,
    readable,
    require_file,
    total_size,
)
from residnet.data.readers.compose import RecordingConfig
from residnet.data.readers.recording import (
    EVERYTHING,
    Columns,
    Recording,
    Remark,
    Rows,
    Stamps,
    Wanted,
    recording_of,
    remark,
)

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection

# arrays of more elements are pictures, clouds and 6 x 6 covariances, no channels
_ELEMENTS = 16


@final
class RosbagConfig(RecordingConfig):
    """A ROS 1 bag, a ROS 2 bag (a folder with metadata.yaml), or an .mcap or .db3 file."""

    kind: Literal["rosbag"] = "rosbag"
    endings: ClassVar = (".mcap", ".db3", ".bag")
    formats: ClassVar = {
        "ROS 2 bag": lambda path, head: path.is_dir() and (path / "metadata.yaml").is_file(),
        "ROS 1 bag": lambda path, head: head.startswith(b"#ROSBAG"),
        "MCAP": lambda path, head: head.startswith(b"\x89MCAP0\r\n"),
        "ROS 2 bag (SQLite)": lambda path, head: (
            head.startswith(b"SQLite format 3\x00") and path.suffix == ".db3"
        ),
    }

    def load(self, path: Path, wanted: Wanted = EVERYTHING) -> Recording:
        """Read the wanted topics of a bag, message by message.

        Memory grows with the numbers kept, not with the file.
        """
        with package("ros", "rosbags", "a ROS bag or MCAP file"):
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        if not path.is_dir():
            require_file(path)
        elif not (path / "metadata.yaml").is_file():
            raise UsageError(f"{path}: is a folder without metadata.yaml, a ROS 2 bag has one")
        store = None if path.suffix == ".bag" else get_typestore(Stores.LATEST)
        # a damaged bag fails in many ways inside rosbags and SQLite, no fault of residnet
        with readable(path, "a bag"), AnyReader([path], default_typestore=store) as reader:
            return _read(path, reader, wanted)


def _read(path: Path, reader: AnyReader, wanted: Wanted) -> Recording:
    chosen = [one for one in reader.connections if wanted(one.topic)]
    topics = [one.topic for one in chosen]
    not_wanted = tuple(sorted({one.topic for one in reader.connections} - set(topics)))
    if not chosen:
        raise UsageError(
            f"{path}: none of its topics is wanted (it holds {', '.join(not_wanted) or 'none'})"
        )
    columns: dict[str, _Messages] = {}
    failed: dict[str, str] = {}
    files = tuple(files_of(path))
    start, span = reader.start_time, max(1, reader.end_time - reader.start_time)
    with progress(path.name, total_size(files), 1.0) as advance:
        for count, (connection, arrival, raw) in enumerate(reader.messages(connections=chosen)):
            if count % REPORT_EVERY == 0:
                advance((arrival - start) / span)
            name, kind = connection.topic, connection.msgtype
            if name in failed:
                continue
            try:
                message = reader.deserialize(raw, kind)
                if name not in columns:
                    shared = topics.count(name) > 1
                    columns[name] = _Messages(name, kind, message, wanted, shared=shared)
                columns[name].add(message, arrival, connection)
            except Exception as error:
                failed[name] = f"{type(error).__name__}: {' '.join(str(error).split())[:120]}"
    remarks: list[Remark] = []
    for name, why in failed.items():
        unread = columns.pop(name, None)
        rows = len(unread.columns.ns) if unread else 0
        text = f"topic {name}: message {rows + 1} cannot be read ({why}); the topic is left out"
        remarks.append(remark("will mislead", "unreadable", text, rows=rows))
    for name in sorted(set(topics) - set(columns) - set(failed)):
        remarks.append(remark("note", "empty_topic", f"topic {name}: holds no messages"))
    found = {name: one.rows() for name, one in sorted(columns.items())}
    return recording_of(path, found, files, remarks, not_wanted)


@final
class _Messages:
    """Messages of one topic as they come: times as whole ns, numbers row by row."""

    def __init__(self, name: str, kind: str, first: Any, wanted: Wanted, *, shared: bool) -> None:
        self._name, self._kind, self._shared = name, kind, shared
        self._leaves = _Leaves(first, lambda path: wanted.field(name, path))
        self.columns = Columns(self._leaves.names)
        self._stamp, self._sender = array("q"), array("H")
        self._senders: dict[str, int] = {}

    def add(self, message: Any, arrival: int, connection: Connection) -> None:
        """Append one message."""
        numbers, header = self._leaves.numbers(message), getattr(message, "header", None)
        stamp = getattr(header, "stamp", None)
        self._stamp.append(0 if stamp is None else stamp.sec * 10**9 + stamp.nanosec)
        sender = getattr(header, "frame_id", "")
        if self._shared:
            sender = getattr(connection.ext, "callerid", None) or f"connection {connection.id}"
        self._sender.append(self._senders.setdefault(sender, len(self._senders)))
        self.columns.add(arrival, numbers)

    def rows(self) -> Rows:
        """Return the topic."""
        stamps = np.frombuffer(self._stamp, dtype=np.int64)
        sender = None
        if len(self._senders) > 1 or next(iter(self._senders), ""):
            callers = np.array(list(self._senders), dtype=object)
            sender = callers[np.frombuffer(self._sender, dtype=np.uint16)]
        remarks: tuple[Remark, ...] = ()
        empty = int((stamps == 0).sum())
        if 0 < empty < stamps.size:
            text = (
                f"topic {self._name}: {empty} of {stamps.size} header stamps are zero; arrival"
                " times are used"
            )
            remarks = (remark("will mislead", "empty_stamps", text, rows=empty),)
        stamp = None if empty else Stamps(stamps, True)
        arrival = Stamps(self.columns.times, True)
        return Rows(self._kind, self.columns.fields, stamp, arrival, sender, remarks)


@final
class _Leaves:
    """The numbers in a message, by their paths; the first message of a topic decides."""

    def __init__(self, message: Any, wanted: Callable[[str], bool]) -> None:
        scalars: list[str] = []
        arrays: list[tuple[str, int]] = []
        for path, value in _walk(message, ""):
            if isinstance(value, np.ndarray):
                if value.dtype.kind in "biuf" and 0 < value.size <= _ELEMENTS:
                    arrays.append((path, value.size))
            elif isinstance(value, int | float | bool) and wanted(path):
                scalars.append(path)
        joints = list(message.name) if type(message).__name__.endswith("JointState") else []

        def element(path: str, i: int) -> str:
            named = path in ("position", "velocity", "effort") and i < len(joints)
            return str(joints[i]) if named else str(i)

        counted = [f"{path}.{element(path, i)}" for path, size in arrays for i in range(size)]
        self.names = [*scalars, *counted]
        self._scalars: Callable[[Any], Any] | None = attrgetter(*scalars) if scalars else None
        self._single = len(scalars) == 1
        self._arrays = [(attrgetter(path), size) for path, size in arrays]

    def numbers(self, message: Any) -> list[float]:
        """Return the numbers of a message, in the order of the paths."""
        out: list[float] = []
        if self._scalars is not None:
            out = [self._scalars(message)] if self._single else list(self._scalars(message))
        for getter, size in self._arrays:
            values = getter(message).tolist()
            out += values if len(values) == size else [*values, *[np.nan] * size][:size]
        return out


def _walk(message: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    """Return the paths and values of a message's leaves, the stamp aside."""
    for entry in dataclasses.fields(message):
        if entry.name == "__msgtype__" or (not prefix and entry.name == "header"):
            continue
        value = getattr(message, entry.name)
        if dataclasses.is_dataclass(value):
            yield from _walk(value, f"{prefix}{entry.name}.")
        else:
            yield prefix + entry.name, value

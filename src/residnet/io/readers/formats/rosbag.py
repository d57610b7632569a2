"""Reader of ROS 1 bags, ROS 2 bags (SQLite, MCAP) and MCAP files with rosbags, without ROS."""

from __future__ import annotations

import dataclasses
from array import array
from collections.abc import Callable, Iterator
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, final

import numpy as np

from residnet.core.errors import UsageError
from residnet.core.log import Remark, make_remark
from residnet.io.readers.base import (
    REPORT_INTERVAL,
    list_files,
    optional_import,
    reading_progress,
    require_file,
    sum_file_sizes,
    wrap_read_errors,
)
from residnet.io.readers.compose import RecordingConfig
from residnet.io.readers.recording import (
    ALL_FIELDS,
    FieldFilter,
    MessageBuffer,
    RawSeries,
    Recording,
    TimeStamps,
    build_recording,
)

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection

# longer arrays are images, point clouds and 6 x 6 covariances, not channels
_MAX_ARRAY_SIZE = 16


@final
class RosbagConfig(RecordingConfig):
    """Reader of a ROS 1 bag, a ROS 2 bag (folder with metadata.yaml), or an .mcap or .db3 file."""

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

    def load(self, path: Path, field_filter: FieldFilter = ALL_FIELDS) -> Recording:
        """Read topics of a bag message by message.

        Memory depends on the number of loaded values, not on the size of the file.
        """
        with optional_import("ros", "rosbags", "a ROS bag or MCAP file"):
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        if not path.is_dir():
            require_file(path)
        elif not (path / "metadata.yaml").is_file():
            raise UsageError(
                f"{path}: is a folder without metadata.yaml, a ROS 2 bag was expected; give the"
                " folder of the bag"
            )
        store = None if path.suffix == ".bag" else get_typestore(Stores.LATEST)
        # on a damaged bag rosbags and SQLite raise many types of exceptions
        with wrap_read_errors(path, "a bag"), AnyReader([path], default_typestore=store) as reader:
            return _read_bag(path, reader, field_filter)


def _read_bag(path: Path, reader: AnyReader, field_filter: FieldFilter) -> Recording:
    """Read the accepted topics of an open bag; topics that fail to decode become remarks."""
    selected = [
        bag_connection
        for bag_connection in reader.connections
        if field_filter(bag_connection.topic)
    ]
    topics = [bag_connection.topic for bag_connection in selected]
    unread_topics = tuple(
        sorted({bag_connection.topic for bag_connection in reader.connections} - set(topics))
    )
    if not selected:
        raise UsageError(
            f"{path}: has none of the configured topics (it contains"
            f" {', '.join(unread_topics) or 'none'})"
        )
    columns: dict[str, _TopicBuffer] = {}
    errors: dict[str, str] = {}
    files = tuple(list_files(path))
    start_ns = reader.start_time
    duration_ns = max(1, reader.end_time - reader.start_time)
    with reading_progress(path.name, sum_file_sizes(files), 1.0) as advance:
        for count, (connection, arrival, raw) in enumerate(reader.messages(connections=selected)):
            if count % REPORT_INTERVAL == 0:
                advance((arrival - start_ns) / duration_ns)
            name = connection.topic
            message_type = connection.msgtype
            if name in errors:
                continue
            try:
                message = reader.deserialize(raw, message_type)
                if name not in columns:
                    has_several_connections = topics.count(name) > 1
                    columns[name] = _TopicBuffer(
                        name,
                        message_type,
                        message,
                        field_filter,
                        has_several_connections=has_several_connections,
                    )
                columns[name].add(message, arrival, connection)
            except Exception as error:
                errors[name] = f"{type(error).__name__}: {' '.join(str(error).split())[:120]}"
    remarks: list[Remark] = []
    for name, reason in errors.items():
        failed_topic = columns.pop(name, None)
        rows = len(failed_topic.buffer.ns) if failed_topic else 0
        text = f"topic {name}: message {rows + 1} cannot be read ({reason}); the topic is left out"
        remarks.append(make_remark("will mislead", "unreadable", text, rows=rows))
    for name in sorted(set(topics) - set(columns) - set(errors)):
        remarks.append(make_remark("note", "empty_topic", f"topic {name}: has no messages"))
    raw_series = {
        name: bag_connection.to_raw_series() for name, bag_connection in sorted(columns.items())
    }
    return build_recording(path, raw_series, files, remarks, unread_topics)


@final
class _TopicBuffer:
    """Growing buffer of the messages of one topic: arrival and stamp in ns, sender, and numbers.

    Args:
        name: name of the topic.
        message_type: message type.
        first_message: message that determines the fields.
        field_filter: filter of fields.
        has_several_connections: whether several publishers share the topic; the sender is then the
            connection instead of the frame id.
    """

    def __init__(
        self,
        name: str,
        message_type: str,
        first_message: Any,
        field_filter: FieldFilter,
        *,
        has_several_connections: bool,
    ) -> None:
        self._name = name
        self._message_type = message_type
        self._has_several_connections = has_several_connections
        self._numeric_fields = _NumericFields(
            first_message, lambda path: field_filter.accepts_field(name, path)
        )
        self.buffer = MessageBuffer(self._numeric_fields.names)
        self._stamp = array("q")
        self._sender = array("H")
        self._senders: dict[str, int] = {}

    def add(self, message: Any, arrival: int, connection: Connection) -> None:
        """Append one message with its arrival in ns."""
        field_values = self._numeric_fields.extract_numbers(message)
        header = getattr(message, "header", None)
        stamp = getattr(header, "stamp", None)
        self._stamp.append(0 if stamp is None else stamp.sec * 10**9 + stamp.nanosec)
        sender = getattr(header, "frame_id", "")
        if self._has_several_connections:
            sender = getattr(connection.ext, "callerid", None) or f"connection {connection.id}"
        self._sender.append(self._senders.setdefault(sender, len(self._senders)))
        self.buffer.add(arrival, field_values)

    def to_raw_series(self) -> RawSeries:
        """Return the appended messages as arrays, with a remark if time stamps are missing."""
        stamps = np.frombuffer(self._stamp, dtype=np.int64)
        sender = None
        if len(self._senders) > 1 or next(iter(self._senders), ""):
            sender_names = np.array(list(self._senders), dtype=object)
            sender = sender_names[np.frombuffer(self._sender, dtype=np.uint16)]
        remarks: tuple[Remark, ...] = ()
        n_zero_stamps = int((stamps == 0).sum())
        if 0 < n_zero_stamps < stamps.size:
            text = (
                f"topic {self._name}: {n_zero_stamps} of {stamps.size} header stamps are zero;"
                " arrival times are used"
            )
            remarks = (make_remark("will mislead", "empty_stamps", text, rows=n_zero_stamps),)
        stamp = None if n_zero_stamps else TimeStamps(stamps, True)
        arrival = TimeStamps(self.buffer.times, True)
        return RawSeries(self._message_type, self.buffer.fields, stamp, arrival, sender, remarks)


@final
class _NumericFields:
    """Numeric fields of a message type.

    Args:
        message: message that determines the lengths of arrays.
        accepts_field: filter of paths.
    """

    def __init__(self, message: Any, accepts_field: Callable[[str], bool]) -> None:
        scalars: list[str] = []
        arrays: list[tuple[str, int]] = []
        for path, value in _iter_leaves(message, ""):
            if isinstance(value, np.ndarray):
                if value.dtype.kind in "biuf" and 0 < value.size <= _MAX_ARRAY_SIZE:
                    arrays.append((path, value.size))
            elif isinstance(value, int | float | bool) and accepts_field(path):
                scalars.append(path)
        joints = list(message.name) if type(message).__name__.endswith("JointState") else []

        def element_name(path: str, i: int) -> str:
            is_joint = path in ("position", "velocity", "effort") and i < len(joints)
            return str(joints[i]) if is_joint else str(i)

        array_names = [
            f"{path}.{element_name(path, i)}" for path, size in arrays for i in range(size)
        ]
        self.names = [*scalars, *array_names]
        self._scalars: Callable[[Any], Any] | None = attrgetter(*scalars) if scalars else None
        self._has_single_scalar = len(scalars) == 1
        self._arrays = [(attrgetter(path), size) for path, size in arrays]

    def extract_numbers(self, message: Any) -> list[float]:
        """Return the numbers of a message in the order of `names`, NaN for missing elements."""
        extracted: list[float] = []
        if self._scalars is not None:
            extracted = (
                [self._scalars(message)]
                if self._has_single_scalar
                else list(self._scalars(message))
            )
        for getter, size in self._arrays:
            values = getter(message).tolist()
            extracted += values if len(values) == size else [*values, *[np.nan] * size][:size]
        return extracted


def _iter_leaves(message: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    """Yield path and value of each leaf of a message without its header."""
    for entry in dataclasses.fields(message):
        if entry.name == "__msgtype__" or (not prefix and entry.name == "header"):
            continue
        value = getattr(message, entry.name)
        if dataclasses.is_dataclass(value):
            yield from _iter_leaves(value, f"{prefix}{entry.name}.")
        else:
            yield prefix + entry.name, value

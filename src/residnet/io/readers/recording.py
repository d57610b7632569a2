"""Recordings: series (topics) with separate clocks, from which one log is built."""

from __future__ import annotations

import dataclasses
import re
from array import array
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import NamedTuple, final

import numpy as np

from residnet.core.errors import UsageError
from residnet.core.log import Remark
from residnet.core.names import suggest_name


@dataclass(frozen=True)
class TimeStamps:
    """Times of one column.

    Attributes:
        ns: times [T] in ns, int64; Unix time if `is_absolute`; arbitrary for missing times.
        is_absolute: whether the source contains dates or Unix time.
        valid: whether each time exists, bool [T]; None if all exist.
        remarks: remarks on corrections.
        seconds: float times [T] in s of a source without dates, without any rounding; else None.
    """

    ns: np.ndarray
    is_absolute: bool
    valid: np.ndarray | None = None
    remarks: tuple[Remark, ...] = ()
    seconds: np.ndarray | None = None

    def seconds_since(self, start: int | None) -> np.ndarray:
        """Return times [T] in s.

        Args:
            start: Unix time in ns from which absolute times count; ignored for other times.
        """
        if self.seconds is not None:
            return self.seconds
        seconds: np.ndarray = (self.ns - (start or 0 if self.is_absolute else 0)) * 1e-9
        return seconds if self.valid is None else np.where(self.valid, seconds, np.nan)


@dataclass(frozen=True)
class Series:
    """Rows of one topic, message type or table.

    Attributes:
        name: name of the topic or table in the source.
        message_type: message type, for example `sensor_msgs/msg/NavSatFix`; empty if the source has
            no types.
        fields: path -> values [T], float64, in the units of the source; NaN for empty cells.
        stamp: time of measurement [T] in s on the sender's clock (header stamp), from the epoch of
            the recording; None if messages have no stamp.
        arrival: time of arrival [T] in s on the recorder's clock, from the same epoch; None if the
            source has none.
        sender: sender of each row [T] (frame id, node or instance); None if unknown.
        remarks: remarks from reading.
    """

    name: str
    message_type: str
    fields: dict[str, np.ndarray]
    stamp: np.ndarray | None = None
    arrival: np.ndarray | None = None
    sender: np.ndarray | None = None
    remarks: tuple[Remark, ...] = ()

    def __len__(self) -> int:
        return int(self.clock.size)

    @property
    def clock(self) -> np.ndarray:
        """Time [T] in s: the stamp if it exists, otherwise the arrival."""
        times = self.stamp if self.stamp is not None else self.arrival
        return np.zeros(0) if times is None else times

    @cached_property
    def _path_by_key(self) -> dict[str, str]:
        return {normalize_field_path(path): path for path in reversed(self.fields)}

    def has_field(self, path: str) -> bool:
        """Return whether a field exists; `pose.position.x` equals `pose_position_x`."""
        return path in self.fields or normalize_field_path(path) in self._path_by_key

    def __getitem__(self, path: str) -> np.ndarray:
        """Return the values [T] of one field."""
        name = path if path in self.fields else self._path_by_key.get(normalize_field_path(path))
        if name is None:
            raise UsageError(
                f"topic {self.name}: no field '{path}'{suggest_name(path, self.fields)}"
            )
        return self.fields[name]

    def select_rows(self, mask: np.ndarray) -> Series:
        """Return the series with the rows of a boolean mask [T] or of indices."""
        stamp, arrival, sender = (
            None if column is None else column[mask]
            for column in (self.stamp, self.arrival, self.sender)
        )
        fields = {path: values[mask] for path, values in self.fields.items()}
        return dataclasses.replace(self, fields=fields, stamp=stamp, arrival=arrival, sender=sender)

    def shift_back(self, stamp: float, arrival: float) -> Series:
        """Return the series with earlier times.

        Args:
            stamp: time in s to subtract from the stamps.
            arrival: time in s to subtract from the arrivals.
        """
        clocks = ((self.stamp, stamp), (self.arrival, arrival))
        shifted = [None if clock is None else clock - seconds for clock, seconds in clocks]
        return dataclasses.replace(self, stamp=shifted[0], arrival=shifted[1])

    def rows_of_sender(self, sender: str) -> Series:
        """Return the series with the rows of one sender.

        Raises:
            UsageError: if the sender is unknown.
        """
        senders = (
            []
            if self.sender is None
            else [str(name) for name in dict.fromkeys(self.sender.tolist())]
        )
        if self.sender is None or sender not in senders:
            raise UsageError(
                f"topic {self.name}: no rows of sender '{sender}'{suggest_name(sender, senders)}"
            )
        return self.select_rows(self.sender == sender)

    def with_remarks(self, *remarks: Remark) -> Series:
        """Return the series with further remarks for the data checks."""
        return dataclasses.replace(self, remarks=(*self.remarks, *remarks))


_MAX_LISTED_SERIES = 20
"""Largest number of series that a message lists."""
_MAX_LISTED_FIELDS = 12
"""Largest number of fields of a series that a message lists."""


def _list_fields(series: Series) -> str:
    """Return the names of the fields of a series for a message, truncated with `...`."""
    names = list(series.fields)
    shown_names = names[:_MAX_LISTED_FIELDS]
    return ", ".join([*shown_names, *(["..."] if len(names) > _MAX_LISTED_FIELDS else [])])


@dataclass(frozen=True)
class Recording:
    """Contents of one recorded file or folder.

    Attributes:
        path: path of the file or folder.
        series: name -> series.
        epoch: Unix time in ns from which all times count; None if the source has no dates.
        files: files that were read.
        remarks: remarks on the recording.
        unread_series: names of series that exist but were not requested.
    """

    path: Path
    series: dict[str, Series]
    epoch: int | None = None
    files: tuple[Path, ...] = ()
    remarks: tuple[Remark, ...] = ()
    unread_series: tuple[str, ...] = field(default=())

    @property
    def contents_description(self) -> str:
        """Text with the name of each series and its message type, or its fields without a type."""
        descriptions = [
            f"{name} ({short_type or _list_fields(series)})"
            for name, series in self.series.items()
            for short_type in [series.message_type.rsplit("/", 1)[-1]]
        ]
        n_more = len(descriptions) - _MAX_LISTED_SERIES
        return (
            ", ".join(
                [
                    *descriptions[:_MAX_LISTED_SERIES],
                    *([f"and {n_more} more"] if n_more > 0 else []),
                ]
            )
            or "nothing"
        )

    def __getitem__(self, topic: str | None) -> Series:
        """Return one series.

        Args:
            topic: name, with or without a leading slash; None if the recording has only one.

        Raises:
            UsageError: if the series does not exist or is ambiguous.
        """
        if topic is None:
            if len(self.series) == 1:
                return next(iter(self.series.values()))
            raise UsageError(
                f"{self.path}: contains {len(self.series)} topics, select one with `topic`"
                f" ({', '.join(list(self.series)[:12])})"
            )
        name = match_topic(topic, self.series)
        if name is None:
            hint = suggest_name(topic, (*self.series, *self.unread_series))
            raise UsageError(f"{self.path}: no topic '{topic}'{hint}")
        return self.series[name]


@final
class MessageBuffer:
    """Growing buffer of messages: a time in ns and a row of numbers each.

    Args:
        names: names of the numbers.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self.names = list(names)
        self.ns = array("q")
        self._rows = array("d")

    def add(self, ns: int, field_values: Iterable[float]) -> None:
        """Append one message with its time in ns and its numbers."""
        self.ns.append(ns)
        self._rows.extend(field_values)

    @property
    def times(self) -> np.ndarray:
        """Times [T] in ns."""
        return np.frombuffer(self.ns, dtype=np.int64)

    @property
    def fields(self) -> dict[str, np.ndarray]:
        """Name -> values [T]."""
        rows = np.frombuffer(self._rows, dtype=np.float64).reshape(len(self.ns), len(self.names))
        return {name: rows[:, i] for i, name in enumerate(self.names)}


class RawSeries(NamedTuple):
    """Series with times in ns, before the epoch of the recording is known.

    Attributes: see `Series`.
    """

    message_type: str
    fields: dict[str, np.ndarray]
    stamp: TimeStamps | None = None
    arrival: TimeStamps | None = None
    sender: np.ndarray | None = None
    remarks: tuple[Remark, ...] = ()


def build_recording(
    path: Path,
    topics: Mapping[str, RawSeries],
    files: tuple[Path, ...],
    remarks: Iterable[Remark] = (),
    unread_series: Iterable[str] = (),
) -> Recording:
    """Build a recording; its epoch is the first full second of all absolute times.

    Args:
        path: path of the file or folder.
        topics: name -> series.
        files: files that were read.
        remarks: remarks on the recording.
        unread_series: names of series that were not read.
    """
    clocks = [
        clock for raw_series in topics.values() for clock in raw_series[2:4] if clock is not None
    ]
    first_stamps = [
        int(raw_series.ns.min())
        for raw_series in clocks
        if raw_series.is_absolute and raw_series.ns.size
    ]
    epoch = min(first_stamps) // 10**9 * 10**9 if first_stamps else None
    series = {}
    for name, raw_series in topics.items():
        stamp, arrival = (
            None if clock is None else clock.seconds_since(epoch) for clock in raw_series[2:4]
        )
        series[name] = Series(
            name,
            raw_series.message_type,
            raw_series.fields,
            stamp,
            arrival,
            raw_series.sender,
            raw_series.remarks,
        )
    return Recording(path, series, epoch, files, tuple(remarks), tuple(unread_series))


def match_topic(topic: str, names: Iterable[str]) -> str | None:
    """Return the name that equals a topic except for a leading slash, or None."""
    return next((name for name in names if name.strip("/") == topic.strip("/")), None)


def normalize_field_path(path: str) -> str:
    """Return a field's path with underscores as separators.

    Exporters write `pose.position.x`, `pose/position/x` or `pose_position_x`.
    """
    return re.sub(r"[./\[\]_]+", "_", path).strip("_").removeprefix("field_")


CLOCK_ONLY_FIELD = "(clock)"
"""Name of a field for requests of a topic's times only."""


@final
class FieldFilter:
    """Filter of the topics and fields that a reader loads.

    Args:
        topic_fields: pairs of topic (None accepts any) and field (an empty one accepts all fields);
            None accepts everything.
    """

    def __init__(self, topic_fields: Iterable[tuple[str | None, str]] | None = None) -> None:
        self._topic_fields = None if topic_fields is None else tuple(topic_fields)

    def __call__(self, topic: str) -> bool:
        """Return whether any field of a topic is accepted."""
        return self._topic_fields is None or any(
            self._matches_topic(name, topic) for name, _ in self._topic_fields
        )

    def accepts_field(self, topic: str, path: str) -> bool:
        """Return whether a field, one of its parts or one of its parents is accepted.

        `orientation.w` is a part of `orientation`, and `value[0]` is a part of `value`.
        """
        field_key = normalize_field_path(path)
        fields = [
            normalize_field_path(field)
            for name, field in self._topic_fields or ()
            if self._matches_topic(name, topic)
        ]
        return self._topic_fields is None or any(
            not field
            or f"{field_key}_".startswith(f"{field}_")
            or field.startswith(f"{field_key}_")
            for field in fields
        )

    @staticmethod
    def _matches_topic(pattern: str | None, topic: str) -> bool:
        return pattern is None or match_topic(pattern, [topic]) is not None


ALL_FIELDS = FieldFilter()

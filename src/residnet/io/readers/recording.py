"""A recording: many series, each with its own clock, before they become one log."""

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
    """The times of a column.

    Attributes:
        ns: [T] int64, whole ns; Unix time where `is_absolute`, and any number where a time is missing.
        is_absolute: whether the source gave dates or Unix time.
        valid: [T] bool, where there is a time; None where there is one everywhere.
        remarks: what was noticed.
        seconds: [T] numbers that are seconds without a date as they stand, to the last bit.
    """

    ns: np.ndarray
    is_absolute: bool
    valid: np.ndarray | None = None
    remarks: tuple[Remark, ...] = ()
    seconds: np.ndarray | None = None

    def seconds_since(self, start: int | None) -> np.ndarray:
        """Return the times [T] in s from `start`, Unix time in ns, where they are absolute."""
        if self.seconds is not None:
            return self.seconds
        seconds: np.ndarray = (self.ns - (start or 0 if self.is_absolute else 0)) * 1e-9
        return seconds if self.valid is None else np.where(self.valid, seconds, np.nan)


@dataclass(frozen=True)
class Series:
    """One topic, message type or table.

    Attributes:
        name: topic or table, as its source names it.
        message_type: message type, for example `sensor_msgs/msg/NavSatFix`; empty where the source has
            none.
        fields: path -> values [T], float64, in the source's units; NaN where a cell is empty.
        stamp: time [T] in s by the sender's clock (header stamp), from the recording's epoch; None
            where messages carry none.
        arrival: time [T] in s by the recorder's clock, from the same epoch; None where the source
            has none.
        sender: who sent each row [T] (frame id, node or instance), where the source says.
        remarks: what was noticed while reading.
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
        """Time [T] in s: the stamp where there is one, else the arrival."""
        times = self.stamp if self.stamp is not None else self.arrival
        return np.zeros(0) if times is None else times

    @cached_property
    def _path_by_key(self) -> dict[str, str]:
        return {normalize_field_path(path): path for path in reversed(self.fields)}

    def has_field(self, path: str) -> bool:
        """Return whether there is a field of this path.

        `pose.position.x`, `pose/position/x` and `pose_position_x` are the same.
        """
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
        """Return the rows at which `mask` ([T] bool, or indices) points."""
        stamp, arrival, sender = (
            None if column is None else column[mask]
            for column in (self.stamp, self.arrival, self.sender)
        )
        fields = {path: values[mask] for path, values in self.fields.items()}
        return dataclasses.replace(self, fields=fields, stamp=stamp, arrival=arrival, sender=sender)

    def shift_back(self, stamp: float, arrival: float) -> Series:
        """Return the series with stamps and arrivals moved back by so many s."""
        clocks = ((self.stamp, stamp), (self.arrival, arrival))
        shifted = [None if clock is None else clock - seconds for clock, seconds in clocks]
        return dataclasses.replace(self, stamp=shifted[0], arrival=shifted[1])

    def rows_of_sender(self, sender: str) -> Series:
        """Return the rows of one sender."""
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
        """Return the series with further remarks."""
        return dataclasses.replace(self, remarks=(*self.remarks, *remarks))


_MAX_LISTED_SERIES = 20
"""Series of a recording that a message names."""


@dataclass(frozen=True)
class Recording:
    """What one file or folder holds.

    Attributes:
        path: where it lies.
        series: by name.
        epoch: Unix time in whole ns that all times count from; None where the start of
            their count is not known.
        files: files that were read.
        remarks: what was noticed about the recording as a whole.
        unread_series: names of series that the source holds and that were not wanted.
    """

    path: Path
    series: dict[str, Series]
    epoch: int | None = None
    files: tuple[Path, ...] = ()
    remarks: tuple[Remark, ...] = ()
    unread_series: tuple[str, ...] = field(default=())

    @property
    def describe_contents(self) -> str:
        """What it holds in words: each series with its type, or its fields where it has none."""
        descriptions = [
            f"{name} ({series.message_type.rsplit('/', 1)[-1] or ', '.join(list(series.fields)[:6])})"
            for name, series in self.series.items()
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
        """Return one series; None names the only one. A leading slash may be left out."""
        if topic is None:
            if len(self.series) == 1:
                return next(iter(self.series.values()))
            raise UsageError(
                f"{self.path}: holds {len(self.series)} topics, name one with `topic`"
                f" ({', '.join(list(self.series)[:12])})"
            )
        name = match_topic(topic, self.series)
        if name is None:
            raise UsageError(
                f"{self.path}: no topic '{topic}'{suggest_name(topic, (*self.series, *self.unread_series))}"
            )
        return self.series[name]


@final
class MessageBuffer:
    """Messages of one kind as they come: whole ns, and a row of numbers each."""

    def __init__(self, names: Iterable[str]) -> None:
        self.names = list(names)
        self.ns, self._rows = array("q"), array("d")

    def add(self, ns: int, field_values: Iterable[float]) -> None:
        """Append one message."""
        self.ns.append(ns)
        self._rows.extend(field_values)

    @property
    def times(self) -> np.ndarray:
        """Whole ns [T]."""
        return np.frombuffer(self.ns, dtype=np.int64)

    @property
    def fields(self) -> dict[str, np.ndarray]:
        """Name -> numbers [T]."""
        rows = np.frombuffer(self._rows, dtype=np.float64).reshape(len(self.ns), len(self.names))
        return {name: rows[:, i] for i, name in enumerate(self.names)}


class RawSeries(NamedTuple):
    """A series whose times are whole ns, before it is known where the recording begins.

    Attributes are those of `Series`.
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
    """Return the recording of series whose times count from the first whole second of all dates."""
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
    """Return the one of `names` that means `topic`, a leading slash aside.

    None where there is none.
    """
    return next((name for name in names if name.strip("/") == topic.strip("/")), None)


def normalize_field_path(path: str) -> str:
    """Return a field's path with every separator as one underscore.

    Exporters write `pose.position.x`, `pose/position/x` or `pose_position_x`.
    """
    return re.sub(r"[./\[\]_]+", "_", path).strip("_").removeprefix("field_")


CLOCK_ONLY_FIELD = "(clock)"
"""Stands for a field where only the times of a topic are wanted."""


@final
class FieldFilter:
    """Topics and fields that are to be read.

    Args:
        topic_fields: pairs of topic (None: the only one there is) and field; None wants everything. An
            empty field wants all of its topic.
    """

    def __init__(self, topic_fields: Iterable[tuple[str | None, str]] | None = None) -> None:
        self._topic_fields = None if topic_fields is None else tuple(topic_fields)

    def __call__(self, topic: str) -> bool:
        """Return whether anything of a topic is wanted."""
        return self._topic_fields is None or any(
            self._matches_topic(name, topic) for name, _ in self._topic_fields
        )

    def accepts_field(self, topic: str, path: str) -> bool:
        """Return whether a field, a part of it or what it is a part of is wanted.

        `orientation.w` is a part of `orientation`, and `value[0]` of `value`.
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

"""A recording: many series, each with its own clock, before they become one log."""

from __future__ import annotations

import dataclasses
import re
from array import array
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple, final

import numpy as np

from residnet.core.errors import UsageError
from residnet.core.names import nearest

Level = Literal["note", "will mislead", "fatal"]
Remark = dict[str, Any]


def remark(level: Level, code: str, text: str, **figures: float) -> Remark:
    """Return a finding of the reader as `Log.meta["findings"]` holds it.

    It has level, code, text and figures (SI).
    """
    return {"level": level, "code": code, "text": text, "figures": figures}


@dataclass(frozen=True)
class Stamps:
    """The times of a column.

    Attributes:
        ns: [T] int64, whole ns; Unix time where `absolute`, and any number where a time is missing.
        absolute: whether the source gave dates or Unix time.
        known: [T] bool, where there is a time; None where there is one everywhere.
        remarks: what was noticed.
        seconds: [T] numbers that are seconds without a date as they stand, to the last bit.
    """

    ns: np.ndarray
    absolute: bool
    known: np.ndarray | None = None
    remarks: tuple[Remark, ...] = ()
    seconds: np.ndarray | None = None

    def since(self, start: int | None) -> np.ndarray:
        """Return the times [T] in s from `start`, Unix time in ns, where they are absolute."""
        if self.seconds is not None:
            return self.seconds
        seconds: np.ndarray = (self.ns - (start or 0 if self.absolute else 0)) * 1e-9
        return seconds if self.known is None else np.where(self.known, seconds, np.nan)


@dataclass(frozen=True)
class Series:
    """One topic, message type or table.

    Attributes:
        name: topic or table, as its source names it.
        kind: message type, for example `sensor_msgs/msg/NavSatFix`; empty where the source has
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
    kind: str
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
        known = self.stamp if self.stamp is not None else self.arrival
        return np.zeros(0) if known is None else known

    @cached_property
    def _by_key(self) -> dict[str, str]:
        return {key_of(path): path for path in reversed(self.fields)}

    def has(self, path: str) -> bool:
        """Return whether there is a field of this path.

        `pose.position.x`, `pose/position/x` and `pose_position_x` are the same.
        """
        return path in self.fields or key_of(path) in self._by_key

    def __getitem__(self, path: str) -> np.ndarray:
        """Return the values [T] of one field."""
        name = path if path in self.fields else self._by_key.get(key_of(path))
        if name is None:
            raise UsageError(f"topic {self.name}: no field '{path}'{nearest(path, self.fields)}")
        return self.fields[name]

    def where(self, keep: np.ndarray) -> Series:
        """Return the rows at which `keep` ([T] bool, or indices) points."""
        stamp, arrival, sender = (
            None if part is None else part[keep] for part in (self.stamp, self.arrival, self.sender)
        )
        fields = {path: values[keep] for path, values in self.fields.items()}
        return dataclasses.replace(self, fields=fields, stamp=stamp, arrival=arrival, sender=sender)

    def earlier(self, stamp: float, arrival: float) -> Series:
        """Return the series with stamps and arrivals moved back by so many s."""
        clocks = ((self.stamp, stamp), (self.arrival, arrival))
        moved = [None if clock is None else clock - seconds for clock, seconds in clocks]
        return dataclasses.replace(self, stamp=moved[0], arrival=moved[1])

    def of_sender(self, sender: str) -> Series:
        """Return the rows of one sender."""
        known = (
            []
            if self.sender is None
            else [str(name) for name in dict.fromkeys(self.sender.tolist())]
        )
        if self.sender is None or sender not in known:
            raise UsageError(
                f"topic {self.name}: no rows of sender '{sender}'{nearest(sender, known)}"
            )
        return self.where(self.sender == sender)

    def noting(self, *remarks: Remark) -> Series:
        """Return the series with further remarks."""
        return dataclasses.replace(self, remarks=(*self.remarks, *remarks))


_TOLD = 20
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
        listed: names of series that the source holds and that were not wanted.
    """

    path: Path
    series: dict[str, Series]
    epoch: int | None = None
    files: tuple[Path, ...] = ()
    remarks: tuple[Remark, ...] = ()
    listed: tuple[str, ...] = field(default=())

    @property
    def contents(self) -> str:
        """What it holds in words: each series with its type, or its fields where it has none."""
        told = [
            f"{name} ({one.kind.rsplit('/', 1)[-1] or ', '.join(list(one.fields)[:6])})"
            for name, one in self.series.items()
        ]
        more = len(told) - _TOLD
        return ", ".join([*told[:_TOLD], *([f"and {more} more"] if more > 0 else [])]) or "nothing"

    def __getitem__(self, topic: str | None) -> Series:
        """Return one series; None names the only one. A leading slash may be left out."""
        if topic is None:
            if len(self.series) == 1:
                return next(iter(self.series.values()))
            raise UsageError(
                f"{self.path}: holds {len(self.series)} topics, name one with `topic`"
                f" ({', '.join(list(self.series)[:12])})"
            )
        name = same_topic(topic, self.series)
        if name is None:
            raise UsageError(
                f"{self.path}: no topic '{topic}'{nearest(topic, (*self.series, *self.listed))}"
            )
        return self.series[name]


@final
class Columns:
    """Messages of one kind as they come: whole ns, and a row of numbers each."""

    def __init__(self, names: Iterable[str]) -> None:
        self.names = list(names)
        self.ns, self._rows = array("q"), array("d")

    def add(self, ns: int, numbers: Iterable[float]) -> None:
        """Append one message."""
        self.ns.append(ns)
        self._rows.extend(numbers)

    @property
    def times(self) -> np.ndarray:
        """Whole ns [T]."""
        return np.frombuffer(self.ns, dtype=np.int64)

    @property
    def fields(self) -> dict[str, np.ndarray]:
        """Name -> numbers [T]."""
        rows = np.frombuffer(self._rows, dtype=np.float64).reshape(len(self.ns), len(self.names))
        return {name: rows[:, i] for i, name in enumerate(self.names)}


class Rows(NamedTuple):
    """A series whose times are whole ns, before it is known where the recording begins.

    Attributes are those of `Series`.
    """

    kind: str
    fields: dict[str, np.ndarray]
    stamp: Stamps | None = None
    arrival: Stamps | None = None
    sender: np.ndarray | None = None
    remarks: tuple[Remark, ...] = ()


def recording_of(
    path: Path,
    topics: Mapping[str, Rows],
    files: tuple[Path, ...],
    remarks: Iterable[Remark] = (),
    listed: Iterable[str] = (),
) -> Recording:
    """Return the recording of series whose times count from the first whole second of all dates."""
    clocks = [clock for one in topics.values() for clock in one[2:4] if clock is not None]
    first = [int(one.ns.min()) for one in clocks if one.absolute and one.ns.size]
    epoch = min(first) // 10**9 * 10**9 if first else None
    series = {}
    for name, one in topics.items():
        stamp, arrival = (None if clock is None else clock.since(epoch) for clock in one[2:4])
        series[name] = Series(name, one.kind, one.fields, stamp, arrival, one.sender, one.remarks)
    return Recording(path, series, epoch, files, tuple(remarks), tuple(listed))


def same_topic(topic: str, names: Iterable[str]) -> str | None:
    """Return the one of `names` that means `topic`, a leading slash aside.

    None where there is none.
    """
    return next((name for name in names if name.strip("/") == topic.strip("/")), None)


def key_of(path: str) -> str:
    """Return a field's path with every separator as one underscore.

    Exporters write `pose.position.x`, `pose/position/x` or `pose_position_x`.
    """
    return re.sub(r"[./\[\]_]+", "_", path).strip("_").removeprefix("field_")


CLOCK_ONLY = "(clock)"
"""Stands for a field where only the times of a topic are wanted."""


@final
class Wanted:
    """Topics and fields that are to be read.

    Args:
        named: pairs of topic (None: the only one there is) and field; None wants everything. An
            empty field wants all of its topic.
    """

    def __init__(self, named: Iterable[tuple[str | None, str]] | None = None) -> None:
        self._named = None if named is None else tuple(named)

    def __call__(self, topic: str) -> bool:
        """Return whether anything of a topic is wanted."""
        return self._named is None or any(self._same(name, topic) for name, _ in self._named)

    def field(self, topic: str, path: str) -> bool:
        """Return whether a field, a part of it or what it is a part of is wanted.

        `orientation.w` is a part of `orientation`, and `value[0]` of `value`.
        """
        key = key_of(path)
        fields = [key_of(field) for name, field in self._named or () if self._same(name, topic)]
        return self._named is None or any(
            not field or f"{key}_".startswith(f"{field}_") or field.startswith(f"{key}_")
            for field in fields
        )

    @staticmethod
    def _same(name: str | None, topic: str) -> bool:
        return name is None or same_topic(name, [topic]) is not None


EVERYTHING = Wanted()

"""Vectors in a tree of groups or structs, as MATLAB and HDF5 files hold them.

Every group with a time is one series.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Protocol

import numpy as np
from pydantic import Field, field_validator

from residnet.core.config import Config
from residnet.core.errors import DataError, UsageError
from residnet.core.names import to_si
from residnet.data.readers.composing.wanted import Wanted
from residnet.data.readers.recording import Recording, Remark, Series, remark
from residnet.data.readers.stamps import Stamps, parse_numbers, parse_texts
from residnet.data.readers.tables.channel_map import factor

TIME_NAMES = (
    "t",
    "time",
    "Time",
    "timestamp",
    "TIME",
    "T",
    "stamp",
    "time_s",
    "t_s",
    "utc",
    "datenum",
    "Zeit",
    "zeit",
    "tiempo",
    "temps",
    "tijd",
    "tempo",
    "tid",
)
# MATLAB's day 719529 is 1 January 1970
_DATENUM_1970, _DAY = 719_529.0, 86_400.0
_MOST_COLUMNS = 64
_FEWEST = 20
"""Fewest samples of a vector that is timed by another group's time."""


class Vector(Protocol):
    """An array that may still lie in its file; `numpy.asarray` reads it."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the array."""
        ...

    @property
    def dtype(self) -> np.dtype:
        """Type of its elements."""
        ...

    @property
    def size(self) -> int:
        """Number of its elements."""
        ...


class TreeTime(Config):
    """Which vector of a group holds time.

    Attributes:
        column: its name; null looks for the usual ones (t, time, timestamp, ...).
        unit: its unit, or `datenum` for MATLAB's days since year 0; null reads Unix time in s, ms,
            us or ns by its size, and anything else as s.
    """

    column: str | None = Field(default=None, min_length=1)
    unit: str | None = None

    @field_validator("unit")
    @classmethod
    def _measures_time(cls, unit: str | None) -> str | None:
        if unit is not None and unit != "datenum":
            factor(unit, "s")
        return unit

    def parse(self, values: np.ndarray) -> Stamps:
        """Return the times from one vector.

        Raises:
            DataError: where a cell is no time.
        """
        if values.dtype.kind not in "biuf":
            return parse_texts(values)
        if self.unit == "datenum":
            days = np.floor(values)
            ns = ((days - _DATENUM_1970) * _DAY * 1e9).astype(np.int64) + np.rint(
                (values - days) * _DAY * 1e9
            ).astype(np.int64)
            return Stamps(ns, True, False)
        return parse_numbers(values, None if self.unit is None else to_si(self.unit))


def tree_recording(
    path: Path, leaves: Mapping[str, Vector], time: TreeTime, wanted: Wanted
) -> Recording:
    """Return the recording of vectors by their path (`trial/u`).

    Each vector belongs to the nearest group above it whose time has its length, else to the only
    time of the file that has it.

    Args:
        path: the file.
        leaves: path -> array [T], [T, 1], [1, T] or [T, k] (whose columns become `name.0`,
            `name.1`, ...).
        time: how time is found.
        wanted: whether a group is to be read.

    Raises:
        UsageError: where no wanted group has a time.
        DataError: where a time cannot be read.
    """
    clocks = _required_clocks(path, leaves, time)
    fields: dict[str, dict[str, np.ndarray]] = {group: {} for group in clocks}
    remarks: list[Remark] = []
    left, adopted = [], []
    for name, values in leaves.items():
        group = _home(name, values, clocks)
        if group is None:
            left.append(f"{name} {list(values.shape)}")
        elif (
            name != clocks[group][0]
            and wanted.field(group or "/", path_in := _path_in(group, name))
            and wanted(group or "/")
        ):
            fields[group].update(_columns(path_in, values, len(clocks[group][1])))
            if not name.startswith(f"{group}/" if group else ""):
                adopted.append(f"{name} by {clocks[group][0]}")
    if left:
        text = (
            f"{len(left)} arrays belong to no time"
            f" ({', '.join(left[:6])}{', ...' if len(left) > 6 else ''}); left out"
        )
        remarks.append(remark("note", "no_time", text, arrays=len(left)))
    if adopted:
        text = (
            f"{len(adopted)} arrays without a time beside them are timed by the only one of their"
            f" length ({', '.join(adopted[:6])}{', ...' if len(adopted) > 6 else ''})"
        )
        remarks.append(remark("note", "time_of_others", text, arrays=len(adopted)))
    chosen = {
        group: clock for group, clock in clocks.items() if wanted(group or "/") and fields[group]
    }
    parsed = _parsed(path, chosen, time)
    dated = [
        int(stamps.ns.min()) for stamps in parsed.values() if stamps.absolute and stamps.ns.size
    ]
    epoch = min(dated) // 10**9 * 10**9 if dated else None
    series = {}
    for group, stamps in parsed.items():
        raw = clocks[group][1]
        # seconds as they stand keep every bit
        plain = not stamps.absolute and raw.dtype.kind == "f" and time.unit in (None, "s")
        t = (
            raw.astype(np.float64)
            if plain
            else (stamps.ns - (epoch if stamps.absolute and epoch is not None else 0)) * 1e-9
        )
        series[group or "/"] = Series(
            group or "/", "", fields[group], t, None, None, stamps.remarks
        )
    listed = tuple(group or "/" for group in clocks if group not in parsed)
    if not series:
        raise UsageError(f"{path}: none of its groups is wanted (it holds {', '.join(listed)})")
    return Recording(path, series, epoch, (path,), tuple(remarks), listed)


def _required_clocks(
    path: Path, leaves: Mapping[str, Vector], time: TreeTime
) -> dict[str, tuple[str, np.ndarray]]:
    """Return the time of every group that has one, and stop where none has."""
    clocks = dict(_clocks(leaves, time))
    if not clocks:
        vector = (
            f"'{time.column}'" if time.column is not None else "of time (t, time, timestamp, ...)"
        )
        near = ", ".join(list(leaves)[:12]) or "nothing"
        raise UsageError(
            f"{path}: no vector {vector} in it; name it with time: {{column: ...}} (the file holds"
            f" {near})"
        )
    return clocks


def _parsed(
    path: Path, clocks: Mapping[str, tuple[str, np.ndarray]], time: TreeTime
) -> dict[str, Stamps]:
    """Return the times of groups, parsed."""
    parsed = {}
    for group, (name, values) in clocks.items():
        try:
            parsed[group] = time.parse(values)
        except DataError as error:
            raise DataError(f"{path}: {name}: {error}") from error
    return parsed


def _clocks(
    leaves: Mapping[str, Vector], time: TreeTime
) -> Iterable[tuple[str, tuple[str, np.ndarray]]]:
    """Return the group -> path of its time and the time itself."""
    names = TIME_NAMES if time.column is None else (time.column,)
    for rank in names:
        for path, values in leaves.items():
            group, _, last = path.rpartition("/")
            if last == rank and values.size > 1 and values.size == max(values.shape):
                yield group, (path, np.asarray(values).reshape(-1))


def _home(path: str, values: Vector, clocks: Mapping[str, tuple[str, np.ndarray]]) -> str | None:
    """Return the nearest group above whose time has the length of `values`.

    Where there is none, and all times of this length in the file are the same, the first of their
    groups.
    """
    group = path
    while group:
        group = group.rpartition("/")[0]
        if group in clocks and _rows(values, clocks[group][1].size) is not None:
            return group
    if max(values.shape, default=0) < _FEWEST:
        return None
    alike = [name for name, (_, t) in clocks.items() if max(values.shape) == t.size]
    same = all(np.array_equal(clocks[name][1], clocks[alike[0]][1]) for name in alike)
    return alike[0] if alike and same and _rows(values, max(values.shape)) is not None else None


def _path_in(group: str, name: str) -> str:
    """Return the path of a vector below what it has in common with the group of its time."""
    shared = 0
    for mine, other in zip(name.split("/")[:-1], group.split("/") if group else [], strict=False):
        if mine != other:
            break
        shared += 1
    return "/".join(name.split("/")[shared:])


def _rows(values: Vector, length: int) -> int | None:
    """Return which axis of an array runs over time; None where none does."""
    if values.dtype.kind not in "biuf" or len(values.shape) > 2:
        return None if values.dtype.kind in "biuf" or values.size != length else 0
    axis = next((i for i, size in enumerate(values.shape) if size == length), None)
    return axis if axis is not None and values.size <= _MOST_COLUMNS * length else None


def _columns(name: str, values: Vector, length: int) -> dict[str, np.ndarray]:
    """Return the fields of one array."""
    if values.dtype.kind not in "biuf":
        return {}
    axis = _rows(values, length)
    table = (
        np.moveaxis(np.asarray(values), axis or 0, 0)
        .reshape(length, -1)
        .astype(np.float64, copy=False)
    )
    if table.shape[1] == 1:
        return {name.replace("/", "."): table[:, 0]}
    return {f"{name.replace('/', '.')}.{i}": table[:, i] for i in range(table.shape[1])}

"""Readers of MATLAB and HDF5 files, whose structs or groups with a time vector are series."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeAlias, final

import numpy as np
from pydantic import Field, field_validator

from residnet.core.config import Config
from residnet.core.errors import DataError, UsageError
from residnet.core.log import Remark, make_remark
from residnet.core.names import to_si
from residnet.io.header_vocabulary import TIME_VECTOR_NAMES
from residnet.io.readers.base import optional_import, require_file, wrap_read_errors
from residnet.io.readers.compose import RecordingConfig
from residnet.io.readers.quantities import conversion_factor
from residnet.io.readers.recording import (
    ALL_FIELDS,
    FieldFilter,
    RawSeries,
    Recording,
    TimeStamps,
    build_recording,
)
from residnet.io.readers.timestamps import (
    detect_unix_unit,
    guess_time_unit,
    is_datenum,
    parse_numbers,
    parse_texts,
)

if TYPE_CHECKING:
    import h5py

# MATLAB's day number of 1 January 1970
_DATENUM_1970 = 719_529.0
_SECONDS_PER_DAY = 86_400.0
"""Length of a day: MATLAB counts a datenum in days, a log in seconds."""
_MAX_COLUMNS = 64
"""Largest number of columns of a matrix of channels; images and point clouds have more."""
_MIN_SAMPLES = 20
"""Fewest samples of a vector that uses the time vector of another group."""
_HDF5 = b"\x89HDF\r\n\x1a\n"
_MAX_UNCHECKED_BYTES = 200_000_000
"""Size of a dataset in bytes up to which its compression ratio is not checked."""
_MAX_COMPRESSION_RATIO = 1000
"""Largest ratio of a dataset's size to that of its file; a constant channel has about 900."""


_Vector: TypeAlias = Any
"""Array in memory or in a file, with shape, dtype and size; `numpy.asarray` loads it."""


class TreeTime(Config):
    """Time vector of a group.

    Attributes:
        column: name of the vector; null searches common names (t, time, timestamp, ...).
        unit: unit of the vector, or `datenum` for MATLAB's days since year 0; null detects Unix
            time, days and the unit of other numbers by their size and step.
    """

    column: str | None = Field(default=None, min_length=1)
    unit: str | None = None

    @field_validator("unit")
    @classmethod
    def _validate_time_unit(cls, unit: str | None) -> str | None:
        if unit is not None and unit != "datenum":
            conversion_factor(unit, "s")
        return unit

    def parse(self, values: np.ndarray) -> TimeStamps:
        """Convert a vector [T] of numbers or texts to time stamps.

        Raises:
            DataError: if a cell is no time.
        """
        if values.dtype.kind not in "biuf":
            return parse_texts(values)
        unit = self.unit
        remarks: tuple[Remark, ...] = ()
        if unit is None and np.isfinite(values).all() and not detect_unix_unit(values):
            unit, reason = guess_time_unit(values)
            if unit != "s":
                remarks = (make_remark("note", "time_unit", f"time: {reason}"),)
            unit = "datenum" if unit == "day" and is_datenum(values) else unit
        if unit != "datenum":
            stamps = parse_numbers(values, None if unit in (None, "s") else to_si(unit))
            return dataclasses.replace(stamps, remarks=(*stamps.remarks, *remarks))
        days = np.floor(values)
        # integer and fraction separately: ns since 1970 exceed the 53 bits of a float
        whole_days_ns = (days - _DATENUM_1970) * _SECONDS_PER_DAY * 1e9
        fraction_ns = (values - days) * _SECONDS_PER_DAY * 1e9
        return TimeStamps(
            whole_days_ns.astype(np.int64) + np.rint(fraction_ns).astype(np.int64),
            True,
            remarks=remarks,
        )


class _TreeConfig(RecordingConfig):
    """Base class of the readers of MATLAB and HDF5 files.

    Attributes:
        time: time vector of a group, struct or table.
        table: group, struct or table to read, for files with several experiments; null reads all.
    """

    time: TreeTime = Field(default_factory=TreeTime)
    table: str | None = Field(default=None, min_length=1)

    def load(self, path: Path, field_filter: FieldFilter = ALL_FIELDS) -> Recording:
        """Read groups of a file."""
        require_file(path)
        field_filter = field_filter if self.table is None else FieldFilter([(self.table, "")])
        if not is_hdf5(path) and isinstance(self, MatConfig):
            from scipy.io import loadmat

            # SciPy raises many types of exceptions on damaged files
            with wrap_read_errors(path, "a MATLAB file"):
                content = dict(_iter_arrays(loadmat(path, simplify_cells=True), ""))
            return _build_tree_recording(path, content, self.time, field_filter)
        file_description = "an HDF5 file" if isinstance(self, Hdf5Config) else "a MATLAB 7.3 file"
        with optional_import("hdf5", "h5py", file_description):
            import h5py
        with wrap_read_errors(path, file_description), h5py.File(path, "r") as file:
            datasets: list[h5py.Dataset] = []

            def visit(name: str, node: Any) -> None:
                if isinstance(node, h5py.Dataset) and not name.startswith("#"):
                    datasets.append(node)

            file.visititems(visit)
            leaves: dict[str, _Vector] = {}
            for dataset in datasets:
                name = dataset.name.strip("/")
                names = dataset.dtype.names
                claimed_bytes = dataset.size * dataset.dtype.itemsize
                file_bytes = path.stat().st_size
                # a damaged header may claim any size; do not allocate it
                if claimed_bytes > max(_MAX_UNCHECKED_BYTES, _MAX_COMPRESSION_RATIO * file_bytes):
                    raise DataError(
                        f"{path}: {dataset.name} claims {claimed_bytes / 1e9:.3g} GB in a file of"
                        f" {file_bytes / 1e6:.3g} MB; the file is damaged or was never filled,"
                        " write it again"
                    )
                if names and dataset.ndim == 1:
                    for column in names:
                        if not dataset.dtype[column].shape:
                            leaves[f"{name}/{column}"] = _LazyColumn(dataset, column)
                    continue
                is_matlab_text = dataset.attrs.get("MATLAB_class") in (b"char", b"cell")
                if not names and dataset.ndim and dataset.size and not is_matlab_text:
                    is_text = dataset.dtype.kind in "SO" and dataset.ndim == 1
                    leaves[name] = _decode_bytes(dataset[()]) if is_text else dataset
            return _build_tree_recording(path, leaves, self.time, field_filter)


@final
class MatConfig(_TreeConfig):
    """Reader of MATLAB files (v5 and v7.3) with vectors, matrices, structs or Simulink structures.

    Matrices have one row per sample.
    """

    kind: Literal["mat"] = "mat"
    endings: ClassVar = (".mat",)
    formats: ClassVar = {
        "MATLAB": lambda path, head: head.startswith(b"MATLAB 5.0") or path.suffix.lower() == ".mat"
    }


@final
class Hdf5Config(_TreeConfig):
    """Reader of HDF5 files with datasets in groups, or tables with named columns."""

    kind: Literal["hdf5"] = "hdf5"
    endings: ClassVar = (".h5", ".hdf5")
    formats: ClassVar = {"HDF5": lambda path, head: is_hdf5(path)}


def is_hdf5(path: Path) -> bool:
    """Return whether a file has the HDF5 signature, at byte 0 or after MATLAB's 512-byte header."""
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        head = stream.read(520)
    return head.startswith(_HDF5) or head[512:520] == _HDF5


def _iter_arrays(node: Any, prefix: str) -> Iterator[tuple[str, np.ndarray]]:
    """Yield path and value of each array in nested structs and cell arrays."""
    if isinstance(node, dict):
        for name, value in node.items():
            if not name.startswith("__"):
                yield from _iter_arrays(value, f"{prefix}/{name}" if prefix else name)
    elif (isinstance(node, np.ndarray) and node.dtype == object) or isinstance(node, list):
        parts = list(node)
        if parts and all(isinstance(part, str) for part in parts):
            yield prefix, np.array(parts, dtype=object)
            return
        for i, part in enumerate(parts):
            yield from _iter_arrays(part, f"{prefix}/{i}")
    elif isinstance(node, np.ndarray) and node.ndim:
        yield prefix, node


@final
class _LazyColumn:
    """Column of an HDF5 table that is loaded on conversion to an array."""

    def __init__(self, dataset: h5py.Dataset, name: str) -> None:
        self._dataset = dataset
        self._name = name
        self.shape = dataset.shape
        self.size = dataset.size
        self.dtype = dataset.dtype[name]

    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        values = _decode_bytes(self._dataset.fields(self._name)[()])
        return values if dtype is None else values.astype(dtype)


def _decode_bytes(values: np.ndarray) -> np.ndarray:
    """Convert a vector of bytes to text; return other arrays unchanged."""
    if values.dtype.kind not in "SO" or values.ndim != 1:
        return values
    texts = (v.decode(errors="replace") if isinstance(v, bytes) else str(v) for v in values)
    return np.array(list(texts), dtype=object)


def _build_tree_recording(
    path: Path, leaves: Mapping[str, _Vector], time: TreeTime, field_filter: FieldFilter
) -> Recording:
    """Build a recording from arrays in nested groups.

    An array uses the time vector of the nearest parent group with the same length, otherwise the
    only time vector of the file with this length.

    Args:
        path: file, for messages.
        leaves: path (`trial/u`) -> array [T], [T, 1], [1, T] or [T, k], whose columns become
            `name.0`, `name.1`, ...
        time: settings of the time vector.
        field_filter: filter of groups and fields.

    Raises:
        UsageError: if there is no time vector, or no accepted group.
        DataError: if a time vector has invalid cells.
    """
    clocks = _find_clocks(leaves, time)
    if not clocks:
        clock_description = (
            f"'{time.column}'" if time.column else "of time (t, time, timestamp, ...)"
        )
        available = ", ".join(list(leaves)[:12]) or "nothing"
        raise UsageError(
            f"{path}: has no vector {clock_description}; name the vector of times t or set time:"
            " {column: ...} (the file"
            f" contains {available})"
        )
    fields, remarks = _assign_to_clocks(leaves, clocks, field_filter)
    topics: dict[str, RawSeries] = {}
    for group, (name, values) in clocks.items():
        if field_filter(group or "/") and fields[group]:
            try:
                topics[group or "/"] = RawSeries("", fields[group], time.parse(values))
            except DataError as error:
                raise DataError(f"{path}: {name}: {error}") from error
    unread_groups = [group or "/" for group in clocks if (group or "/") not in topics]
    if not topics:
        raise UsageError(
            f"{path}: has none of the configured groups (it contains {', '.join(unread_groups)})"
        )
    return build_recording(path, topics, (path,), remarks, unread_groups)


def _assign_to_clocks(
    leaves: Mapping[str, _Vector],
    clocks: Mapping[str, tuple[str, np.ndarray]],
    field_filter: FieldFilter,
) -> tuple[dict[str, dict[str, np.ndarray]], list[Remark]]:
    """Return the accepted arrays by group of their time vector and name, and remarks."""
    fields: dict[str, dict[str, np.ndarray]] = {group: {} for group in clocks}
    unassigned = []
    assigned_by_length = []
    for name, values in leaves.items():
        group = _find_clock_group(name, values, clocks)
        if group is None:
            unassigned.append(f"{name} {list(values.shape)}")
            continue
        clock, t = clocks[group]
        common_group = os.path.commonpath([name.rpartition("/")[0], group])
        relative_path = name.removeprefix(common_group).lstrip("/")
        if (
            name != clock
            and field_filter(group or "/")
            and field_filter.accepts_field(group or "/", relative_path)
        ):
            fields[group] |= _split_matrix(relative_path, values, len(t))
            if not name.startswith(f"{group}/" if group else ""):
                assigned_by_length.append(f"{name} by {clock}")
    remarks = []
    for code, names, reason in (
        ("no_time", unassigned, "have no time vector ({}); left out"),
        (
            "time_of_others",
            assigned_by_length,
            "without a time vector in their group use the only one of their length ({})",
        ),
    ):
        if names:
            name_list = ", ".join(names[:6]) + (", ..." if len(names) > 6 else "")
            text = f"{len(names)} arrays {reason.format(name_list)}"
            remarks.append(make_remark("note", code, text, arrays=len(names)))
    return fields, remarks


def _find_clocks(
    leaves: Mapping[str, _Vector], time: TreeTime
) -> dict[str, tuple[str, np.ndarray]]:
    """Return group -> path and values of its time vector."""
    clocks = {}
    for clock_name in TIME_VECTOR_NAMES if time.column is None else (time.column,):
        for path, values in leaves.items():
            group, _, vector_name = path.rpartition("/")
            if vector_name == clock_name and values.size > 1 and values.size == max(values.shape):
                clocks[group] = (path, np.asarray(values).reshape(-1))
    return clocks


def _find_clock_group(
    path: str, values: _Vector, clocks: Mapping[str, tuple[str, np.ndarray]]
) -> str | None:
    """Return the group whose time vector belongs to an array, or None.

    It is the nearest parent group with a time vector of the same length. Otherwise it is the first
    group with this length, if all time vectors of this length in the file are equal.

    Args:
        path: path of the array.
        values: the array.
        clocks: group -> path and values of its time vector.
    """
    group = path
    while group:
        group = group.rpartition("/")[0]
        if group in clocks and _find_time_axis(values, clocks[group][1].size) is not None:
            return group
    length = max(values.shape, default=0)
    same_length = [name for name, (_, t) in clocks.items() if length == t.size]
    if length < _MIN_SAMPLES or not same_length or _find_time_axis(values, length) is None:
        return None
    are_identical = all(
        np.array_equal(clocks[name][1], clocks[same_length[0]][1]) for name in same_length
    )
    return same_length[0] if are_identical else None


def _find_time_axis(values: _Vector, length: int) -> int | None:
    """Return the axis of an array with a given number of samples, or None."""
    if values.dtype.kind not in "biuf":
        return 0 if values.size == length else None
    if len(values.shape) > 2 or values.size > _MAX_COLUMNS * length:
        return None
    return next((i for i, size in enumerate(values.shape) if size == length), None)


def _split_matrix(name: str, values: _Vector, length: int) -> dict[str, np.ndarray]:
    """Return the columns of a matrix as `name.0`, `name.1`, ..., and a vector as `name`."""
    if values.dtype.kind not in "biuf":
        return {}
    table = np.moveaxis(np.asarray(values), _find_time_axis(values, length) or 0, 0)
    table = table.reshape(length, -1).astype(np.float64, copy=False)
    name = name.replace("/", ".")
    if table.shape[1] == 1:
        return {name: table[:, 0]}
    return {f"{name}.{i}": table[:, i] for i in range(table.shape[1])}

"""The canonical log: named SI channels over one clock, stored as a Parquet file."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, KeysView
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from residnet.core.arrays import paged
from residnet.core.errors import DataError, UsageError
from residnet.core.files import atomic_write
from residnet.core.names import CHANNEL_UNITS, suggest_name

SCHEMA = "residnet.log/1"
_WRITE_ROWS = 500_000
"""Rows per write operation: 4 MB of each channel."""


_FIELD_TYPES: dict[str, type | tuple[type, ...]] = {
    **{"name": str, "manoeuvre": str, "units": dict, "meta": dict},
    **{"source": str, "sha256": str, "findings": list, "spikes": dict, "smoothed": list},
    **{"integrated": list, "stretch": list, "grid": dict},
    **{"epoch": (int, float), "epoch_ns": int},
}
"""Types of the fields in the metadata of a file, and of the entries of `meta` that are read."""


Level = Literal["note", "will mislead", "fatal"]
Remark = dict[str, Any]


def make_remark(level: Level, code: str, text: str, **figures: float) -> Remark:
    """Return a finding of a reader, as stored in `Log.meta["findings"]`.

    Args:
        level: severity, see `residnet.quality.Finding`.
        code: kind of finding, stable for programs.
        text: one line with figures.
        figures: numbers in SI units.
    """
    return {"level": level, "code": code, "text": text, "figures": figures}


@dataclass(frozen=True)
class Log:
    """One recorded or simulated manoeuvre.

    Attributes:
        name: unique within a run; stem of file names.
        t: time [T] in s, strictly increasing, with any origin.
        channels: name -> values [T], float64, SI units and radians, psi unwrapped, NaN for missing
            measurements.
        units: name -> SI unit.
        manoeuvre: kind of manoeuvre, for example `zigzag`; `unknown` by default.
        masks: reason -> [T] bool, True at samples that are excluded from fits and scores.
        meta: further information (source file, SHA-256, set-up); JSON values only.
    """

    name: str
    t: np.ndarray
    channels: dict[str, np.ndarray]
    units: dict[str, str] = field(default_factory=dict)
    manoeuvre: str = "unknown"
    masks: dict[str, np.ndarray] = field(default_factory=dict)
    meta: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, values in self.channels.items():
            if values.shape != self.t.shape:
                raise DataError(
                    f"log {self.name}: channel {name} has {values.size} samples, time has"
                    f" {self.t.size}"
                )
        missing = {
            name: CHANNEL_UNITS.get(name, "-") for name in self.channels if name not in self.units
        }
        # a frozen dataclass allows no assignment; channels with standard names need no unit
        object.__setattr__(self, "units", {**self.units, **missing})

    def __len__(self) -> int:
        return int(self.t.size)

    def __repr__(self) -> str:
        seconds = float(self.t[-1] - self.t[0]) if len(self) else 0.0
        channels = ", ".join(f"{name} [{self.units[name]}]" for name in self.channels)
        summary = f"{self.manoeuvre}, {len(self)} samples over {seconds:.1f} s"
        return f"Log({self.name!r}, {summary}: {channels})"

    def __getitem__(self, name: str) -> np.ndarray:
        """Return the values [T] of one channel.

        Raises:
            UsageError: if the log has no such channel.
        """
        if name not in self.channels:
            raise UsageError(
                f"log {self.name}: no channel '{name}'{suggest_name(name, self.channels)}"
            )
        return self.channels[name]

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names of the channels; `len` is the number of samples, as in pandas."""
        return iter(self.channels)

    def __contains__(self, name: object) -> bool:
        return name in self.channels

    def keys(self) -> KeysView[str]:
        """Return the names of the channels, so that `dict(log)` has their values."""
        return self.channels.keys()

    def stack(self, names: tuple[str, ...] | list[str]) -> np.ndarray:
        """Return channels as the columns of an array [T, len(names)]."""
        return (
            np.stack([self[name] for name in names], axis=-1) if names else np.zeros((len(self), 0))
        )

    @property
    def usable(self) -> np.ndarray:
        """[T] bool: samples that no mask excludes."""
        is_masked = np.zeros(len(self), dtype=bool)
        for mask in self.masks.values():
            is_masked |= mask
        return ~is_masked

    def replace(self, **changes: Any) -> Log:
        """Return a copy with some attributes replaced."""
        return dataclasses.replace(self, **changes)

    def select_rows(self, selection: slice | np.ndarray) -> Log:
        """Return the log with selected samples only.

        Args:
            selection: slice, indices or mask [T].
        """
        return self.replace(
            t=self.t[selection],
            channels={name: values[selection] for name, values in self.channels.items()},
            masks={reason: mask[selection] for reason, mask in self.masks.items()},
        )

    def move_to_disk(self) -> Log:
        """Return the log with its arrays in a memory-mapped temporary file."""
        on_disk_log = self.replace(
            t=paged.copy_to_disk(self.t),
            channels={name: paged.copy_to_disk(values) for name, values in self.channels.items()},
            masks={reason: paged.copy_to_disk(mask) for reason, mask in self.masks.items()},
        )
        paged.release_pages()
        return on_disk_log

    def save(self, path: Path) -> None:
        """Write the log as a canonical Parquet file.

        The columns are t, the channels and `mask:<reason>`. The other attributes are JSON in the
        metadata of the file.
        """
        import pyarrow as pa
        import pyarrow.parquet as pq

        columns = {
            "t": self.t,
            **self.channels,
            **{f"mask:{reason}": mask for reason, mask in self.masks.items()},
        }
        metadata = {
            "schema": SCHEMA,
            "name": self.name,
            "manoeuvre": self.manoeuvre,
            "units": self.units,
            "meta": self.meta,
        }
        schema = pa.table(
            {name: values[:0] for name, values in columns.items()}
        ).schema.with_metadata({"residnet": json.dumps(metadata)})
        with atomic_write(path) as file, pq.ParquetWriter(file, schema) as writer:
            # in chunks, because the columns of a large log are memory-mapped
            for start in range(0, max(1, len(self)), _WRITE_ROWS):
                writer.write_table(
                    pa.table(
                        {
                            name: values[start : start + _WRITE_ROWS]
                            for name, values in columns.items()
                        },
                        schema=schema,
                    )
                )
                for values in columns.values():
                    paged.release_pages_of(values)

    @staticmethod
    def is_canonical_log(path: Path) -> bool:
        """Return whether a file is a Parquet file written by `Log.save`."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        if path.suffix != ".parquet" or not path.is_file():
            return False
        try:
            return b"residnet" in (pq.read_schema(path).metadata or {})
        except (pa.ArrowException, OSError, UnicodeError):
            return False

    @classmethod
    def load(cls, path: Path) -> Log:
        """Read a file that `save` wrote.

        Raises:
            UsageError: if the file is missing or not a canonical log.
            DataError: if its metadata are damaged.
        """
        if not path.is_file():
            raise UsageError(f"{path}: no such file")
        if path.suffix.lower() != ".parquet":
            raise UsageError(
                f"{path}: is not a log that residnet wrote (.parquet);"
                " the task `import` turns others into such logs"
            )
        table = _read_parquet(path)
        metadata = _parse_metadata(path, table)
        columns = _extract_columns(path, table)
        masks = {
            column_name.removeprefix("mask:"): column_values
            for column_name, column_values in columns.items()
            if column_name.startswith("mask:")
        }
        channels = {
            column_name: column_values
            for column_name, column_values in columns.items()
            if column_name != "t" and not column_name.startswith("mask:")
        }
        return cls(
            metadata["name"],
            columns["t"],
            channels,
            metadata["units"],
            metadata["manoeuvre"],
            masks,
            metadata["meta"],
        )


def _read_parquet(path: Path) -> Any:
    """Read a Parquet file as a table of pyarrow.

    Raises:
        UsageError: if it is no Parquet file.
        DataError: if the name of a column is not UTF-8.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        return pq.read_table(path)
    except UnicodeError as error:
        raise DataError(
            f"{path}: the name of a column is not UTF-8 text; rename the column in the program"
            " that wrote it"
        ) from error
    except (pa.ArrowException, OSError) as error:
        raise UsageError(f"{path}: not a Parquet file ({str(error).splitlines()[0]})") from error


def _parse_metadata(path: Path, table: Any) -> dict[str, Any]:
    """Return the validated metadata of a canonical log: name, manoeuvre, units and `meta`.

    Raises:
        UsageError: if the table is no canonical log.
        DataError: if a field is missing or damaged.
    """
    try:
        metadata = json.loads((table.schema.metadata or {}).get(b"residnet", b"{}"))
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: damaged ({error}); write the file again") from error
    if not isinstance(metadata, dict) or metadata.get("schema") != SCHEMA:
        raise UsageError(
            f"{path}: not a residnet log ({SCHEMA}); give a channel map to read a foreign table"
        )
    required = {key: metadata.get(key) for key in ("name", "manoeuvre", "units", "meta")}
    meta = required["meta"] if isinstance(required["meta"], dict) else {}
    # entries of `meta` are optional, but one that is present must have its type
    stored = {**required, **{key: value for key, value in meta.items() if key in _FIELD_TYPES}}
    damaged = [key for key, value in stored.items() if not isinstance(value, _FIELD_TYPES[key])]
    if not damaged and not all(isinstance(unit, str) for unit in metadata["units"].values()):
        damaged = ["units"]
    if not damaged and not all(map(_is_valid_finding, meta.get("findings", ()))):
        damaged = ["findings"]
    if damaged:
        raise DataError(
            f"{path}: canonical log whose '{damaged[0]}' is missing or damaged; write the file"
            " again"
        )
    return metadata


def _is_valid_finding(finding: Any) -> bool:
    """Return whether an entry of `meta["findings"]` has the fields of `make_remark`."""
    return (
        isinstance(finding, dict)
        and isinstance(finding.get("figures", {}), dict)
        and all(isinstance(finding.get(key), str) for key in ("level", "code", "text"))
    )


def _extract_columns(path: Path, table: Any) -> dict[str, np.ndarray]:
    """Return the columns of a canonical log: float64, masks as bool.

    Raises:
        DataError: if a column has no numbers or occurs twice, or the time is missing.
    """
    columns: dict[str, np.ndarray] = {}
    for name in table.column_names:
        values = table.column(name).to_numpy()
        # kinds of NumPy: float, signed and unsigned integer, bool
        if values.dtype.kind not in "fiub":
            raise DataError(
                f"{path}: column '{name}' holds no numbers ({values.dtype}); the file is"
                " damaged, write it again"
            )
        if name in columns:
            raise DataError(f"{path}: column '{name}' occurs twice; write the file again")
        dtype = bool if name.startswith("mask:") else np.float64
        columns[name] = np.asarray(values, dtype=dtype)
    if "t" not in columns:
        raise DataError(f"{path}: canonical log without a column 't'; write the file again")
    return columns

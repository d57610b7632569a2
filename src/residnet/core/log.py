"""The canonical log: named SI channels over one clock, kept as a Parquet file."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from residnet.core.arrays import paged
from residnet.core.errors import DataError, UsageError
from residnet.core.files import whole
from residnet.core.names import CHANNEL_UNITS, nearest

SCHEMA = "residnet.log/1"
_PIECE = 500_000
"""Rows that are written at a time: 4 MB of each channel."""


_WORDS: dict[str, type | tuple[type, ...]] = {
    **{"name": str, "manoeuvre": str, "units": dict, "meta": dict},
    **{"source": str, "sha256": str, "findings": list, "spikes": dict, "smoothed": list},
    **{"integrated": list, "stretch": list, "grid": dict},
    **{"epoch": (int, float), "epoch_ns": int},
}
"""What a file says of itself, and of its `meta` what residnet reads."""


@dataclass(frozen=True)
class Log:
    """One recorded or simulated manoeuvre.

    Attributes:
        name: unique within a run; the stem of its file names.
        t: time [T] in s, strictly increasing, on the log's own clock.
        channels: name -> values [T], float64, SI and radians; psi unwrapped; NaN where nothing was
            measured.
        units: name -> SI unit.
        manoeuvre: kind of manoeuvre, for example `zigzag`; `unknown` where it is not known.
        masks: reason -> [T] bool, True where samples must not be scored or learned from.
        meta: anything else worth keeping (source file, SHA-256, set-up); JSON values only.
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
        object.__setattr__(self, "units", {**self.units, **missing})

    def __len__(self) -> int:
        return int(self.t.size)

    def __repr__(self) -> str:
        seconds = float(self.t[-1] - self.t[0]) if len(self) else 0.0
        channels = ", ".join(f"{name} [{self.units[name]}]" for name in self.channels)
        about = f"{self.manoeuvre}, {len(self)} samples over {seconds:.1f} s"
        return f"Log({self.name!r}, {about}: {channels})"

    def __getitem__(self, name: str) -> np.ndarray:
        """Return the values [T] of one channel.

        Raises:
            UsageError: where the log has no such channel.
        """
        if name not in self.channels:
            raise UsageError(f"log {self.name}: no channel '{name}'{nearest(name, self.channels)}")
        return self.channels[name]

    def stack(self, names: tuple[str, ...] | list[str]) -> np.ndarray:
        """Return channels side by side, [T, len(names)]."""
        return (
            np.stack([self[name] for name in names], axis=-1) if names else np.zeros((len(self), 0))
        )

    @property
    def usable(self) -> np.ndarray:
        """[T] bool: samples that no mask excludes."""
        bad = np.zeros(len(self), dtype=bool)
        for mask in self.masks.values():
            bad |= mask
        return ~bad

    def replace(self, **changes: Any) -> Log:
        """Return a copy with some attributes changed."""
        return dataclasses.replace(self, **changes)

    def rows(self, part: slice | np.ndarray) -> Log:
        """Return the log at some of its samples, given as a slice or as a mask [T]."""
        return self.replace(
            t=self.t[part],
            channels={name: values[part] for name, values in self.channels.items()},
            masks={reason: mask[part] for reason, mask in self.masks.items()},
        )

    def on_disk(self) -> Log:
        """Return the same log with its arrays in a temporary file, out of memory."""
        moved = self.replace(
            t=paged.on_disk(self.t),
            channels={name: paged.on_disk(values) for name, values in self.channels.items()},
            masks={reason: paged.on_disk(mask) for reason, mask in self.masks.items()},
        )
        paged.forget()
        return moved

    def save(self, path: Path) -> None:
        """Write the log as a canonical Parquet file.

        Its columns are t, the channels and `mask:<reason>`; the rest stands as JSON in its
        metadata.
        """
        import pyarrow as pa
        import pyarrow.parquet as pq

        columns = {
            "t": self.t,
            **self.channels,
            **{f"mask:{reason}": mask for reason, mask in self.masks.items()},
        }
        about = {
            "schema": SCHEMA,
            "name": self.name,
            "manoeuvre": self.manoeuvre,
            "units": self.units,
            "meta": self.meta,
        }
        schema = pa.table(
            {name: values[:0] for name, values in columns.items()}
        ).schema.with_metadata({"residnet": json.dumps(about)})
        with whole(path) as file, pq.ParquetWriter(file, schema) as writer:
            # piece by piece: the columns of a large log lie on disk
            for start in range(0, max(1, len(self)), _PIECE):
                writer.write_table(
                    pa.table(
                        {name: values[start : start + _PIECE] for name, values in columns.items()},
                        schema=schema,
                    )
                )
                for values in columns.values():
                    paged.forget_pages(values)

    @staticmethod
    def recognises(path: Path) -> bool:
        """Return whether a file is a canonical log."""
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
            UsageError: where the file is missing or not a canonical log.
            DataError: where what it says of itself is damaged.
        """
        import pyarrow as pa
        import pyarrow.parquet as pq

        if not path.is_file():
            raise UsageError(f"{path}: no such file")
        if path.suffix.lower() != ".parquet":
            raise UsageError(
                f"{path}: is no log that residnet wrote (.parquet), and only such are read here;"
                " the task `import` turns others into such logs"
            )
        try:
            table = pq.read_table(path)
        except UnicodeError as error:
            raise DataError(
                f"{path}: the name of a column is no UTF-8 text; rename it where it is written"
            ) from error
        except (pa.ArrowException, OSError) as error:
            raise UsageError(
                f"{path}: not a Parquet file ({str(error).splitlines()[0]})"
            ) from error
        try:
            about = json.loads((table.schema.metadata or {}).get(b"residnet", b"{}"))
        except (ValueError, RecursionError) as error:
            raise DataError(f"{path}: damaged ({error}); write the file again") from error
        if not isinstance(about, dict) or about.get("schema") != SCHEMA:
            raise UsageError(
                f"{path}: not a residnet log ({SCHEMA}); give a channel map to read a foreign table"
            )
        needed = {key: about.get(key) for key in ("name", "manoeuvre", "units", "meta")}
        meta = needed["meta"] if isinstance(needed["meta"], dict) else {}
        told = {**needed, **{key: value for key, value in meta.items() if key in _WORDS}}
        wrong = [key for key, value in told.items() if not isinstance(value, _WORDS[key])]
        if not wrong and not all(isinstance(unit, str) for unit in about["units"].values()):
            wrong = ["units"]
        for found in meta.get("findings", ()) if not wrong else ():
            known = isinstance(found, dict) and isinstance(found.get("figures", {}), dict)
            if not known or not all(
                isinstance(found.get(k), str) for k in ("level", "code", "text")
            ):
                wrong = ["findings"]
        if wrong:
            raise DataError(
                f"{path}: canonical log whose '{wrong[0]}' is missing or damaged; write the file"
                " again"
            )
        columns: dict[str, np.ndarray] = {}
        for name in table.column_names:
            values = table.column(name).to_numpy()
            if values.dtype.kind not in "fiub":
                raise DataError(
                    f"{path}: column '{name}' holds no numbers ({values.dtype}); the file is"
                    " damaged, write it again"
                )
            if name in columns:
                raise DataError(f"{path}: column '{name}' stands twice; write the file again")
            kind = bool if name.startswith("mask:") else np.float64
            columns[name] = np.asarray(values, dtype=kind)
        if "t" not in columns:
            raise DataError(f"{path}: canonical log without a column 't'; write the file again")
        masks = {n.removeprefix("mask:"): c for n, c in columns.items() if n.startswith("mask:")}
        channels = {n: c for n, c in columns.items() if n != "t" and not n.startswith("mask:")}
        return cls(
            about["name"],
            columns["t"],
            channels,
            about["units"],
            about["manoeuvre"],
            masks,
            about["meta"],
        )

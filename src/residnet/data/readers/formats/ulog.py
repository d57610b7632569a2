"""PX4 flight logs (ULog), through the package pyulog."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import ClassVar, Literal, final

import numpy as np

from residnet.core.errors import UsageError
from residnet.data.readers.base import package, readable, require_file
from residnet.data.readers.compose import RecordingConfig
from residnet.data.readers.recording import (
    EVERYTHING,
    Recording,
    Remark,
    Rows,
    Stamps,
    Wanted,
    recording_of,
    remark,
)


@final
class UlogConfig(RecordingConfig):
    """A PX4 ULog file.

    A series is named by its message (`vehicle_local_position`, the second instance
    `vehicle_gps_position_1`).

    Fields bear PX4's names; the parts of a quaternion `q[0]` to `q[3]` are `q.w`, `q.x`, `q.y`,
    `q.z` too, whole-number latitudes in 1e-7 deg become degrees.
    """

    kind: Literal["ulog"] = "ulog"
    endings: ClassVar = (".ulg",)
    formats: ClassVar = {"PX4 ULog": lambda path, head: head.startswith(b"ULog\x01\x12\x35")}

    def load(self, path: Path, wanted: Wanted = EVERYTHING) -> Recording:
        """Read the wanted messages of a ULog, on the boot clock.

        Dated by the receiver's UTC where it logged one.
        """
        require_file(path)
        with package("px4", "pyulog", "a PX4 flight log"):
            from pyulog import ULog
        # pyulog prints what it finds damaged, which the remarks say below
        with readable(path, "a ULog file"), contextlib.redirect_stdout(io.StringIO()):
            log = ULog(str(path), None, disable_str_exceptions=True)
        data = {
            one.name + (f"_{one.multi_id}" if one.multi_id else ""): one for one in log.data_list
        }
        chosen = {
            name: one.data
            for name, one in sorted(data.items())
            if wanted(name) and len(one.data.get("timestamp", ()))
        }
        if not chosen:
            raise UsageError(
                f"{path}: none of its messages is wanted (it holds"
                f" {', '.join(sorted(data)) or 'none'})"
            )
        boot = _boot_time([one.data for one in log.data_list])
        topics = {}
        for name, raw in chosen.items():
            ns = raw["timestamp"].astype(np.int64) * 1000 + (boot or 0)
            fields = {p: v for p, v in _fields(raw).items() if wanted.field(name, p)}
            kind = f"px4/{data[name].name}"
            topics[name] = Rows(kind, fields, Stamps(ns, boot is not None))
        remarks: list[Remark] = []
        if log.file_corruption:
            text = "the file is damaged in places; messages there are lost"
            remarks.append(remark("will mislead", "damaged", text))
        if log.dropouts:
            lost, count = sum(one.duration for one in log.dropouts) * 1e-3, len(log.dropouts)
            text = f"the logger dropped data {count} times, {lost:.3g} s in all; gaps stay gaps"
            remarks.append(remark("note", "dropouts", text, dropouts=count, seconds=lost))
        return recording_of(path, topics, (path,), remarks, sorted(data.keys() - topics))


def _boot_time(messages: list[dict[str, np.ndarray]]) -> int | None:
    """Return Unix time of the boot in ns, from the first fix that has UTC."""
    for fields in messages:
        utc = fields.get("time_utc_usec")
        known = np.flatnonzero(utc) if utc is not None else np.zeros(0, dtype=int)
        if utc is not None and known.size:
            return (int(utc[known[0]]) - int(fields["timestamp"][known[0]])) * 1000
    return None


def _fields(data: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    out = {}
    for name, values in data.items():
        if name != "timestamp":
            whole = values.dtype.kind in "iu" and name in ("lat", "lon")
            out[name] = values.astype(np.float64) * (1e-7 if whole else 1.0)
    parts = {f"q.{letter}": f"q[{i}]" for i, letter in enumerate("wxyz")}
    return out | {part: out[name] for part, name in parts.items() if name in out}

"""Reader of PX4 flight logs (ULog), with the package pyulog."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import ClassVar, Literal, final

import numpy as np

from residnet.core.errors import UsageError
from residnet.core.log import Remark, make_remark
from residnet.io.readers.base import optional_import, require_file, wrap_read_errors
from residnet.io.readers.compose import RecordingConfig
from residnet.io.readers.recording import (
    ALL_FIELDS,
    FieldFilter,
    RawSeries,
    Recording,
    TimeStamps,
    build_recording,
)


@final
class UlogConfig(RecordingConfig):
    """Reader of PX4 ULog files.

    A series has the name of its message (`vehicle_local_position`, the second instance
    `vehicle_gps_position_1`). Fields have the names of PX4. The parts `q[0]` to `q[3]` of a
    quaternion are also called `q.w`, `q.x`, `q.y`, `q.z`. Integer latitudes and longitudes in
    1e-7 deg become degrees.
    """

    kind: Literal["ulog"] = "ulog"
    endings: ClassVar = (".ulg",)
    formats: ClassVar = {"PX4 ULog": lambda path, head: head.startswith(b"ULog\x01\x12\x35")}

    def load(self, path: Path, field_filter: FieldFilter = ALL_FIELDS) -> Recording:
        """Read messages of a ULog file.

        Times are those since boot, completed with the date of the receiver if it was logged.
        """
        require_file(path)
        with optional_import("px4", "pyulog", "a PX4 flight log"):
            from pyulog import ULog
        # pyulog prints messages on damaged parts; the remarks below report them
        with wrap_read_errors(path, "a ULog file"), contextlib.redirect_stdout(io.StringIO()):
            log = ULog(str(path), None, disable_str_exceptions=True)
        data = {
            dataset.name + (f"_{dataset.multi_id}" if dataset.multi_id else ""): dataset
            for dataset in log.data_list
        }
        selected = {
            name: dataset.data
            for name, dataset in sorted(data.items())
            if field_filter(name) and len(dataset.data.get("timestamp", ()))
        }
        if not selected:
            raise UsageError(
                f"{path}: has none of the configured messages (it contains"
                f" {', '.join(sorted(data)) or 'none'})"
            )
        boot_ns = _find_boot_time([dataset.data for dataset in log.data_list])
        topics = {}
        for name, raw_fields in selected.items():
            ns = raw_fields["timestamp"].astype(np.int64) * 1000 + (boot_ns or 0)
            fields = {
                p: v
                for p, v in _convert_fields(raw_fields).items()
                if field_filter.accepts_field(name, p)
            }
            message_type = f"px4/{data[name].name}"
            topics[name] = RawSeries(message_type, fields, TimeStamps(ns, boot_ns is not None))
        remarks: list[Remark] = []
        if log.file_corruption:
            text = "parts of the file are damaged; their messages are lost"
            remarks.append(make_remark("will mislead", "damaged", text))
        if log.dropouts:
            lost_seconds = sum(dataset.duration for dataset in log.dropouts) * 1e-3
            count = len(log.dropouts)
            text = f"the logger dropped data {count} times, {lost_seconds:.3g} s in total"
            remarks.append(
                make_remark("note", "dropouts", text, dropouts=count, seconds=lost_seconds)
            )
        return build_recording(path, topics, (path,), remarks, sorted(data.keys() - topics))


def _find_boot_time(messages: list[dict[str, np.ndarray]]) -> int | None:
    """Return the Unix time of the boot in ns from the first fix with UTC, or None."""
    for fields in messages:
        utc = fields.get("time_utc_usec")
        valid_rows = np.flatnonzero(utc) if utc is not None else np.zeros(0, dtype=int)
        if utc is not None and valid_rows.size:
            return (int(utc[valid_rows[0]]) - int(fields["timestamp"][valid_rows[0]])) * 1000
    return None


def _convert_fields(data: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Convert fields to float64 and integer positions to degrees, and name quaternion parts."""
    fields = {}
    for name, values in data.items():
        if name != "timestamp":
            is_integer_degrees = values.dtype.kind in "iu" and name in ("lat", "lon")
            fields[name] = values.astype(np.float64) * (1e-7 if is_integer_degrees else 1.0)
    parts = {f"q.{letter}": f"q[{i}]" for i, letter in enumerate("wxyz")}
    return fields | {part: fields[name] for part, name in parts.items() if name in fields}

"""Reader of PX4 flight logs (ULog), through the package pyulog."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Any, Literal, final

import numpy as np

from residnet.core.errors import DataError, UsageError
from residnet.data.readers.base import require_file
from residnet.data.readers.composing.composed import RecordingConfig
from residnet.data.readers.composing.wanted import EVERYTHING, Wanted
from residnet.data.readers.files import missing_package
from residnet.data.readers.recording import Recording, Remark, Series, remark


@final
class UlogConfig(RecordingConfig):
    """A PX4 ULog file.

    A series is named by its message (`vehicle_local_position`, the second instance
    `vehicle_gps_position_1`).

    Fields bear PX4's names; the parts of a quaternion `q[0]` to `q[3]` are `q.w`, `q.x`, `q.y`,
    `q.z` too, whole-number latitudes in 1e-7 deg become degrees.
    """

    kind: Literal["ulog"] = "ulog"

    def load(self, path: Path, wanted: Wanted) -> Recording:
        """Read the wanted messages of a ULog."""
        return load_ulog(path, wanted)


def load_ulog(path: Path, wanted: Wanted = EVERYTHING) -> Recording:
    """Return the recording in a ULog file, on the boot clock.

    Dated by the receiver's UTC where it logged one.

    Raises:
        UsageError: where the file is missing, nothing in it is wanted, or pyulog is not installed.
        DataError: where it cannot be read.
    """
    log = _opened(path)
    names = {
        id(data): data.name + (f"_{data.multi_id}" if data.multi_id else "")
        for data in log.data_list
    }
    chosen = [
        data
        for data in log.data_list
        if wanted(names[id(data)]) and len(data.data.get("timestamp", ()))
    ]
    if not chosen:
        raise UsageError(
            f"{path}: none of its messages is wanted (it holds"
            f" {', '.join(sorted(names.values())) or 'none'})"
        )
    boot = _boot_time(log.data_list)
    start = min(int(data.data["timestamp"][0]) for data in chosen) * 1000
    epoch = None if boot is None else (boot + start) // 10**9 * 10**9
    origin = 0 if boot is None or epoch is None else epoch - boot
    series = {}
    for data in sorted(chosen, key=lambda data: names[id(data)]):
        name = names[id(data)]
        ns = data.data["timestamp"].astype(np.int64) * 1000 - origin
        fields = {
            path: values for path, values in _fields(data.data).items() if wanted.field(name, path)
        }
        series[name] = Series(name, f"px4/{data.name}", fields, ns * 1e-9)
    listed = tuple(sorted(set(names.values()) - set(series)))
    return Recording(path, series, epoch, (path,), _damages(log), listed)


def _opened(path: Path) -> Any:
    """Return the file as pyulog reads it."""
    require_file(path)
    try:
        from pyulog import ULog
    except ImportError as error:
        raise missing_package("px4", "pyulog", "a PX4 flight log") from error
    try:
        # pyulog prints what it finds damaged, which the remarks say below
        with contextlib.redirect_stdout(io.StringIO()):
            return ULog(str(path), None, disable_str_exceptions=True)
    # pyulog fails in its own ways on damaged bytes
    except Exception as error:
        raise DataError(
            f"{path}: damaged or not a ULog file ({type(error).__name__}:"
            f" {' '.join(str(error).split())[:200]})"
        ) from error


def _damages(log: Any) -> tuple[Remark, ...]:
    """Return the remarks about what is lost in a file."""
    remarks: list[Remark] = []
    if log.file_corruption:
        remarks.append(
            remark(
                "will mislead", "damaged", "the file is damaged in places; messages there are lost"
            )
        )
    if log.dropouts:
        lost = sum(dropout.duration for dropout in log.dropouts) * 1e-3
        text = (
            f"the logger dropped data {len(log.dropouts)} times, {lost:.3g} s in all; gaps stay"
            " gaps"
        )
        remarks.append(remark("note", "dropouts", text, dropouts=len(log.dropouts), seconds=lost))
    return tuple(remarks)


def _boot_time(messages: list[Any]) -> int | None:
    """Return Unix time of the boot in ns, from the first fix that has UTC."""
    for data in messages:
        utc = data.data.get("time_utc_usec")
        known = np.flatnonzero(utc) if utc is not None else np.zeros(0, dtype=int)
        if known.size:
            i = int(known[0])
            return (int(utc[i]) - int(data.data["timestamp"][i])) * 1000
    return None


def _fields(data: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the numbers of a message as float64."""
    out = {}
    for name, values in data.items():
        if name == "timestamp":
            continue
        whole = values.dtype.kind in "iu" and name in ("lat", "lon")
        out[name] = values.astype(np.float64) * (1e-7 if whole else 1.0)
    for part, letter in enumerate("wxyz"):
        if f"q[{part}]" in out:
            out[f"q.{letter}"] = out[f"q[{part}]"]
    return out

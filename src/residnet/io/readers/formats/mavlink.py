"""Reader of MAVLink telemetry logs (tlog) of ground stations, with the package pymavlink."""

from __future__ import annotations

import contextlib
import io
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal, final

import numpy as np

from residnet.core.errors import DataError
from residnet.core.log import Remark, make_remark
from residnet.io.readers.base import (
    REPORT_INTERVAL,
    optional_import,
    reading_progress,
    require_file,
    wrap_read_errors,
)
from residnet.io.readers.compose import RecordingConfig
from residnet.io.readers.recording import (
    ALL_FIELDS,
    FieldFilter,
    MessageBuffer,
    RawSeries,
    Recording,
    TimeStamps,
    build_recording,
)

_BOOT_CLOCKS_NS = {"time_boot_ms": 1_000_000, "time_usec": 1_000}
"""Field with the time since the autopilot's start -> its unit in ns."""
_MAX_BOOT_NS = 10**17
"""Times from here on (three years) are Unix time, which some autopilots send in time_usec."""
_UNIT_FACTORS = {
    "degE7": 1e-7,
    "cdeg": 1e-2,
    "cdeg/s": 1e-2,
    "mrad/s": 1e-3,
    "cm/s": 1e-2,
    "cm": 1e-2,
    "mm": 1e-3,
}
"""Unit of a field in the definition of its message -> factor to deg, rad, m and s."""
_UNKNOWN_UINT16 = 65_535
"""Value of directions and speeds of 16 bits that means unknown."""
_START_MARKS = (0xFE, 0xFD)
"""First bytes of messages of MAVLink 1 and 2, after the eight bytes of the time."""
_GROUND_STATION = 255
"""Usual system number of a ground station."""
_NOT_RECORDED = ("BAD_DATA", "UNKNOWN")


def _contains_messages(path: Path, head: bytes) -> bool:
    """Return whether a file has the extension of a tlog and begins like one."""
    return path.suffix.lower() == ".tlog" and len(head) > 8 and head[8] in _START_MARKS


@dataclass
class _SystemMessages:
    """Messages of one kind from one system.

    Attributes:
        buffer: times of arrival in ns, and numbers.
        boot_ns: times since the start of the system in ns; -1 if the message has none.
    """

    buffer: MessageBuffer
    boot_ns: array[int] = field(default_factory=lambda: array("q"))


@final
class MavlinkConfig(RecordingConfig):
    """Reader of MAVLink telemetry logs (tlog).

    A series has the name of its message (`GLOBAL_POSITION_INT`, `ATTITUDE`). Messages of other
    vehicles have the number of their system in the name (`ATTITUDE_2`); messages of ground stations
    are omitted. Fields are converted to deg, rad, m, m/s, by the units in the definitions of the
    messages.
    """

    kind: Literal["mavlink"] = "mavlink"
    endings: ClassVar = (".tlog",)
    formats: ClassVar = {"MAVLink telemetry log": _contains_messages}

    def load(self, path: Path, field_filter: FieldFilter = ALL_FIELDS) -> Recording:
        """Read messages of a telemetry log.

        The time of a message is the autopilot's time since its start plus the Unix time of the
        start, which is estimated from the clock of the ground station. If messages have no such
        time, or the autopilot was restarted, the time of arrival at the ground station is used.
        """
        require_file(path)
        with optional_import("ardupilot", "pymavlink", "a MAVLink telemetry log"):
            from pymavlink import mavutil
        messages: dict[tuple[int, str], _SystemMessages] = {}
        n_damaged = 0
        discarded_output = io.StringIO()
        with (
            wrap_read_errors(path, "a MAVLink telemetry log"),
            reading_progress(path.name, path.stat().st_size, 100.0) as advance,
            contextlib.closing(mavutil.mavlogfile(str(path))) as reader,
        ):
            for count in _count_forever():
                # pymavlink prints bytes that it cannot parse and skips them
                with contextlib.redirect_stdout(discarded_output):
                    message = reader.recv_msg()
                if message is None:
                    break
                if count % REPORT_INTERVAL == 0:
                    advance(reader.percent)
                name = message.get_type()
                n_damaged += name == "BAD_DATA"
                if name.startswith(_NOT_RECORDED) or message.get_srcSystem() == _GROUND_STATION:
                    continue
                _add_message(messages, message)
        if not messages:
            raise DataError(
                f"{path}: has no message of a vehicle, a MAVLink telemetry log was expected; leave"
                " the file out"
            )
        return _build_recording(path, messages, n_damaged, field_filter)


def _count_forever() -> Iterator[int]:
    count = 0
    while True:
        count += 1
        yield count


def _add_message(messages: dict[tuple[int, str], _SystemMessages], message: Any) -> None:
    """Append the numbers of a message in deg, rad, m and s; elements of arrays are fields."""
    units = getattr(message, "fieldunits_by_name", {})
    values: dict[str, float] = {}
    boot_ns = -1
    for name in message.get_fieldnames():
        value = getattr(message, name)
        if name in _BOOT_CLOCKS_NS:
            boot_ns = int(value) * _BOOT_CLOCKS_NS[name]
            continue
        elements = value if isinstance(value, list | tuple) else [value]
        for index, element in enumerate(elements):
            if isinstance(element, bool) or not isinstance(element, int | float):
                continue
            number = float(element) * _UNIT_FACTORS.get(units.get(name, ""), 1.0)
            if element == _UNKNOWN_UINT16 and units.get(name) in _UNIT_FACTORS:
                number = float("nan")
            values[f"{name}[{index}]" if isinstance(value, list | tuple) else name] = number
    if not values:
        return
    key = (int(message.get_srcSystem()), str(message.get_type()))
    if key not in messages:
        messages[key] = _SystemMessages(MessageBuffer(values))
    series = messages[key]
    arrival_ns = round(float(message._timestamp) * 1e6) * 1000
    series.buffer.add(arrival_ns, [values.get(name, np.nan) for name in series.buffer.names])
    series.boot_ns.append(boot_ns if boot_ns < _MAX_BOOT_NS else -1)


def _build_recording(
    path: Path,
    messages: dict[tuple[int, str], _SystemMessages],
    n_damaged: int,
    field_filter: FieldFilter,
) -> Recording:
    """Build a recording; the system with most messages has the plain names."""
    n_by_system: dict[int, int] = {}
    for (system, _), series in messages.items():
        n_by_system[system] = n_by_system.get(system, 0) + len(series.boot_ns)
    vehicle = max(n_by_system, key=lambda system: n_by_system[system])
    remarks: list[Remark] = []
    if n_damaged:
        text = f"{n_damaged} damaged messages are left out"
        remarks.append(make_remark("note", "bad_lines", text, lines=n_damaged))
    starts = {system: _estimate_start(messages, system) for system in n_by_system}
    topics: dict[str, RawSeries] = {}
    unread = []
    for (system, kind), series in sorted(messages.items()):
        name = kind if system == vehicle else f"{kind}_{system}"
        if not field_filter(name):
            unread.append(name)
            continue
        boot_ns = np.frombuffer(series.boot_ns, dtype=np.int64)
        start_ns = starts[system]
        is_timed = start_ns is not None and bool((boot_ns >= 0).all())
        stamp = TimeStamps(boot_ns + (start_ns or 0), True) if is_timed else None
        arrival = None if is_timed else TimeStamps(series.buffer.times, True)
        topics[name] = RawSeries(f"mavlink/{kind}", series.buffer.fields, stamp, arrival)
    return build_recording(path, topics, (path,), remarks, unread)


def _estimate_start(messages: dict[tuple[int, str], _SystemMessages], system: int) -> int | None:
    """Return the Unix time in ns of a system's start: the median of arrival minus time since start.

    Returns:
        None if no message has a time since the start, or the system was restarted in the log.
    """
    offsets = []
    for (other_system, _), series in messages.items():
        boot_ns = np.frombuffer(series.boot_ns, dtype=np.int64)
        if other_system == system and (boot_ns >= 0).all():
            if (np.diff(boot_ns) < 0).any():
                return None
            offsets.append(series.buffer.times - boot_ns)
    return int(np.median(np.concatenate(offsets))) if offsets else None

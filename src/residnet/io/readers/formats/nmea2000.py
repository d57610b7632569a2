"""Reader of NMEA 2000 frames in text files, with the package nmea2000.

The package contains the public database of parameter groups (PGN) of the project CANboat.
"""

from __future__ import annotations

import re
from array import array
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal, final

import numpy as np

from residnet.core.errors import DataError
from residnet.core.log import Remark, make_remark
from residnet.core.stretches import find_run_bounds
from residnet.io.readers.base import (
    REPORT_INTERVAL,
    optional_import,
    reading_progress,
    require_file,
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
from residnet.io.readers.text_encoding import detect_encoding_of_head, open_as_utf8
from residnet.io.readers.timestamps import parse_texts

_HEX = r"[0-9A-Fa-f]"
# `candump -L` and `candump -l` join identifier and data, `candump` and `candump -x` separate them
_CANDUMP_LINE = re.compile(
    rf"^\s*(?:\((?P<time>[^)]+)\)\s+)?[A-Za-z]\w*\s+(?:[RT]X\s+\S\s+\S\s+)?(?P<id>{_HEX}{{8}})"
    rf"(?:#(?P<joined>{_HEX}+)|\s+\[\d+\]\s+(?P<bytes>{_HEX}{{2}}(?:\s+{_HEX}{{2}})*))"
)
# raw text of the gateways of Yacht Devices (YDWG, YDEN, YDVR)
_YACHT_DEVICES_LINE = re.compile(
    rf"^\s*(?P<time>(?:\d{{4}}-\d\d-\d\d[ T])?\d\d:\d\d:\d\d\.\d+)\s+[RT]\s+(?P<id>{_HEX}{{8}})"
    rf"\s+(?P<bytes>{_HEX}{{2}}(?:\s+{_HEX}{{2}})*)\s*$"
)
# "N2K ASCII" of the gateways of Actisense, with complete messages
_ACTISENSE_LINE = re.compile(
    rf"^\s*A(?P<time>\d{{6}}(?:\.\d+)?)\s+(?P<header>{_HEX}{{5}})\s+(?P<group>{_HEX}{{5,6}})"
    rf"\s+(?P<joined>{_HEX}+)\s*$"
)
# plain text of CANboat's programs: time, priority, group, source, destination, length, bytes
_CANBOAT_LINE = re.compile(
    r"^\s*(?P<time>\d{4}-\d\d-\d\d[T ,-]\d\d:\d\d:\d\d(?:[.,]\d+)?Z?),(?P<priority>\d),"
    rf"(?P<group>\d{{4,6}}),(?P<source>\d+),(?P<destination>\d+),\d+,"
    rf"(?P<bytes>{_HEX}{{2}}(?:,{_HEX}{{2}})*)\s*$"
)
_LINES = (_CANDUMP_LINE, _YACHT_DEVICES_LINE, _ACTISENSE_LINE, _CANBOAT_LINE)
_HEAD_BYTES = 1024
"""Number of bytes from which format and encoding are detected (some twenty frames)."""
_MAX_FRAME_BYTES = 8
"""Number of data bytes of a CAN frame; longer lines hold a complete message."""
_PDU2_MIN = 240
"""Smallest third byte of the identifiers of groups without a destination (ISO 11783-3)."""
_NUMBER_TYPES = ("NUMBER", "FLOAT", "DECIMAL", "LOOKUP", "DURATION")
_DAY_NS = 86_400 * 10**9
_FRAME_NS = 250_000
"""Shortest duration of a frame with eight bytes at 250 kbit/s."""
_MIN_UNIX_NS = 10**8 * 10**9
"""Unix time in ns (in 1973) below which the times of `candump` count from its start."""
_MAX_BACKWARD_SHARE = 0.2
"""Share of steps backwards above which times are differences between frames (`candump -t d`)."""
_MAGNETIC_CODE = 1
"""Code of magnetic directions in the fields `reference` and `cogReference`."""
_DIRECTIONS = {
    "vesselHeading": ("heading", "reference"),
    "cogSogRapidUpdate": ("cog", "cogReference"),
}
"""Message -> field of its direction and field of the north that the direction refers to."""
_DATED_MESSAGES = ("systemTime", "gnssPositionData", "timeDate")
_INSTANCE_MESSAGES = {
    "engineParametersRapidUpdate": "instance",
    "rudder": "instance",
    "electricDriveStatusRapidUpdate": "inverterMotorController",
}
"""Message of one of several devices on board -> field with the number of the device."""


def _contains_frames(path: Path, head: bytes) -> bool:
    """Return whether the first bytes of a file contain two frames in a notation of this reader."""
    text = head.decode(detect_encoding_of_head(head), errors="replace")
    n_frames = sum(any(line.match(row) for line in _LINES) for row in text.splitlines())
    return n_frames > 1


@final
class Nmea2000Config(RecordingConfig):
    """Reader of NMEA 2000 frames as text, one on each line.

    Notations: `candump` of Linux (with times), raw text of Yacht Devices gateways, N2K ASCII of
    Actisense gateways, plain text of CANboat. A series has the name of its message in the database
    of CANboat (`vesselHeading`, `positionRapidUpdate`); if several devices send one message, those
    with fewer messages have their address in the name (`vesselHeading_35`). Fields have the names
    and units of the database: rad, m/s, rev/min, latitudes in deg. Messages of AIS about other
    vessels are left out.
    """

    kind: Literal["nmea2000"] = "nmea2000"
    endings: ClassVar = (".n2k", ".candump", ".log")
    formats: ClassVar = {"NMEA 2000": _contains_frames}

    def load(self, path: Path, field_filter: FieldFilter = ALL_FIELDS) -> Recording:
        """Read the frames of a text file.

        Times are those before the frames. Times of day are completed with the date of the first
        message that has one.
        """
        require_file(path)
        with optional_import("nmea2000", "nmea2000", "a file of NMEA 2000 frames"):
            from nmea2000 import NMEA2000Decoder
        messages = _Messages(NMEA2000Decoder)
        with path.open("rb") as stream:
            encoding = detect_encoding_of_head(stream.read(_HEAD_BYTES))
        size = path.stat().st_size
        bytes_read = 0
        with (
            open_as_utf8(path, encoding) as file,
            file.open("r", encoding="utf-8", errors="replace") as lines,
            reading_progress(path.name, size, size) as advance,
        ):
            for count, line in enumerate(lines):
                bytes_read += len(line)
                if count % REPORT_INTERVAL == 0:
                    advance(min(bytes_read, size))
                messages.add_line(line)
        return messages.to_recording(path, field_filter)


@dataclass
class _Frame:
    """One line of a file.

    Attributes:
        time: text of the time; empty if the line has none.
        group: number of the parameter group (PGN).
        text: identifier and data in the notation of the decoder.
        is_complete: whether the line holds a complete message instead of one CAN frame.
    """

    time: str
    group: int
    text: str
    is_complete: bool


def _parse_line(line: str) -> _Frame | None:
    """Parse one line in any of the notations; None for other lines."""
    match = next((found for pattern in _LINES if (found := pattern.match(line))), None)
    if match is None:
        return None
    parts = match.groupdict()
    data = re.sub(r"[\s,]", "", parts.get("joined") or parts.get("bytes") or "")
    time = parts["time"] or ""
    if match.re is _ACTISENSE_LINE:
        time = f"{time[:2]}:{time[2:4]}:{time[4:]}"
        text = f"{parts['header']} {parts['group']} {data}"
        return _Frame(time, int(parts["group"], 16), text, True)
    if match.re is _CANBOAT_LINE:
        time = f"{time[:10]}T{time[11:].replace(',', '.')}"
        group = int(parts["group"])
        priority, source, destination = (
            int(parts[name]) for name in ("priority", "source", "destination")
        )
        if len(data) > 2 * _MAX_FRAME_BYTES:
            header = f"{source & 0xFF:02X}{destination & 0xFF:02X}{priority & 0xF:X}"
            return _Frame(time, group, f"{header} {group:05X} {data}", True)
        # groups below 240 in their third byte carry the destination in the lowest byte
        low_byte = 0 if (group >> 8) & 0xFF >= _PDU2_MIN else destination & 0xFF
        can_id = priority << 26 | (group | low_byte) << 8 | source & 0xFF
    else:
        can_id = int(parts["id"], 16) & 0x1FFFFFFF
        group = can_id >> 8 & 0x3FFFF
        group = group if (group >> 8) & 0xFF >= _PDU2_MIN else group & 0x3FF00
    byte_pairs = " ".join(data[i : i + 2] for i in range(0, len(data) - 1, 2))
    return _Frame(time, group, f"{can_id:08X} {byte_pairs}", False)


@dataclass
class _DeviceMessages:
    """Messages of one kind from one device.

    Attributes:
        buffer: indices of the lines in place of times, and numbers.
    """

    buffer: MessageBuffer
    lines: array[int] = field(default_factory=lambda: array("q"))


@final
class _Messages:
    """Messages of a file by kind and address of the sender.

    Args:
        decoder: class of the decoder in the package nmea2000.
    """

    def __init__(self, decoder: Any) -> None:
        self._decoder_class = decoder
        self._frame_decoder = decoder(bound_format=_format("can_frame_ascii"))
        self._message_decoder = decoder(bound_format=_format("n2k_ascii_raw"))
        self._is_known: dict[int, bool] = {}
        self._messages: dict[tuple[str, int], _DeviceMessages] = {}
        self._times: list[str] = []
        self._dates: list[tuple[int, int]] = []
        self._code_fields: set[str] = {*_INSTANCE_MESSAGES.values()}
        self._n_other_lines = 0
        self._n_untimed = 0
        self._n_undecodable = 0
        self._unknown_groups: Counter[int] = Counter()

    def add_line(self, line: str) -> None:
        """Decode a line of the file."""
        frame = _parse_line(line)
        if frame is None:
            self._n_other_lines += bool(line.strip())
            return
        if not frame.time:
            self._n_untimed += 1
            return
        self._times.append(frame.time)
        if frame.group not in self._is_known:
            is_known = self._decoder_class.is_fast_pgn(frame.group) is not None
            self._is_known[frame.group] = is_known
        if not self._is_known[frame.group]:
            self._unknown_groups[frame.group] += 1
            return
        decoder = self._message_decoder if frame.is_complete else self._frame_decoder
        try:
            message = decoder.decode(frame.text)
        except (ValueError, TypeError):
            self._n_undecodable += 1
            return
        # None until all frames of a message have arrived
        if message is not None and not message.id.startswith("ais"):
            self._add_message(message)

    def _add_message(self, message: Any) -> None:
        """Append the numbers of a decoded message, with the codes of look-up tables.

        The codes select devices and references; the recording does not contain them.
        """
        line_index = len(self._times) - 1
        if message.id in _DATED_MESSAGES and (ns := _date_ns(message)) is not None:
            self._dates.append((line_index, ns))
        values: dict[str, float] = {}
        for entry in message.fields:
            if entry.type.name in _NUMBER_TYPES and entry.id != "sid":
                is_code = entry.type.name == "LOOKUP"
                if is_code:
                    self._code_fields.add(entry.id)
                number = entry.raw_value if is_code else entry.value
                is_number = isinstance(number, int | float)
                values[entry.id] = float(number) if is_number else float("nan")
        if not values:
            return
        key = (message.id, int(message.source))
        if key not in self._messages:
            self._messages[key] = _DeviceMessages(MessageBuffer(values))
        device = self._messages[key]
        device.buffer.add(0, [values.get(name, np.nan) for name in device.buffer.names])
        device.lines.append(line_index)

    def to_recording(self, path: Path, field_filter: FieldFilter) -> Recording:
        """Build a recording of the messages.

        Args:
            path: file.
            field_filter: filter of topics.

        Raises:
            DataError: if the file has no times or no known message.
        """
        if not self._times:
            reason = "no line has a time: record with `candump -L`" if self._n_untimed else ""
            raise DataError(
                f"{path}: has no NMEA 2000 frame with a time"
                f" ({reason or 'expected: candump -L, N2K ASCII, raw text of Yacht Devices'})"
            )
        if not self._messages:
            raise DataError(
                f"{path}: no frame has a message of the NMEA 2000 database ({len(self._times)}"
                f" frames, {len(self._unknown_groups)} unknown groups); leave the file out"
            )
        ns, is_absolute, remarks = self._parse_times(path)
        remarks += list(self._describe_losses())
        variation = self._latest_variation(ns)
        topics: dict[str, RawSeries] = {}
        unread = []
        for name, kind, device in self._name_topics():
            times = ns[np.frombuffer(device.lines, dtype=np.int64)]
            if not field_filter(name):
                unread.append(name)
                continue
            fields = device.buffer.fields
            fields, time_remarks = _add_true_direction(name, kind, fields, times, variation)
            instance = fields.get(_INSTANCE_MESSAGES.get(kind, ""))
            sender = None
            if instance is not None and np.isfinite(instance).all():
                sender = np.array([f"{number:g}" for number in instance.tolist()], dtype=object)
            topics[name] = RawSeries(
                f"nmea2000/{kind}",
                {key: column for key, column in fields.items() if key not in self._code_fields},
                arrival=TimeStamps(times, is_absolute),
                sender=sender,
                remarks=time_remarks,
            )
        return build_recording(path, topics, (path,), remarks, unread)

    def _name_topics(self) -> Iterator[tuple[str, str, _DeviceMessages]]:
        """Return name, kind and messages of each topic, the busiest device of a kind first."""
        order = sorted(self._messages.items(), key=lambda item: (item[0][0], -len(item[1].lines)))
        previous_kind = ""
        for (kind, address), device in order:
            name = kind if kind != previous_kind else f"{kind}_{address}"
            previous_kind = kind
            yield name, kind, device

    def _parse_times(self, path: Path) -> tuple[np.ndarray, bool, list[Remark]]:
        """Return the times [T] of all frames in ns, whether they are Unix time, and remarks."""
        try:
            stamps = parse_texts(np.array(self._times, dtype=object))
        except DataError as error:
            raise DataError(f"{path}: {error}") from error
        remarks: list[Remark] = list(stamps.remarks)
        ns = stamps.ns
        backward_share = float((np.diff(ns) < 0).mean()) if ns.size > 1 else 0.0
        if backward_share > _MAX_BACKWARD_SHARE and ns.max() < _MIN_UNIX_NS:
            ns = np.cumsum(ns)
            text = "the times are differences between frames (`candump -t d`); they are summed"
            remarks.append(make_remark("note", "time_differences", text))
        ns = _spread_equal_times(ns)
        is_absolute = stamps.is_absolute
        if not is_absolute and self._dates:
            # clocks of gateways are set by the same receiver and differ by zones and dates; the
            # digits and the delay of the message are no reason to shift all frames
            line_index, date_ns = self._dates[0]
            offset = (date_ns - int(ns[line_index])) / 10**9
            ns = ns + round(offset) * 10**9
            is_absolute = True
        elif not is_absolute:
            text = "no message contains a date; time counts from midnight or from the start"
            remarks.append(make_remark("note", "undated", text))
        return ns, is_absolute, remarks

    def _describe_losses(self) -> Iterator[Remark]:
        """Return remarks on lines that are not part of the recording."""
        n_bad_lines = self._n_other_lines + self._n_untimed + self._n_undecodable
        if n_bad_lines:
            text = f"{n_bad_lines} lines are no NMEA 2000 frame with a time; left out"
            yield make_remark("note", "bad_lines", text, lines=n_bad_lines)
        if self._unknown_groups:
            groups = ", ".join(str(group) for group, _ in self._unknown_groups.most_common(6))
            n_frames = self._unknown_groups.total()
            text = f"{n_frames} frames have unknown groups (PGN {groups}); left out"
            yield make_remark("note", "unknown_groups", text, frames=n_frames)

    def _latest_variation(self, ns: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Return times in ns and values in rad of the magnetic variation on the network."""
        for (kind, _), device in self._messages.items():
            if kind == "magneticVariation":
                values = device.buffer.fields["variation"]
                is_valid = np.isfinite(values)
                if is_valid.any():
                    times = ns[np.frombuffer(device.lines, dtype=np.int64)]
                    return times[is_valid], values[is_valid]
        return None


def _spread_equal_times(ns: np.ndarray) -> np.ndarray:
    """Return times [T] in ns in which frames with the same printed time follow each other.

    Frames cannot arrive at the same time on one bus; the digits of the recorder hide their order.
    """
    first_of_run, end_of_run = find_run_bounds(ns)
    n_repeats = end_of_run - first_of_run
    next_time = ns[np.minimum(end_of_run, ns.size - 1)]
    available = np.where(next_time > ns, (next_time - ns) // n_repeats, _FRAME_NS)
    spread: np.ndarray = ns + (np.arange(ns.size) - first_of_run) * np.minimum(available, _FRAME_NS)
    return spread


def _format(name: str) -> Any:
    """Return a format of the package nmea2000."""
    from nmea2000.input_formats import N2KFormat

    return N2KFormat(name)


def _date_ns(message: Any) -> int | None:
    """Return the Unix time in ns of a message with date and time of day, or None."""
    parts = {entry.id: entry.value for entry in message.fields if entry.id in ("date", "time")}
    day = parts.get("date")
    clock = parts.get("time")
    if day is None or clock is None:
        return None
    days = int(np.datetime64(day.isoformat(), "D").astype(np.int64))
    seconds = (clock.hour * 60 + clock.minute) * 60 + clock.second
    ns: int = days * _DAY_NS + seconds * 10**9
    return ns


def _add_true_direction(
    name: str,
    kind: str,
    fields: dict[str, np.ndarray],
    times: np.ndarray,
    variation: tuple[np.ndarray, np.ndarray] | None,
) -> tuple[dict[str, np.ndarray], tuple[Remark, ...]]:
    """Add the direction from true north to messages with a heading or a course.

    A magnetic direction is increased by the deviation of its message, if it has one, and by the
    variation of the message or of the network (PGN 127258).

    Args:
        name: name of the topic.
        kind: message.
        fields: fields of the topic.
        times: times [T] in ns.
        variation: times and values of the variation on the network.

    Returns:
        The fields with `<direction>True` in rad, and a remark on magnetic directions.
    """
    if kind not in _DIRECTIONS:
        return fields, ()
    direction_field, reference_field = _DIRECTIONS[kind]
    direction = fields[direction_field]
    is_magnetic = fields[reference_field] == _MAGNETIC_CODE
    if not is_magnetic.any():
        return {**fields, f"{direction_field}True": direction}, ()
    declination = fields.get("variation", np.full(times.size, np.nan))
    if variation is not None:
        network_variation = np.interp(times, *variation)
        declination = np.where(np.isfinite(declination), declination, network_variation)
    deviation = np.nan_to_num(fields.get("deviation", np.zeros(times.size)))
    if not np.isfinite(declination[is_magnetic]).any():
        text = (
            f"topic {name}: {direction_field} is magnetic, and no message has the variation; it is"
            " used as it is, so set `offset` of the heading to the declination"
        )
        remark = make_remark("will mislead", "magnetic_heading", text)
        return {**fields, f"{direction_field}True": direction}, (remark,)
    true_direction = np.where(is_magnetic, direction + deviation + declination, direction)
    mean_deg = float(np.degrees(np.nanmean(declination[is_magnetic])))
    text = (
        f"topic {name}: {direction_field} is magnetic; the variation of the network, {mean_deg:.1f}"
        " deg, is added"
    )
    remark = make_remark("note", "magnetic_heading", text, variation=np.radians(mean_deg))
    return {**fields, f"{direction_field}True": true_direction}, (remark,)

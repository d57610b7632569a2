"""Reader of NMEA 0183 sentences in text files, with the package pynmea2."""

from __future__ import annotations

import datetime
import re
from array import array
from collections.abc import Iterable
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

_SENTENCE = re.compile(rb"^(?P<before>[^$!]*)(?P<sentence>[$!][A-Z]{2}[A-Z0-9]{2,4},[\x20-\x7e]*)")
# a sentence with or without a checksum, at the start of a line or after a time
_SENTENCE_LINE = re.compile(rb"(?m)^[^$!\n]{0,40}[$!][A-Z]{2}[A-Z]{3},[\x20-\x7e]*\s*$")
# a date with a time, a time of day or Unix time in the text before a sentence
_TIME_PREFIX = re.compile(
    r"\d{1,4}[-./]\d{1,2}[-./]\d{1,4}[T ,_]+\d{1,2}:\d\d[\d:.,]*(?:Z|[-+]\d\d:?\d\d)?"
    r"|\d{1,2}:\d\d:\d\d[\d.,]*|\d{9,}(?:\.\d+)?"
)
_UNIT_FACTORS = {"rate_of_turn": 1.0 / 60.0}
"""Factors to the unit of a channel by field: NMEA 0183 has the rate of turn in deg/min."""
_DIRECTION_LETTERS = {
    "deviation": "dev_dir",
    "variation": "var_dir",
    "mag_variation": "mag_var_dir",
}
"""Angles of a compass that are negative to the west -> field with the letter E or W."""
_COMPASS_SENTENCES = ("HDG", "HDM")
"""Sentences with a magnetic heading."""
_DAY_NS = 86_400 * 10**9
_HEAD_BYTES = 1024
"""Number of bytes from which the encoding is detected (a dozen sentences)."""


def _contains_sentence(path: Path, head: bytes) -> bool:
    """Return whether the first bytes of a file contain a sentence."""
    text = head.decode(detect_encoding_of_head(head), errors="replace").encode("utf-8")
    return _SENTENCE_LINE.search(text) is not None


@final
class NmeaConfig(RecordingConfig):
    """Reader of NMEA 0183 text with one sentence per line, with or without a time before it.

    A series has the name of its sentence (`RMC`, `HDT`). Fields have the names of pynmea2;
    `latitude` and `longitude` are signed degrees, `rate_of_turn` is in deg/s (deg/min in the
    sentence), variations and deviations are positive to the east. HDG and HDM have the additional
    field `heading_true`.
    """

    kind: Literal["nmea"] = "nmea"
    endings: ClassVar = (".nmea", ".log")
    formats: ClassVar = {"NMEA 0183": _contains_sentence}

    def load(self, path: Path, field_filter: FieldFilter = ALL_FIELDS) -> Recording:
        """Read sentences of a text file.

        Times of day are completed with the date of the last RMC or ZDA sentence. Times of sentences
        without a time are interpolated between the neighbouring lines, unless every line begins
        with a time.
        """
        require_file(path)
        with optional_import("nmea", "pynmea2", "a file of NMEA 0183 sentences"):
            import pynmea2
        collector = _SentenceCollector()
        size = path.stat().st_size
        bytes_read = n_invalid = 0
        # redirected output of a Windows shell is UTF-16
        with path.open("rb") as stream:
            encoding = detect_encoding_of_head(stream.read(_HEAD_BYTES))
        with (
            open_as_utf8(path, encoding) as file,
            file.open("rb") as stream,
            reading_progress(path.name, size, size) as advance,
        ):
            for count, line in enumerate(stream):
                bytes_read += len(line)
                if count % REPORT_INTERVAL == 0:
                    advance(min(bytes_read, size))
                match = _SENTENCE.match(line)
                if match is None:
                    n_invalid += bool(line.strip())
                    continue
                prefix = match["before"].decode("ascii", errors="replace").strip(" ,;\t[]")
                stamp = _TIME_PREFIX.search(prefix)
                prefix = stamp[0].rstrip(".,:") if stamp else prefix
                try:
                    message = pynmea2.parse(match["sentence"].decode("ascii").strip())
                    collector.add_sentence(message, prefix, field_filter)
                except (pynmea2.ParseError, ValueError):
                    n_invalid += 1
        if not collector.buffers:
            raise DataError(
                f"{path}: has no NMEA 0183 sentence ({n_invalid} lines are no sentences, or have a"
                " wrong checksum)"
            )
        return collector.to_recording(path, n_invalid)


@final
class _SentenceBuffer:
    """Sentences of one type.

    Attributes:
        buffer: times in ns (-1 for sentences without a time) and numbers.
        preceding_tick: index of the last time in the file before each sentence.
        prefixes: text before each sentence.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self.buffer = MessageBuffer(names)
        self.preceding_tick = array("q")
        self.prefixes: list[str] = []


@final
class _SentenceCollector:
    """Sentences of a file by type, and the times in these sentences."""

    def __init__(self) -> None:
        self.buffers: dict[str, _SentenceBuffer] = {}
        self._ticks = array("q")
        self._day_ns: int | None = None
        self._has_date = False
        self._variation = np.nan

    def add_sentence(self, message: Any, prefix: str, field_filter: FieldFilter) -> None:
        """Append a sentence.

        Args:
            message: parsed sentence.
            prefix: text before the sentence.
            field_filter: filter of sentence types.
        """
        time_ns = self._parse_time(message)
        values: dict[str, float] = {}
        names = [str(entry[1]) for entry in message.fields]
        for name, cell in zip(names, message.data, strict=False):
            if name in ("timestamp", "datestamp", "lat", "lon"):
                continue
            try:
                values[name] = float(cell) * _UNIT_FACTORS.get(name, 1.0)
            except ValueError:
                if not cell:
                    values[name] = float("nan")
        for angle, letter_field in _DIRECTION_LETTERS.items():
            if angle in values and getattr(message, letter_field, "") == "W":
                values[angle] = -values[angle]
        name = str(message.sentence_type)
        variation = values.get("mag_variation", values.get("variation", np.nan))
        self._variation = variation if np.isfinite(variation) else self._variation
        if name in _COMPASS_SENTENCES:
            values["variation"] = self._variation
        # positions in signed degrees, NaN without a fix
        if {"lat", "lon"} <= set(names):
            has_fix = bool(message.lat and message.lon) and getattr(message, "status", "A") != "V"
            has_fix = has_fix and str(getattr(message, "gps_qual", "1")) != "0"
            position = (
                (message.latitude, message.longitude) if has_fix else (float("nan"), float("nan"))
            )
            values["latitude"], values["longitude"] = position
        if not field_filter(name) or not values:
            return
        buffer = self.buffers.setdefault(name, _SentenceBuffer(values))
        field_values = [values.get(field, np.nan) for field in buffer.buffer.names]
        buffer.buffer.add(-1 if time_ns is None else time_ns, field_values)
        buffer.preceding_tick.append(len(self._ticks) - 1)
        buffer.prefixes.append(prefix)

    def _parse_time(self, message: Any) -> int | None:
        """Return the time of a sentence in ns, or None; Unix time after the first date."""
        try:
            time_of_day = message.timestamp
            date = _sentence_date(message)
        except (AttributeError, ValueError, TypeError):
            return None
        if not isinstance(time_of_day, datetime.time):
            return None
        seconds = (time_of_day.hour * 60 + time_of_day.minute) * 60 + time_of_day.second
        ns = seconds * 10**9 + time_of_day.microsecond * 1000
        if date is not None:
            self._day_ns = (date - datetime.date(1970, 1, 1)).days * _DAY_NS
            self._has_date = True
        day = self._day_ns or 0
        if self._ticks and date is None and day + ns < self._ticks[-1] - _DAY_NS // 2:
            # midnight before the next sentence with a date
            day = self._day_ns = day + _DAY_NS
        if not self._ticks or day + ns != self._ticks[-1]:
            self._ticks.append(day + ns)
        return day + ns

    def to_recording(self, path: Path, n_invalid: int) -> Recording:
        """Build a recording of all sentences.

        Args:
            path: file.
            n_invalid: number of lines that are no valid sentences.

        Raises:
            DataError: if no sentence and not every line has a time.
        """
        ticks = np.frombuffer(self._ticks, dtype=np.int64)
        has_prefix_times = all(all(buffer.prefixes) for buffer in self.buffers.values())
        if not ticks.size and not has_prefix_times:
            raise DataError(
                f"{path}: no sentence contains a time (RMC, GGA, ZDA, ...), and the lines do not"
                " begin with one; record one of these sentences"
            )
        remarks: list[Remark] = []
        if n_invalid:
            text = f"{n_invalid} lines are no NMEA sentence or have a wrong checksum; left out"
            remarks.append(make_remark("note", "bad_lines", text, lines=n_invalid))
        arrivals = {
            name: parse_texts(np.array(buffer.prefixes, dtype=object))
            for name, buffer in self.buffers.items()
            if has_prefix_times
        }
        prefix_starts = [int(stamps.ns.min()) for stamps in arrivals.values() if stamps.is_absolute]
        day_offset = 0
        if ticks.size and not self._has_date:
            if prefix_starts:
                # take the date from the times before the sentences
                day_offset = round((min(prefix_starts) - int(ticks[0])) / _DAY_NS) * _DAY_NS
            else:
                text = "no sentence contains a date; time counts from midnight"
                remarks.append(make_remark("note", "undated", text))
        topics = {}
        for name, buffer in sorted(self.buffers.items()):
            times = buffer.buffer.times
            time_remarks: tuple[Remark, ...] = ()
            is_timed = bool((times >= 0).all())
            if not is_timed and not has_prefix_times:
                times = _interpolate_times(
                    np.frombuffer(buffer.preceding_tick, dtype=np.int64), ticks
                )
                text = (
                    f"topic {name}: its sentences have no time; it is interpolated between the"
                    " sentences before and after"
                )
                time_remarks = (make_remark("note", "estimated_times", text, rows=times.size),)
            stamp = (
                TimeStamps(times + day_offset, self._has_date or bool(prefix_starts))
                if is_timed or not has_prefix_times
                else None
            )
            fields = buffer.buffer.fields
            if name in _COMPASS_SENTENCES:
                fields, compass_remark = _add_true_heading(name, fields)
                time_remarks = (*time_remarks, compass_remark)
            sender = _engine_numbers(fields)
            topics[name] = RawSeries(
                f"nmea/{name}", fields, stamp, arrivals.get(name), sender, time_remarks
            )
        return build_recording(path, topics, (path,), remarks)


def _add_true_heading(
    name: str, fields: dict[str, np.ndarray]
) -> tuple[dict[str, np.ndarray], Remark]:
    """Add the field `heading_true` to sentences of a magnetic compass.

    The heading is increased by the deviation and the variation (NMEA 0183, sentence HDG).

    Args:
        name: type of the sentences.
        fields: their fields; those of HDM have the variation of the last HDG or RMC sentence.

    Returns:
        The fields, and a remark on the variation.
    """
    heading = fields["heading"] + np.nan_to_num(fields.get("deviation", np.zeros(1)))
    variation = fields["variation"]
    if not np.isfinite(variation).any():
        text = (
            f"topic {name}: heading is magnetic, and no sentence has the variation; it is used as"
            " it is, so set `offset` of the heading to the declination"
        )
        remark = make_remark("will mislead", "magnetic_heading", text)
        return {**fields, "heading_true": heading}, remark
    mean = float(np.nanmean(variation))
    text = (
        f"topic {name}: heading is magnetic; its deviation and the variation, {mean:.1f} deg, are"
        " added"
    )
    remark = make_remark("note", "magnetic_heading", text, variation=np.radians(mean))
    return {**fields, "heading_true": heading + np.nan_to_num(variation, nan=mean)}, remark


def _engine_numbers(fields: dict[str, np.ndarray]) -> np.ndarray | None:
    """Return the engine number of each row [T] as text; None if the sentence has none."""
    number = fields.get("engine_no")
    if number is None or not np.isfinite(number).all():
        return None
    return np.array([f"{value:g}" for value in number.tolist()], dtype=object)


def _interpolate_times(tick_index: np.ndarray, ticks: np.ndarray) -> np.ndarray:
    """Interpolate the times of sentences without a time.

    Args:
        tick_index: index of the last time before each sentence [T].
        ticks: times in the file [K] in ns.

    Returns:
        Times [T] in ns, evenly spaced between the times before and after.
    """
    tick_index = np.clip(tick_index, 0, ticks.size - 1)
    order_in_group = np.arange(tick_index.size) - find_run_bounds(tick_index)[0]
    _, group, count = np.unique(tick_index, return_inverse=True, return_counts=True)
    median_tick = np.median(np.diff(ticks)) if ticks.size > 1 else 10**9
    interval = np.append(np.diff(ticks), median_tick)[tick_index]
    times: np.ndarray = ticks[tick_index] + np.rint(
        interval * order_in_group / count[group]
    ).astype(np.int64)
    return times


def _sentence_date(message: Any) -> datetime.date | None:
    """Return the date of an RMC or ZDA sentence, or None."""
    if message.sentence_type == "RMC":
        day = message.datestamp
        return day if isinstance(day, datetime.date) else None
    if message.sentence_type == "ZDA":
        return datetime.date(int(message.year), int(message.month), int(message.day))
    return None

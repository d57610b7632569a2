"""NMEA 0183 sentences in text files, through the package pynmea2."""

from __future__ import annotations

import datetime
import re
from array import array
from collections.abc import Iterable
from pathlib import Path
from typing import Any, ClassVar, Literal, final

import numpy as np

from residnet.core.errors import DataError
from residnet.core.stretches import stretch_bounds
from residnet.data.readers.base import REPORT_EVERY, package, progress, require_file
from residnet.data.readers.compose import RecordingConfig
from residnet.data.readers.recording import (
    EVERYTHING,
    Columns,
    Recording,
    Remark,
    Rows,
    Stamps,
    Wanted,
    recording_of,
    remark,
)
from residnet.data.readers.texts import as_utf8, encoding_of_head
from residnet.data.readers.written import parse_texts

_SENTENCE = re.compile(rb"^(?P<before>[^$!]*)(?P<sentence>[$!][A-Z]{2}[A-Z0-9]{2,4},[\x20-\x7e]*)")
# a sentence, to its checksum where it has one, at the start of a line or behind a time
_WHOLE = re.compile(rb"(?m)^[^$!\n]{0,40}[$!][A-Z]{2}[A-Z]{3},[\x20-\x7e]*\s*$")
# a date with a time, a time of day or Unix time, among what else a recorder writes
_STAMP = re.compile(
    r"\d{1,4}[-./]\d{1,2}[-./]\d{1,4}[T ,_]+\d{1,2}:\d\d[\d:.,]*(?:Z|[-+]\d\d:?\d\d)?"
    r"|\d{1,2}:\d\d:\d\d[\d.,]*|\d{9,}(?:\.\d+)?"
)
_PER_MINUTE = {"rate_of_turn": 1.0 / 60.0}
_DAY = 86_400 * 10**9
_HEAD = 1024
"""Bytes that tell the encoding: a dozen sentences."""


def _holds_sentence(path: Path, head: bytes) -> bool:
    text = head.decode(encoding_of_head(head), errors="replace").encode("utf-8")
    return _WHOLE.search(text) is not None


@final
class NmeaConfig(RecordingConfig):
    """NMEA 0183 text, one sentence per line, with or without a time in front of it.

    A series is named by its sentence (`RMC`, `HDT`).

    Fields bear the names of pynmea2; `latitude` and `longitude` are in signed degrees,
    `rate_of_turn` is in deg/s (the sentence has deg/min).
    """

    kind: Literal["nmea"] = "nmea"
    endings: ClassVar = (".nmea", ".log")
    formats: ClassVar = {"NMEA 0183": _holds_sentence}

    def load(self, path: Path, wanted: Wanted = EVERYTHING) -> Recording:
        """Read the wanted sentences of a text file.

        Sentences with a time of day are dated by the last RMC or ZDA; those without a time lie
        between the ones around them in the order of the lines, unless every line begins with a time
        of its own.
        """
        require_file(path)
        with package("nmea", "pynmea2", "a file of NMEA 0183 sentences"):
            import pynmea2
        lines = _Lines()
        size, done, bad = path.stat().st_size, 0, 0
        # a shell of Windows may have written them as UTF-16
        with path.open("rb") as stream:
            encoding = encoding_of_head(stream.read(_HEAD))
        with (
            as_utf8(path, encoding) as file,
            file.open("rb") as stream,
            progress(path.name, size, size) as advance,
        ):
            for count, line in enumerate(stream):
                done += len(line)
                if count % REPORT_EVERY == 0:
                    advance(min(done, size))
                match = _SENTENCE.match(line)
                if match is None:
                    bad += bool(line.strip())
                    continue
                before = match["before"].decode("ascii", errors="replace").strip(" ,;\t[]")
                stamp = _STAMP.search(before)
                before = stamp[0].rstrip(".,:") if stamp else before
                try:
                    message = pynmea2.parse(match["sentence"].decode("ascii").strip())
                    lines.add(message, before, wanted)
                except (pynmea2.ParseError, ValueError):
                    bad += 1
        if not lines.series:
            raise DataError(
                f"{path}: holds no NMEA 0183 sentence ({bad} lines are none, or fail their"
                " checksum)"
            )
        return lines.recording(path, bad)


@final
class _Sentence:
    """The sentences of one kind: their numbers and times.

    A time is the sentence's own or -1; beside it stands how many timed sentences went before.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self.columns, self.after = Columns(names), array("q")
        self.before: list[str] = []


@final
class _Lines:
    """All sentences of a file, and its clock: the times that sentences tell."""

    def __init__(self) -> None:
        self.series: dict[str, _Sentence] = {}
        self._ticks = array("q")
        self._day: int | None = None
        self._dated = False

    def add(self, message: Any, before: str, wanted: Wanted) -> None:
        """Take one more sentence with the text before it."""
        at = self._tick(message)
        # positions in signed degrees, NaN where the receiver says that there is no fix
        out: dict[str, float] = {}
        names = [str(entry[1]) for entry in message.fields]
        for name, cell in zip(names, message.data, strict=False):
            if name in ("timestamp", "datestamp", "lat", "lon"):
                continue
            try:
                out[name] = float(cell) * _PER_MINUTE.get(name, 1.0)
            except ValueError:
                if not cell:
                    out[name] = float("nan")
        if {"lat", "lon"} <= set(names):
            fix = bool(message.lat and message.lon) and getattr(message, "status", "A") != "V"
            fix = fix and str(getattr(message, "gps_qual", "1")) != "0"
            here = (message.latitude, message.longitude) if fix else (float("nan"), float("nan"))
            out["latitude"], out["longitude"] = here
        name = str(message.sentence_type)
        if not wanted(name) or not out:
            return
        one = self.series.setdefault(name, _Sentence(out))
        numbers = [out.get(field, np.nan) for field in one.columns.names]
        one.columns.add(-1 if at is None else at, numbers)
        one.after.append(len(self._ticks) - 1)
        one.before.append(before)

    def _tick(self, message: Any) -> int | None:
        """Return the time of a sentence in ns (Unix time once a date is known), else None."""
        try:
            moment, date = message.timestamp, _date(message)
        except (AttributeError, ValueError, TypeError):
            return None
        if not isinstance(moment, datetime.time):
            return None
        seconds = (moment.hour * 60 + moment.minute) * 60 + moment.second
        ns = seconds * 10**9 + moment.microsecond * 1000
        if date is not None:
            self._day, self._dated = (date - datetime.date(1970, 1, 1)).days * _DAY, True
        day = self._day or 0
        if self._ticks and date is None and day + ns < self._ticks[-1] - _DAY // 2:
            # past midnight, and the date has not come yet
            day = self._day = day + _DAY
        if not self._ticks or day + ns != self._ticks[-1]:
            self._ticks.append(day + ns)
        return day + ns

    def recording(self, path: Path, bad: int) -> Recording:
        """Return the recording of what was added."""
        ticks = np.frombuffer(self._ticks, dtype=np.int64)
        stamped = all(all(one.before) for one in self.series.values())
        if not ticks.size and not stamped:
            raise DataError(
                f"{path}: no sentence tells the time (RMC, GGA, ZDA, ...), and the lines do not"
                " begin with one"
            )
        remarks: list[Remark] = []
        if bad:
            text = f"{bad} lines are no NMEA sentence or fail their checksum; left out"
            remarks.append(remark("note", "bad_lines", text, lines=bad))
        arrivals = {
            name: parse_texts(np.array(one.before, dtype=object))
            for name, one in self.series.items()
            if stamped
        }
        begun, day = [int(one.ns.min()) for one in arrivals.values() if one.absolute], 0
        if ticks.size and not self._dated:
            if begun:
                # the times before the lines tell the day that the sentences do not
                day = round((min(begun) - int(ticks[0])) / _DAY) * _DAY
            else:
                text = "no sentence tells the date; time counts from midnight"
                remarks.append(remark("note", "undated", text))
        topics = {}
        for name, one in sorted(self.series.items()):
            times, said = one.columns.times, tuple[Remark, ...]()
            timed = bool((times >= 0).all())
            if not timed and not stamped:
                times = _between(np.frombuffer(one.after, dtype=np.int64), ticks)
                text = (
                    f"topic {name}: its sentences tell no time; they are spread between the timed"
                    " ones before and after"
                )
                said = (remark("note", "estimated_times", text, rows=times.size),)
            stamp = (
                Stamps(times + day, self._dated or bool(begun)) if timed or not stamped else None
            )
            fields = one.columns.fields
            sender = _senders(fields)
            topics[name] = Rows(f"nmea/{name}", fields, stamp, arrivals.get(name), sender, said)
        return recording_of(path, topics, (path,), remarks)


def _senders(fields: dict[str, np.ndarray]) -> np.ndarray | None:
    """Return the number of the engine that each row [T] is about; None where there is none."""
    number = fields.get("engine_no")
    if number is None or not np.isfinite(number).all():
        return None
    return np.array([f"{value:g}" for value in number.tolist()], dtype=object)


def _between(number: np.ndarray, ticks: np.ndarray) -> np.ndarray:
    """Return the times [T] of sentences without a time, evenly between the timed ones.

    `number` says after which timed sentence each came.
    """
    number = np.clip(number, 0, ticks.size - 1)
    order = np.arange(number.size) - stretch_bounds(number)[0]
    _, group, count = np.unique(number, return_inverse=True, return_counts=True)
    usual = np.median(np.diff(ticks)) if ticks.size > 1 else 10**9
    length = np.append(np.diff(ticks), usual)[number]
    out: np.ndarray = ticks[number] + np.rint(length * order / count[group]).astype(np.int64)
    return out


def _date(message: Any) -> datetime.date | None:
    if message.sentence_type == "RMC":
        day = message.datestamp
        return day if isinstance(day, datetime.date) else None
    if message.sentence_type == "ZDA":
        return datetime.date(int(message.year), int(message.month), int(message.day))
    return None

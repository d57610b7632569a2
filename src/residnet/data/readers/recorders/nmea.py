"""The reader of NMEA 0183 sentences in text files, through the package pynmea2."""

from __future__ import annotations

import datetime
import re
from array import array
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, Literal, final

import numpy as np

from residnet.core.errors import DataError
from residnet.core.stretches import stretch_bounds
from residnet.data.readers.base import require_file
from residnet.data.readers.composing.composed import RecordingConfig
from residnet.data.readers.composing.wanted import EVERYTHING, Wanted
from residnet.data.readers.encoding import as_utf8, encoding_of_head
from residnet.data.readers.files import missing_package, progress
from residnet.data.readers.recording import Recording, Remark, Series, remark
from residnet.data.readers.stamps import parse_texts

_SENTENCE = re.compile(rb"^(?P<before>[^$!]*)(?P<sentence>[$!][A-Z]{2}[A-Z0-9]{2,4},[\x20-\x7e]*)")
_PER_MINUTE = {"rate_of_turn": 1.0 / 60.0}
_DAY = 86_400 * 10**9
_REPORT_EVERY = 5000
_HEAD = 1024


@final
class NmeaConfig(RecordingConfig):
    """NMEA 0183 text, one sentence per line, with or without a time in front of it.

    A series is named by its sentence (`RMC`, `HDT`).

    Fields bear the names of pynmea2; `latitude` and `longitude` are in signed degrees,
    `rate_of_turn` is in deg/s (the sentence has deg/min).
    """

    kind: Literal["nmea"] = "nmea"

    def load(self, path: Path, wanted: Wanted) -> Recording:
        """Read the wanted sentences of a text file."""
        return load_nmea(path, wanted)


def load_nmea(path: Path, wanted: Wanted = EVERYTHING) -> Recording:
    """Return the recording in a file of sentences.

    Sentences with a time of day are dated by the last RMC or ZDA; those without a time lie between
    the ones around them in the order of the lines, unless every line begins with a time of its own.

    Raises:
        UsageError: where the file is missing or pynmea2 is not installed.
        DataError: where it holds no sentence, or none that tells the time.
    """
    require_file(path)
    try:
        import pynmea2
    except ImportError as error:
        raise missing_package("nmea", "pynmea2", "a file of NMEA 0183 sentences") from error
    lines = _Lines()
    size, done, bad = path.stat().st_size, 0, 0
    with _sentences(path) as stream, progress(path.name, size, size) as advance:
        for count, line in enumerate(stream):
            done += len(line)
            if count % _REPORT_EVERY == 0:
                advance(min(done, size))
            match = _SENTENCE.match(line)
            if match is None:
                bad += bool(line.strip())
                continue
            try:
                message = pynmea2.parse(match["sentence"].decode("ascii").strip())
                lines.add(
                    message,
                    match["before"].decode("ascii", errors="replace").strip(" ,;\t[]"),
                    wanted,
                )
            except (pynmea2.ParseError, ValueError):
                bad += 1
    if not lines.series:
        raise DataError(
            f"{path}: holds no NMEA 0183 sentence ({bad} lines are none, or fail their checksum)"
        )
    return lines.recording(path, bad)


@contextmanager
def _sentences(path: Path) -> Iterator[BinaryIO]:
    """Yield the lines of a file; a shell of Windows may have written them as UTF-16."""
    with path.open("rb") as stream:
        encoding = encoding_of_head(stream.read(_HEAD))
    with as_utf8(path, encoding) as file, file.open("rb") as stream:
        yield stream


@final
class _Sentence:
    """The sentences of one kind: numbers row by row, and their times.

    A time is the sentence's own or -1; beside it stands how many timed sentences went before.
    """

    def __init__(self) -> None:
        self.names: list[str] = []
        self.rows, self.own, self.epoch_number = array("d"), array("q"), array("q")
        self.before: list[str] = []

    def column(self, i: int) -> np.ndarray:
        """Return one field [T] by its number."""
        return np.frombuffer(self.rows, dtype=np.float64).reshape(-1, len(self.names))[:, i]


@final
class _Lines:
    """All sentences of a file, and its clock: the times that sentences tell."""

    def __init__(self) -> None:
        self.series: dict[str, _Sentence] = {}
        self._ticks = array("q")
        self._day: int | None = None
        self._dated = False

    def add(self, message: Any, before: str, wanted: Wanted) -> None:
        """Return one more sentence with the text before it."""
        at = self._tick(message)
        name = str(message.sentence_type)
        values = _numbers(message)
        if not wanted(name) or not values:
            return
        sentences = self.series.setdefault(name, _Sentence())
        if not sentences.names:
            sentences.names = list(values)
        sentences.rows.extend([values.get(field, np.nan) for field in sentences.names])
        sentences.own.append(-1 if at is None else at)
        sentences.epoch_number.append(len(self._ticks) - 1)
        sentences.before.append(before)

    def _tick(self, message: Any) -> int | None:
        """Return the time of a sentence in ns (Unix time once a date is known), else None."""
        try:
            moment, date = message.timestamp, _date(message)
        except (AttributeError, ValueError, TypeError):
            return None
        if not isinstance(moment, datetime.time):
            return None
        ns = (
            (moment.hour * 60 + moment.minute) * 60 + moment.second
        ) * 10**9 + moment.microsecond * 1000
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
        """Return the recording of what was added.

        Raises:
            DataError: where nothing tells the time.
        """
        ticks = np.frombuffer(self._ticks, dtype=np.int64)
        stamped = all(all(sentences.before) for sentences in self.series.values())
        if not ticks.size and not stamped:
            raise DataError(
                f"{path}: no sentence tells the time (RMC, GGA, ZDA, ...), and the lines do not"
                " begin with one"
            )
        remarks: list[Remark] = []
        if bad:
            text = f"{bad} lines are no NMEA sentence or fail their checksum; left out"
            remarks.append(remark("note", "bad_lines", text, lines=bad))
        arrivals = (
            {
                name: parse_texts(np.array(sentences.before, dtype=object))
                for name, sentences in self.series.items()
            }
            if stamped
            else {}
        )
        absolute = self._dated or any(stamps.absolute for stamps in arrivals.values())
        first = [int(ticks.min())] * bool(ticks.size) + [
            int(stamps.ns.min()) for stamps in arrivals.values() if stamps.absolute
        ]
        epoch = min(first) // 10**9 * 10**9 if absolute else None
        if not self._dated and ticks.size:
            remarks.append(
                remark("note", "undated", "no sentence tells the date; time counts from midnight")
            )
        series = {}
        for name, sentences in sorted(self.series.items()):
            times = np.frombuffer(sentences.own, dtype=np.int64)
            remarks_of_topic: tuple[Remark, ...] = ()
            timed = bool((times >= 0).all())
            if not timed and not stamped:
                times = _between(np.frombuffer(sentences.epoch_number, dtype=np.int64), ticks)
                text = (
                    f"topic {name}: its sentences tell no time; they are spread between the timed"
                    " ones before and after"
                )
                remarks_of_topic = (remark("note", "estimated_times", text, rows=times.size),)
            zero = epoch or 0
            stamp = (times - zero) * 1e-9 if timed or not stamped else None
            arrival = (
                (arrivals[name].ns - (zero if arrivals[name].absolute else 0)) * 1e-9
                if stamped
                else None
            )
            fields = {field: sentences.column(i) for i, field in enumerate(sentences.names)}
            series[name] = Series(
                name, f"nmea/{name}", fields, stamp, arrival, _senders(fields), remarks_of_topic
            )
        return Recording(path, series, epoch, (path,), tuple(remarks))


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
    """Return the date that a sentence tells."""
    if message.sentence_type == "RMC":
        day = message.datestamp
        return day if isinstance(day, datetime.date) else None
    if message.sentence_type == "ZDA":
        return datetime.date(int(message.year), int(message.month), int(message.day))
    return None


def _numbers(message: Any) -> dict[str, float]:
    """Return the numbers in a sentence by name.

    Positions in signed degrees, NaN where the receiver says that there is no fix.
    """
    out: dict[str, float] = {}
    for entry, cell in zip(message.fields, message.data, strict=False):
        name = str(entry[1])
        if name in ("timestamp", "datestamp", "lat", "lon"):
            continue
        try:
            out[name] = float(cell) * _PER_MINUTE.get(name, 1.0)
        except ValueError:
            if not cell:
                out[name] = float("nan")
    names = {str(entry[1]) for entry in message.fields}
    if {"lat", "lon"} <= names:
        fix = (
            bool(message.lat and message.lon)
            and getattr(message, "status", "A") != "V"
            and str(getattr(message, "gps_qual", "1")) != "0"
        )
        out["latitude"], out["longitude"] = (
            (message.latitude, message.longitude) if fix else (float("nan"), float("nan"))
        )
    return out

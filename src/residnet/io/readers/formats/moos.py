"""Reader of MOOS-IvP mission logs (alog) with time, variable, source and value on each line."""

from __future__ import annotations

import re
from array import array
from collections import Counter, defaultdict
from pathlib import Path
from typing import ClassVar, Literal, final

import numpy as np

from residnet.core.errors import DataError
from residnet.io.readers.base import REPORT_INTERVAL, reading_progress, require_file
from residnet.io.readers.compose import RecordingConfig
from residnet.io.readers.recording import ALL_FIELDS, FieldFilter, Recording, Series

_VALUE_LINE = re.compile(
    rb"^\s*(?P<time>[-+\d.eE]+)\s+(?P<name>\S+)\s+(?P<source>\S+)\s+(?P<value>\S+)"
)
_LONG_TABLE_LINE = re.compile(
    rb"""^"?(?P<time>[-+\d.eE]+)"?[,;\t]"?(?:(?P<source>[^,;\t"]+)[/.])?(?P<name>[^,;\t"/.]+)"?"""
    rb"""[,;\t]"?(?P<value>[-+\d.eE]+)"""
)
_LONG_TABLE_START = re.compile(
    rb"""^\W*(?:t|ts|time|timestamp|unix_time|time_s)\W+(?:topic|name|variable|signal|field|key|channel)"""
    rb"""\W+(?:value|payload|data)\W*?\n"?\d+(?:\.\d*)?"?[,;\t]"?[a-z/_]""",
    re.IGNORECASE,
)
"""Header of a table with one variable on each line, its first time and first name."""
_MESSAGE_TYPE = "moos/Variables"
_START_LINE = re.compile(rb"^%%\s*LOGSTART\s+(?P<start>\d+(?:\.\d+)?)")


_MAX_POST_DELAY = 0.15
"""Largest difference of the times of two variables that a source posts in one iteration, as a share
of the median interval."""


def _are_same_posts(first: np.ndarray, second: np.ndarray) -> bool:
    """Return whether two clocks [T] in s belong to variables posted one after the other."""
    if first.size != second.size or first.size < 2:
        return np.array_equal(first, second)
    interval = float(np.median(np.diff(first)))
    return bool(np.abs(first - second).max() <= _MAX_POST_DELAY * interval)


@final
class MoosConfig(RecordingConfig):
    """Reader of alog files from pLogger of MOOS-IvP, and of csv files with time, name and value.

    A series has the variables that one source (`uNav`) publishes together, and the name of the
    source. A variable with other times is a series with the name of the variable, or
    `source/variable` if several sources publish it. NAV_X is east, NAV_Y is north, and NAV_HEADING
    is in deg clockwise from north. Variables of text are ignored.
    """

    kind: Literal["moos"] = "moos"
    endings: ClassVar = (".alog",)
    formats: ClassVar = {
        "MOOS alog": lambda path, head: path.suffix.lower() == ".alog" or b"%% LOGSTART" in head,
        "long csv": lambda path, head: bool(_LONG_TABLE_START.match(head)),
    }

    def load(self, path: Path, field_filter: FieldFilter = ALL_FIELDS) -> Recording:
        """Read the numeric variables."""
        require_file(path)
        times: dict[tuple[str, str], array[float]] = defaultdict(lambda: array("d"))
        values: dict[tuple[str, str], array[float]] = defaultdict(lambda: array("d"))
        epoch = None
        bytes_read = 0
        size = path.stat().st_size
        with path.open("rb") as stream, reading_progress(path.name, size, size) as advance:
            for count, line in enumerate(stream):
                bytes_read += len(line)
                if count % REPORT_INTERVAL == 0:
                    advance(min(bytes_read, size))
                if start_match := _START_LINE.match(line):
                    epoch = round(float(start_match["start"]) * 1e9)
                match = _LONG_TABLE_LINE.match(line) or _VALUE_LINE.match(line)
                match = None if line.startswith(b"%") else match
                if match is None:
                    continue
                try:
                    time = float(match["time"])
                    value = float(match["value"])
                except ValueError:
                    continue
                source_and_name = (
                    (match["source"] or b"values").decode(errors="replace"),
                    match["name"].decode("latin-1"),
                )
                times[source_and_name].append(time)
                values[source_and_name].append(value)
        if not times:
            raise DataError(
                f"{path}: has no line with time, variable, source and number, a MOOS alog was"
                " expected; leave the file out"
            )
        n_sources = Counter(name for _, name in times)
        series: dict[str, Series] = {}
        for (source, name), clock in times.items():
            stamp = np.array(clock)
            samples = np.array(values[source, name])
            same_source = series.get(source)
            if same_source is None or _are_same_posts(same_source.clock, stamp):
                fields = {**(same_source.fields if same_source else {}), name: samples}
                stamp = stamp if same_source is None else same_source.clock
                series[source] = Series(source, _MESSAGE_TYPE, fields, stamp)
            else:
                # variables of several publishers must not replace each other
                topic = name if n_sources[name] == 1 else f"{source}/{name}"
                series[topic] = Series(topic, _MESSAGE_TYPE, {name: samples}, stamp)
        selected = {
            name: source_series for name, source_series in series.items() if field_filter(name)
        }
        return Recording(
            path, selected, epoch, (path,), unread_series=tuple(set(series) - set(selected))
        )

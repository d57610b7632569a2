"""Mission logs of MOOS-IvP (alog): time, variable, source and value on each line."""

from __future__ import annotations

import re
from array import array
from collections import defaultdict
from pathlib import Path
from typing import ClassVar, Literal, final

import numpy as np

from residnet.core.errors import DataError
from residnet.data.readers.base import REPORT_EVERY, progress, require_file
from residnet.data.readers.compose import RecordingConfig
from residnet.data.readers.recording import EVERYTHING, Recording, Series, Wanted

_LINE = re.compile(rb"^\s*(?P<time>[-+\d.eE]+)\s+(?P<name>\S+)\s+(?P<source>\S+)\s+(?P<value>\S+)")
_START = re.compile(rb"^%%\s*LOGSTART\s+(?P<start>\d+(?:\.\d+)?)")


@final
class MoosConfig(RecordingConfig):
    """An alog file, as pLogger of MOOS-IvP writes it.

    A series is named by its source (`uNav`) and holds the variables that it publishes together;
    one that comes at times of its own is a series by its own name. NAV_X is east, NAV_Y north, and
    NAV_HEADING in deg clockwise from north. Variables of text are left out.
    """

    kind: Literal["moos"] = "moos"
    endings: ClassVar = (".alog",)
    formats: ClassVar = {
        "MOOS alog": lambda path, head: path.suffix.lower() == ".alog" or b"%% LOGSTART" in head
    }

    def load(self, path: Path, wanted: Wanted = EVERYTHING) -> Recording:
        """Read the variables that hold numbers."""
        require_file(path)
        times: dict[tuple[str, str], array[float]] = defaultdict(lambda: array("d"))
        values: dict[tuple[str, str], array[float]] = defaultdict(lambda: array("d"))
        epoch, done, size = None, 0, path.stat().st_size
        with path.open("rb") as stream, progress(path.name, size, size) as advance:
            for count, line in enumerate(stream):
                done += len(line)
                if count % REPORT_EVERY == 0:
                    advance(min(done, size))
                if begun := _START.match(line):
                    epoch = round(float(begun["start"]) * 1e9)
                match = None if line.startswith(b"%") else _LINE.match(line)
                if match is None:
                    continue
                try:
                    at, value = float(match["time"]), float(match["value"])
                except ValueError:
                    continue
                key = match["source"].decode(errors="replace"), match["name"].decode("latin-1")
                times[key].append(at)
                values[key].append(value)
        if not times:
            raise DataError(f"{path}: holds no line of time, variable, source and a number")
        series: dict[str, Series] = {}
        for (source, name), clock in times.items():
            stamp, numbers = np.array(clock), np.array(values[source, name])
            like = series.get(source)
            if like is None or np.array_equal(like.clock, stamp):
                fields = {**(like.fields if like else {}), name: numbers}
                series[source] = Series(source, "moos/Variables", fields, stamp)
            else:
                series[name] = Series(name, "moos/Variables", {name: numbers}, stamp)
        kept = {name: one for name, one in series.items() if wanted(name)}
        return Recording(path, kept, epoch, (path,), listed=tuple(set(series) - set(kept)))

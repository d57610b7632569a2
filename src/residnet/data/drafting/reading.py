"""Logs of any format read without a config: their reader is drafted, and read them.

`inspect`, `read_logs`, `fit`, `new` and `draft` come through here, so that each has the same map.
"""

from __future__ import annotations

import contextlib
import itertools
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from residnet.core.config import validate
from residnet.core.errors import DataError, ResidnetError, UsageError
from residnet.core.layout import Live
from residnet.core.log import Log
from residnet.core.names import STATE
from residnet.core.progress import report
from residnet.data.drafting.channels import READER
from residnet.data.drafting.physics import Raw, turns_to
from residnet.data.drafting.questions import Key, Marks
from residnet.data.drafting.recordings import draft_recordings
from residnet.data.drafting.tables import draft_tables, named, peek
from residnet.data.drafting.words import PLANES
from residnet.data.motion import MotionConfig, complete_motion
from residnet.data.readers import ReaderConfig
from residnet.data.readers.detect import kind_of, to_table
from residnet.data.readers.joined import partners
from residnet.data.readers.quantities import QUATERNION
from residnet.data.readers.recording import Recording
from residnet.data.readers.tables import column_names
from residnet.data.split import log_names, logs_below

INPUTS = ("signals", "inputs")
"""Key of a config's inputs."""
_TABLES = (".csv", ".parquet")


def log_files(paths: Sequence[Path]) -> list[Path]:
    """Return the files, and the logs below folders, in order; each once.

    A folder may itself be a log, as a ROS 2 bag is, and where a folder holds neither such nor
    tables, logs of any other format are taken.

    Args:
        paths: files and folders.

    Raises:
        UsageError: where a path does not exist or a folder holds no log.
    """
    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            below = logs_below(path)
            # notes and settings often lie beside tables
            found = [p for p in below if p.is_dir() or p.suffix in _TABLES] or below
            if not found:
                raise UsageError(f"{path}: holds no log of a format that is known{others_in(path)}")
            files += found
        elif path.is_file():
            files.append(path)
        else:
            raise UsageError(f"{path}: no such file or folder")
    once: dict[Path, Path] = {}
    for file in files:
        once.setdefault(file.resolve(), file)
    return list(once.values())


def others_in(folder: Path) -> str:
    """Return what a folder without logs holds, and how it can become logs; empty for nothing."""
    endings = Counter(path.suffix.lower() for path in folder.rglob("*") if path.is_file())
    held = ", ".join(
        f"{n} file{'s' * (n > 1)} {end or 'without ending'}" for end, n in endings.items()
    )
    usual = max(endings, key=lambda ending: endings[ending], default="")
    return f", but {held[:120]}; {to_table(usual)}" if held else ""


@dataclass
class DraftedLogs:
    """Logs that one drafted reader reads.

    Attributes:
        reader: `data.reader` of a config.
        logs: path -> log, in SI, as the reader gives it.
        left_out: path -> why it cannot be read.
        marks: what of the reader is not sure.
    """

    reader: dict[str, Any]
    marks: Marks
    logs: dict[Path, Log] = field(default_factory=dict)
    left_out: dict[Path, ResidnetError] = field(default_factory=dict)


def read_drafted(paths: Sequence[Path], marks: Marks, *, gridded: bool = True) -> DraftedLogs:
    """Return the logs in files of one format, by a reader that is drafted from them.

    Args:
        paths: files and recordings.
        marks: is told what is not sure.
        gridded: recordings come on a uniform clock, and else on that of their positions.

    Raises:
        UsageError: where the files are of several formats.
        DataError: where none can be used.
    """
    kinds = {path: kind_of(path) for path in paths}
    if len(set(kinds.values())) > 1:
        named = "; ".join(
            f"{kind}: {', '.join(path.name for path in paths if kinds[path] == kind)[:120]}"
            for kind in sorted(set(kinds.values()))
        )
        raise UsageError(
            f"the logs are of several formats, and a fit reads one ({named}); give those of one"
        )
    kind, read = kinds[paths[0]], DraftedLogs({"kind": "canonical"}, marks)
    loaded: dict[Path, Recording] = {}
    if kind == "table" and (trips := trips_of(paths)):
        alone = set(paths).difference(*trips.values())
        read.reader, paths, read.left_out = _draft_joined(trips, marks)
        read.left_out |= {
            path: DataError(f"{path}: no other file of its trip is beside it; leave it out")
            for path in sorted(alone)
        }
    elif kind == "table":
        read.reader, read.left_out = draft_tables(paths, marks)
    elif kind != "canonical":
        read.reader, loaded = draft_recordings(paths, marks)
    settings = {key: value for key, value in read.reader.items() if gridded or key != "clock"}
    reader, names = validate(settings, ReaderConfig, "draft").build(), log_names(paths)
    for number, path in enumerate(paths):
        report("reading logs", number, len(paths))
        try:
            if path not in read.left_out:
                # a recording that was drafted from is not loaded again
                there = loaded.pop(path, None)
                log = reader.read(path) if there is None else reader.log_of(there)
                read.logs[path] = log.replace(name=names[path])
        except ResidnetError as error:
            read.left_out[path] = error
    report("reading logs", len(paths), len(paths))
    if not read.logs:
        raise next(iter(read.left_out.values()))
    _turn_rudders(read)
    return read


def _draft_joined(
    trips: Mapping[str, Sequence[Path]], marks: Marks
) -> tuple[dict[str, Any], list[Path], dict[Path, ResidnetError]]:
    """Return the settings of a reader of files that belong together, those of the motion, and which
    of them are not read.
    """
    parts: dict[str, dict[str, Any]] = {}
    left_out: dict[Path, ResidnetError] = {}
    for word, files in trips.items():
        own = Marks()
        parts[word], lost = draft_tables(files, own, headed=True)
        left_out |= lost
        place = (*READER, "parts", word)
        for told, tell in ((own.guesses, marks.guess), (own.notes, marks.note)):
            for key, text in told:
                tell((*place, *key[len(READER) :]) if key[: len(READER)] == READER else key, text)
    order = sorted(parts, key=lambda word: -len(_of_motion(parts[word]["channels"])))
    text = (
        f"files whose names differ in {' and '.join(order)} alone are taken as one trip; where both"
        " have no dates, their clocks are brought together by what the commands explain"
    )
    marks.guess((*READER, "parts"), text)
    reader = {"kind": "joined", "parts": {word: parts[word] for word in order}}
    return reader, [*trips[order[0]]], left_out


def trips_of(paths: Sequence[Path]) -> dict[str, list[Path]]:
    """Return word -> tables, where those that differ in one word of their names are parts of trips.

    Empty where they are not. Two files with a position or a speed each are of two vessels, or of
    two recorders that each are a log; a compass may be in both.
    """
    columns = {path: column_names(path) for path in paths}
    # lists of names and notes lie beside logs
    groups: dict[tuple[str, ...], list[Path]] = {}
    for path, names in columns.items():
        groups.setdefault(names, []).append(path)
    logs = {n: files for n, files in groups.items() if len(groups) > 1 and _channels_of(files)}
    found = partners({path: names for path, names in columns.items() if names in logs})
    held = [_of_motion(_channels_of(files)) & {*"xyuv"} for files in found.values()]
    alike = any(one & other for one, other in itertools.combinations(held, 2))
    return {} if alike else found


def _channels_of(files: Sequence[Path]) -> Iterable[str]:
    """Return the channels that the names of columns tell, of the first table that can be read."""
    for path in files:
        with contextlib.suppress(ResidnetError):
            if found := named([*peek(path, 50).numbers], Marks()):
                return found
    return ()


def _of_motion(channels: Iterable[str]) -> set[str]:
    """Return what channels tell of the motion: position, heading, velocities and roll by name."""
    same = {"latitude": "x", "longitude": "y", **dict.fromkeys(QUATERNION, "psi")}
    return {same.get(name, name) for name in channels} & {*STATE, "phi", "p"}


def read_each(paths: Sequence[Path]) -> list[DraftedLogs]:
    """Return logs of any formats, those with the same columns together.

    Where none of those alike can be read, all of them are left out.
    """
    alike: dict[tuple[str, ...], list[Path]] = {}
    tables = {path: column_names(path) for path in paths if kind_of(path) == "table"}
    joined = bool(trips_of([*tables]))
    for path in paths:
        kind = kind_of(path)
        names = tables[path] if kind == "table" and not joined else ()
        alike.setdefault((kind, *names), []).append(path)
    out = []
    for group in alike.values():
        marks = Marks()
        try:
            out.append(read_drafted(group, marks, gridded=False))
        except ResidnetError as error:
            out.append(DraftedLogs({}, marks, left_out=dict.fromkeys(group, error)))
    return out


def _turn_rudders(read: DraftedLogs) -> None:
    """Turn the sign of rudders whose positive angles turn the vessel to port, of planes those that
    turn it up.
    """
    channels, places = _entries(read.reader)
    held = dict.fromkeys(name for log in read.logs.values() for name in log.channels)
    names = [name for name in held if re.match(r"(cmd_)?delta(?!_rate)", name)]
    moving = [moved for log in read.logs.values() if names and (moved := _turning(log))]
    for name in names:
        dives = PLANES.match(name) is not None
        rate, way, wrong = ("q", -1.0, "up") if dives else ("r", 1.0, "to port")
        columns = [name, "theta"] if dives else [name]
        there = [log for log in moving if {rate, *columns} <= log.channels.keys()]
        logs = [Raw(log.t, {column: log[column] for column in columns}) for log in there]
        rates = {number: way * log[rate] for number, log in enumerate(there)}
        slope, error = turns_to(logs, name, rates, "theta" if dives else None)
        key = places.get(name, INPUTS)
        if abs(slope) < 4.0 * error:
            read.marks.guess(key, f"the logs do not tell which way {name} turns the vessel")
        elif slope < 0.0 and name in channels:
            channels[name]["sign"] = -1 * int(channels[name].get("sign", 1))
            text = f"positive values turned the vessel {wrong} in the logs ({-slope / error:.0f}"
            read.marks.guess(key, f"{text} standard errors): the sign is turned")
            for path, log in read.logs.items():
                if name in log.channels:
                    turned = {**log.channels, name: -log[name]}
                    read.logs[path] = log.replace(channels=turned)
        elif slope < 0.0:
            text = f"positive values of {name} turned the vessel {wrong} in the logs"
            read.marks.guess(key, text)


def _entries(reader: Mapping[str, Any]) -> tuple[dict[str, dict[str, Any]], dict[str, Key]]:
    """Return channel -> entry of a drafted reader, and channel -> its key in the config."""
    parts: dict[Key, Mapping[str, Any]] = {
        (*READER, "parts", word): part for word, part in reader.get("parts", {}).items()
    }
    parts = parts or {READER: reader}
    entries: dict[str, dict[str, Any]] = {}
    places: dict[str, Key] = {}
    for place, part in parts.items():
        for name, entry in part.get("channels", {}).items():
            entries.setdefault(name, entry)
            places.setdefault(name, (*place, "channels", name))
    return entries, places


def _turning(log: Log) -> Log | None:
    """Return a log with its yaw rate and, where it dives, its pitch rate; None without."""
    try:
        told = Live.told(log.channels)
        rates = {"r", "q"} if told.spatial else {"r"}
        return log if rates <= log.channels.keys() else complete_motion(log, MotionConfig(), told)
    except ResidnetError:
        return None

"""Logs of a split: whole files and recordings, stretches of time of one, logs of a manoeuvre."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import Field, model_validator

from residnet.core.arrays.paged import lies_on_disk
from residnet.core.config import Config, Seconds
from residnet.core.errors import ConfigError, DataError
from residnet.core.log import Log
from residnet.core.names import nearest
from residnet.data.readers.base import files_of
from residnet.data.readers.detect import LOG_ENDINGS, format_of


class LogPart(Config):
    """Logs, or a stretch of one, that belong to a split.

    Attributes:
        log: path or pattern of files, folders and bags, relative to `root`.
        from: time in s on the log's own clock at which the stretch begins; null for its start.
        to: time in s at which it ends; null for the log's end.
        manoeuvre: only logs of this kind of manoeuvre; null for all.
    """

    log: str
    start: Seconds | None = Field(default=None, alias="from")
    stop: Seconds | None = Field(default=None, alias="to")
    manoeuvre: str | None = None

    @model_validator(mode="after")
    def _order(self) -> LogPart:
        if self.start is not None and self.stop is not None and self.stop <= self.start:
            raise ValueError(
                f"a stretch from {self.start:.10g} s to {self.stop:.10g} s holds nothing"
            )
        return self


@dataclass(frozen=True)
class Part:
    """One file or recording of a split, or a stretch of it.

    Attributes:
        path: of the file or folder.
        start: time at which it begins, s; None for the log's start.
        stop: time at which it ends, s; None for the log's end.
        manoeuvre: it is left out unless the log is of this kind; None takes any.
    """

    path: Path
    start: float | None = None
    stop: float | None = None
    manoeuvre: str | None = None

    @property
    def whole(self) -> bool:
        """Whether it is the log from end to end."""
        return self.start is None and self.stop is None

    def overlaps(self, other: Part) -> bool:
        """Return whether two parts of one log share a stretch of time, whatever its kind."""
        if self.manoeuvre != other.manoeuvre and None not in (self.manoeuvre, other.manoeuvre):
            return False
        low = max(_or(self.start, -np.inf), _or(other.start, -np.inf))
        return low < min(_or(self.stop, np.inf), _or(other.stop, np.inf))

    def of(self, log: Log) -> Log | None:
        """Return this part of a log; None where the log is of another manoeuvre.

        Raises:
            DataError: where the stretch holds fewer than two samples.
        """
        if self.manoeuvre is not None and log.manoeuvre != self.manoeuvre:
            return None
        return log if self.whole else stretch_of(log, self.start, self.stop)


def stretch_of(log: Log, start: float | None, stop: float | None) -> Log:
    """Return the samples of a log with start <= t < stop, under a name of their own.

    Raises:
        DataError: where there are fewer than two.
    """
    inside = (log.t >= _or(start, -np.inf) - 1e-9) & (log.t < _or(stop, np.inf) - 1e-9)
    if inside.sum() < 2:
        raise DataError(
            f"log {log.name}: {int(inside.sum())} samples from {_or(start, log.t[0]):.10g} s to"
            f" {_or(stop, log.t[-1]):.10g} s; the log runs from {log.t[0]:.10g} s to"
            f" {log.t[-1]:.10g} s"
        )
    ends = [_or(start, float(log.t[0])), _or(stop, float(log.t[-1]))]
    name = "_".join([log.name, *(f"{end:.13g}s".replace(".", "p") for end in ends)])
    part = log.rows(inside).replace(name=name, meta={**log.meta, "stretch": ends})
    return part.on_disk() if lies_on_disk(log.t) else part


def _or(value: float | None, other: float) -> float:
    return other if value is None else value


def parts_of(root: Path, entries: Sequence[str | LogPart], where: str) -> list[Part]:
    """Return the parts that a split's entries name, each once.

    Raises:
        ConfigError: where an entry matches nothing.
    """
    out: dict[Part, None] = {}
    for entry in entries:
        wanted = entry if isinstance(entry, LogPart) else LogPart(log=entry)
        for path in matches(root, [wanted.log], where):
            out[Part(path, wanted.start, wanted.stop, wanted.manoeuvre)] = None
    return list(out)


def logs_below(folder: Path) -> list[Path]:
    """Return the recordings and files of logs in a folder, in order; a recording is one log."""
    if format_of(folder) is not None and not _holds_recordings(folder):
        return [folder]
    found: list[Path] = []
    for path in sorted(folder.iterdir()):
        if path.name.startswith("."):
            continue
        if path.is_dir():
            found += logs_below(path)
        elif path.suffix.lower() in LOG_ENDINGS:
            found.append(path)
    return found


def _holds_recordings(folder: Path) -> bool:
    """Return whether the folders in a folder hold files of the same names, as recordings do."""
    below = [path for path in folder.iterdir() if path.is_dir()]
    names = [frozenset(f.relative_to(path) for f in files_of(path)) for path in below]
    return any(names.count(held) > 1 and len(held) > 1 for held in names)


def log_names(paths: Iterable[Path]) -> dict[Path, str]:
    """Return the name of each log: that of its file without the ending, or of its folder.

    Where several files or folders have one name, as with a folder for each trial, the folders above
    come before it as far as they are needed to tell the logs apart; of files in one folder the
    ending comes behind it.

    Args:
        paths: files and recordings; one that is given twice is one log.
    """
    given = list(dict.fromkeys(paths))
    real = {path: path.resolve() for path in given}
    above = dict.fromkeys(given, 0)
    beside = Counter((own.parent, path.stem) for own, path in {real[p]: p for p in given}.items())
    while True:
        names = {path: _name(path, real[path], above[path], beside) for path in given}
        owners: dict[str, set[Path]] = {}
        for path, name in names.items():
            owners.setdefault(name, set()).add(real[path])
        again = [
            path
            for path, name in names.items()
            if len(owners[name]) > 1 and above[path] < len(real[path].parents) - 1
        ]
        if not again:
            return names
        for path in again:
            above[path] += 1


def _name(path: Path, real: Path, above: int, beside: Mapping[tuple[Path, str], int]) -> str:
    alone = path.is_dir() or beside[real.parent, path.stem] == 1
    own = (path.name if path.is_dir() else path.stem) if alone else path.name.replace(".", "_")
    return "_".join([*(parent.name for parent in reversed(real.parents[:above])), own])


def data_files(paths: Iterable[Path]) -> list[Path]:
    """Return the files that logs consist of: those below a folder that is a recording, too."""
    return [file for path in dict.fromkeys(paths) for file in files_of(path)]


def matches(root: Path, patterns: Sequence[str], where: str) -> list[Path]:
    """Return logs of all patterns, each once: files, recordings, and what lies below folders."""
    found: dict[Path, None] = {}
    for pattern in patterns:
        # a plain path may hold characters that a pattern would read otherwise
        path = root / pattern
        named = [path] if path.exists() else _globbed(root, pattern, where)
        logs = [log for one in named for log in (logs_below(one) if one.is_dir() else [one])]
        if not logs:
            parent = path.parent
            near = (
                nearest(Path(pattern).name, (path.name for path in parent.iterdir()))
                if parent.is_dir()
                else f"; there is no folder {parent}"
            )
            raise ConfigError(f"{where}: '{pattern}' matches no file in {root}{near}")
        found.update(dict.fromkeys(logs))
    return list(found)


def _globbed(root: Path, pattern: str, where: str) -> list[Path]:
    """Return files and recordings below `root` that a pattern matches, in order."""
    why = "it is an absolute path" if Path(pattern).is_absolute() else ""
    try:
        if not why:
            found = sorted(root.glob(pattern))
            files = [path for path in found if path.is_file()]
            return files or [path for path in found if path.is_dir() and format_of(path)]
    except ValueError as error:
        why = str(error)
    raise ConfigError(
        f"{where}: '{pattern}' is not a pattern relative to {root} ({why}); set `root` instead"
    )

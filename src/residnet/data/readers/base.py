"""What all readers of logs share, and the reader of residnet's own Parquet logs (`Log.save`)."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, Self, final

import numpy as np

from residnet.core.config import Config
from residnet.core.errors import DataError, ResidnetError, UsageError
from residnet.core.files import sha256
from residnet.core.log import Log
from residnet.core.names import CHANNEL_UNITS, nearest, shown
from residnet.core.progress import report

# recordings below this size are read before anybody waits, bytes
_LARGE = 50_000_000
REPORT_EVERY = 5000
"""Messages or lines between two reports of a reader; chosen by hand: many a second of reading."""
LARGE = 300_000_000
"""Bytes of a folder above which topics that nobody wants are not read."""


class LogReader(ABC):
    """Reads one file format into the canonical `Log`."""

    def logs_among(self, paths: Sequence[Path]) -> list[Path]:
        """Return the files that are logs by themselves; others only belong to these."""
        return list(paths)

    def files(self, path: Path) -> list[Path]:
        """Return the files that a log is made of: itself, those below a folder, those beside it."""
        return files_of(path)

    @abstractmethod
    def read(self, path: Path) -> Log:
        """Return the log in one file, in SI units, psi unwrapped, time strictly increasing.

        The log's name is the file's stem; `meta` holds `source`, `sha256`, `rows_read` and
        `rows_dropped`.

        Raises:
            UsageError: where the file or a column is missing, or a unit does not fit.
            DataError: where the contents cannot be used.
        """


class ConfiguredReader(Config, LogReader):
    """A reader that is its own config."""

    def build(self) -> Self:
        """Return the reader of this config: itself."""
        return self


class ReaderKind(Config, ABC):
    """The config of a reader that another package offers: its `kind` and how the reader is built.

    Attributes:
        kind: a `Literal` with the name of the entry point in the group `residnet.readers`.
    """

    kind: str

    @abstractmethod
    def build(self) -> LogReader:
        """Build the reader of this config."""


def require_file(path: Path) -> None:
    """Stop where `path` is not a file."""
    if path.is_dir():
        raise UsageError(
            f"{path}: is a folder, a log file was expected; name one file or a pattern such as"
            f" '{path}/*.csv'"
        )
    if not path.is_file():
        near = (
            nearest(path.name, (other.name for other in path.parent.iterdir()))
            if path.parent.is_dir()
            else "; its folder does not exist either"
        )
        raise UsageError(f"{path}: no such file{near}")


def provenance(path: Path, rows_read: int, rows_dropped: int) -> dict[str, Any]:
    """Return where a log comes from: `source`, `sha256`, `rows_read`, `rows_dropped`.

    The SHA-256 is that of the file's bytes.
    """
    return {
        "source": str(path),
        "sha256": digest([path]),
        "rows_read": rows_read,
        "rows_dropped": rows_dropped,
    }


def unwrap(angle: np.ndarray) -> np.ndarray:
    """Return the angle [T] in rad made continuous over its finite samples; NaN stay where they are.

    A turn of more than half a circle between two finite samples is ambiguous.
    """
    out = np.asarray(angle, dtype=np.float64).copy()
    if out.size and np.abs(np.diff(out)).max(initial=0.0) < np.pi:
        # nothing to unwrap, and no sample missing
        return out
    known = np.isfinite(angle)
    out[known] = np.unwrap(out[known])
    return out


def turned(
    x: np.ndarray | float, y: np.ndarray | float, angle: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return vectors [T] turned by angles [T]: from body axes to north and east by the heading.

    Source: document 003 eq. (4); by minus the heading it is the way back.
    """
    c, s = np.cos(angle), np.sin(angle)
    return c * x - s * y, s * x + c * y


def require_samples(path: Path, t: np.ndarray) -> None:
    """Stop where a log is too short to have a time step."""
    if t.size < 2:
        raise DataError(f"{path}: {t.size} usable rows, at least 2 are needed; leave the file out")


def require_increasing(path: Path, t: np.ndarray, row: Callable[[int], str]) -> None:
    """Stop where time [T] in s repeats or runs backwards.

    `row` names the row of a sample in the file.
    """
    bad = np.flatnonzero(~(np.diff(t) > 0.0))
    if bad.size:
        i = int(bad[0])
        what = (
            "repeats"
            if t[i + 1] == t[i]
            else "runs backwards"
            if t[i + 1] < t[i]
            else "is not a number"
        )
        raise DataError(
            f"{path}: time {what} from {row(i)} ({t[i]:.13g} s) to {row(i + 1)}"
            f" ({t[i + 1]:.13g} s), {bad.size} such steps in all; delete the repeated rows, or"
            " split the file where its clock restarts"
        )


def require_values(path: Path, channel: str, column: str, values: np.ndarray) -> None:
    """Stop where a channel [T] holds no number at all."""
    if not np.isfinite(values).any():
        raise DataError(
            f"{path}: column '{column}' (channel {channel}) holds no number in any of {values.size}"
            " rows; take it out of the channel map"
        )


def digest(files: Sequence[Path]) -> str:
    """Return the SHA-256 of one file's bytes, or of the digests of several in order, as hex."""
    sums = [sha256(file) for file in files]
    return sums[0] if len(sums) == 1 else hashlib.sha256("".join(sums).encode()).hexdigest()


def files_of(path: Path) -> list[Path]:
    """Return a file itself, or all files below a folder, in order."""
    return sorted(file for file in path.rglob("*") if file.is_file()) if path.is_dir() else [path]


def total_size(files: Iterable[Path]) -> int:
    """Return the bytes of all files."""
    return sum(file.stat().st_size for file in files)


Advance = Callable[[float], None]
"""Reports how far a reader is, in the unit of its total."""


@contextmanager
def progress(name: str, size: int, total: float) -> Iterator[Advance]:
    """Report the reading of a large recording to whoever listens to progress.

    Args:
        size: its bytes; nothing is reported of a small recording.
        total: what the reader counts to.
    """
    if size < _LARGE:
        yield lambda done: None
        return
    stage = f"reading {name}, per cent"
    yield lambda done: report(stage, 100.0 * done / total, 100.0)
    report(stage, 100.0, 100.0)


@contextmanager
def package(extra: str, package: str, name: str) -> Iterator[None]:
    """Import the package of a format; where it is not installed, say which extra brings it."""
    try:
        yield
    except ImportError as error:
        raise UsageError(
            f"{name} needs the package {package}, which is not installed; install it with: pip"
            f' install "residnet[{extra}]"'
        ) from error


@contextmanager
def readable(path: Path, what: str) -> Iterator[None]:
    """Damaged files fail in every layer of a library: tell so in one line, as what they are not."""
    try:
        yield
    except ResidnetError:
        raise
    except Exception as error:
        reason = shown(f"{type(error).__name__}: {' '.join(str(error).split())}", 200)
        raise DataError(f"{path}: damaged or not {what} ({reason})") from error


@final
class CanonicalConfig(ConfiguredReader):
    """Logs that residnet wrote: they hold names, units and masks, so nothing is declared."""

    kind: Literal["canonical"] = "canonical"

    def read(self, path: Path) -> Log:
        """Return the log in `path`; see `LogReader.read`.

        Raises:
            UsageError: where the file is missing, is no canonical log, or gives a known channel
                another unit than its SI unit.
            DataError: where time does not increase, the file holds no samples, or a channel holds
                no number.
        """
        require_file(path)
        log = Log.load(path)
        for name, unit in log.units.items():
            if unit != CHANNEL_UNITS.get(name, unit):
                raise UsageError(
                    f"{path}: channel {name} is in [{unit}], a canonical log holds it in"
                    f" [{CHANNEL_UNITS[name]}]; convert it and save again"
                )
        t = log.t
        require_samples(path, t)
        require_increasing(path, t, lambda i: f"row {i + 1}")
        for name, values in log.channels.items():
            require_values(path, name, name, values)
        origin = {key: log.meta[key] for key in ("source", "sha256") if key in log.meta}
        meta = {
            **log.meta,
            **({"origin": origin} if origin else {}),
            **provenance(path, len(log), 0),
        }
        return log.replace(name=path.stem, t=t, meta=meta)

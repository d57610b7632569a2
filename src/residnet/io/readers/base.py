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
from residnet.core.names import CHANNEL_UNITS, suggest_name, truncate
from residnet.core.progress import report_progress

# recordings below this size are read before anybody waits, bytes
_PROGRESS_MIN_BYTES = 50_000_000
REPORT_INTERVAL = 5000
"""Messages or lines between two reports of a reader; chosen by hand: many a second of reading."""
LARGE_FOLDER_BYTES = 300_000_000
"""Bytes of a folder above which topics that nobody wants are not read."""


class LogReader(ABC):
    """Reads one file format into the canonical `Log`."""

    def select_logs(self, paths: Sequence[Path]) -> list[Path]:
        """Return the files that are logs by themselves; others only belong to these."""
        return list(paths)

    def list_member_files(self, path: Path) -> list[Path]:
        """Return the files that a log is made of: itself, those below a folder, those beside it."""
        return list_files(path)

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
        hint = (
            suggest_name(path.name, (sibling.name for sibling in path.parent.iterdir()))
            if path.parent.is_dir()
            else "; its folder does not exist either"
        )
        raise UsageError(f"{path}: no such file{hint}")


def describe_provenance(path: Path, rows_read: int, rows_dropped: int) -> dict[str, Any]:
    """Return where a log comes from: `source`, `sha256`, `rows_read`, `rows_dropped`.

    The SHA-256 is that of the file's bytes.
    """
    return {
        "source": str(path),
        "sha256": hash_files([path]),
        "rows_read": rows_read,
        "rows_dropped": rows_dropped,
    }


def require_samples(path: Path, t: np.ndarray) -> None:
    """Stop where a log is too short to have a time step."""
    if t.size < 2:
        raise DataError(f"{path}: {t.size} usable rows, at least 2 are needed; leave the file out")


def require_increasing(path: Path, t: np.ndarray, row_label: Callable[[int], str]) -> None:
    """Stop where time [T] in s repeats or runs backwards.

    `row_label` names the row of a sample in the file.
    """
    violations = np.flatnonzero(~(np.diff(t) > 0.0))
    if violations.size:
        i = int(violations[0])
        problem = (
            "repeats"
            if t[i + 1] == t[i]
            else "runs backwards"
            if t[i + 1] < t[i]
            else "is not a number"
        )
        raise DataError(
            f"{path}: time {problem} from {row_label(i)} ({t[i]:.13g} s) to {row_label(i + 1)}"
            f" ({t[i + 1]:.13g} s), {violations.size} such steps in all; delete the repeated rows, or"
            " split the file where its clock restarts"
        )


def require_values(path: Path, channel: str, column: str, values: np.ndarray) -> None:
    """Stop where a channel [T] holds no number at all."""
    if not np.isfinite(values).any():
        raise DataError(
            f"{path}: column '{column}' (channel {channel}) holds no number in any of {values.size}"
            " rows; take it out of the channel map"
        )


def hash_files(files: Sequence[Path]) -> str:
    """Return the SHA-256 of one file's bytes, or of the digests of several in order, as hex."""
    checksums = [sha256(file) for file in files]
    return (
        checksums[0]
        if len(checksums) == 1
        else hashlib.sha256("".join(checksums).encode()).hexdigest()
    )


def list_files(path: Path) -> list[Path]:
    """Return a file itself, or all files below a folder, in order."""
    return sorted(file for file in path.rglob("*") if file.is_file()) if path.is_dir() else [path]


def sum_file_sizes(files: Iterable[Path]) -> int:
    """Return the bytes of all files."""
    return sum(file.stat().st_size for file in files)


ProgressCallback = Callable[[float], None]
"""Reports how far a reader is, in the unit of its total."""


@contextmanager
def reading_progress(name: str, size: int, total: float) -> Iterator[ProgressCallback]:
    """Report the reading of a large recording to whoever listens to progress.

    Args:
        size: its bytes; nothing is reported of a small recording.
        total: what the reader counts to.
    """
    if size < _PROGRESS_MIN_BYTES:
        yield lambda done: None
        return
    stage_name = f"reading {name}, per cent"
    yield lambda done: report_progress(stage_name, 100.0 * done / total, 100.0)
    report_progress(stage_name, 100.0, 100.0)


@contextmanager
def optional_import(extra: str, package: str, feature: str) -> Iterator[None]:
    """Import the package of a format; where it is not installed, say which extra brings it."""
    try:
        yield
    except ImportError as error:
        raise UsageError(
            f"{feature} needs the package {package}, which is not installed; install it with: pip"
            f' install "residnet[{extra}]"'
        ) from error


@contextmanager
def wrap_read_errors(path: Path, file_description: str) -> Iterator[None]:
    """Damaged files fail in every layer of a library: tell so in one line, as what they are not."""
    try:
        yield
    except ResidnetError:
        raise
    except Exception as error:
        reason = truncate(f"{type(error).__name__}: {' '.join(str(error).split())}", 200)
        raise DataError(f"{path}: damaged or not {file_description} ({reason})") from error


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
            **describe_provenance(path, len(log), 0),
        }
        return log.replace(name=path.stem, t=t, meta=meta)

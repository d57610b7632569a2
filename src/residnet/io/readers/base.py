"""Base classes and helpers of log readers, and the reader of canonical logs (`Log.save`)."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar, Literal, Self, final

import numpy as np

from residnet.core.config import Config
from residnet.core.errors import DataError, ResidnetError, UsageError
from residnet.core.files import sha256
from residnet.core.log import Log
from residnet.core.names import CHANNEL_UNITS, suggest_name, truncate
from residnet.core.progress import report_progress

# smaller recordings are read in less than a second and need no progress bar, bytes
_PROGRESS_MIN_BYTES = 50_000_000
REPORT_INTERVAL = 5000
"""Messages or lines between two progress reports of a reader (some ten reports per second)."""
LARGE_FOLDER_BYTES = 300_000_000
"""Size of a folder in bytes above which a reader skips topics that the config does not use."""


class LogReader(ABC):
    """Reader of one file format, which returns canonical logs."""

    def select_logs(self, paths: Sequence[Path]) -> list[Path]:
        """Return the files that name a log; a reader of several files per log drops the others."""
        return list(paths)

    def list_member_files(self, path: Path) -> list[Path]:
        """Return all files that a log consists of, for example the files in a folder."""
        return list_files(path)

    @abstractmethod
    def read(self, path: Path) -> Log:
        """Read one log in SI units with unwrapped psi and strictly increasing time.

        The name of the log is the stem of the file. `meta` has the keys `source`, `sha256`,
        `rows_read` and `rows_dropped`.

        Raises:
            UsageError: if the file or a column is missing, or a unit has the wrong dimension.
            DataError: if the contents cannot be used.
        """


class ReaderKind(Config, ABC):
    """Base class of reader configs in other packages.

    Attributes:
        kind: `Literal` with the name of the entry point in the group `residnet.readers`.
    """

    kind: str
    formats: ClassVar[Mapping[str, Callable[[Path, bytes], bool]]] = {}
    """Name of a format -> test of a path and its first bytes for this format."""
    endings: ClassVar[tuple[str, ...]] = ()
    """Extensions of the files in lower case, for example `.ulg`."""

    @abstractmethod
    def build(self) -> LogReader:
        """Return the object whose `read` reads files with these settings."""


class ConfiguredReader(ReaderKind, LogReader):
    """Config and reader in one class; a subclass needs `kind` and `read` only."""

    kind: str = ""

    def build(self) -> Self:
        """Return this object, which is config and reader in one."""
        return self


def locate_file(path: Path) -> Path:
    """Return the file of a log: the path itself, or its parent for one test of a file."""
    return path.parent if not path.exists() and path.parent.is_file() else path


def require_file(path: Path) -> None:
    """Raise `UsageError` unless `path` is a file or a test in it; the message suggests names."""
    path = locate_file(path)
    if path.is_dir():
        raise UsageError(
            f"{path}: is a folder, a log file was expected; give one file or a pattern such as"
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
    """Return the provenance of a log for its `meta`.

    Args:
        path: file of the log; `sha256` is the hash of its bytes.
        rows_read: number of rows in the file.
        rows_dropped: number of these rows that the log does not contain.
    """
    return {
        "source": str(path),
        "sha256": hash_files([locate_file(path)]),
        "rows_read": rows_read,
        "rows_dropped": rows_dropped,
    }


def require_samples(path: Path, t: np.ndarray) -> None:
    """Raise `DataError` if a log has fewer than two samples, and therefore no time step."""
    if t.size < 2:
        raise DataError(f"{path}: {t.size} usable rows, at least 2 are needed; leave the file out")


def require_increasing(path: Path, t: np.ndarray, row_label: Callable[[int], str]) -> None:
    """Raise `DataError` if time repeats or runs backwards.

    Args:
        path: file of the log.
        t: times [T] in s.
        row_label: index of a sample -> its row in the file, for the message.
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
            f" ({t[i + 1]:.13g} s), {violations.size} such steps in total; delete the repeated"
            " rows, or split the file where its clock restarts"
        )


def require_values(path: Path, channel: str, column: str, values: np.ndarray) -> None:
    """Raise `DataError` if a channel [T] has no finite value."""
    if not np.isfinite(values).any():
        raise DataError(
            f"{path}: column '{column}' (channel {channel}) holds no number in any of {values.size}"
            " rows; remove it from the channel map, or leave the file out"
        )


def hash_files(files: Sequence[Path]) -> str:
    """Return the SHA-256 of one file, or of the concatenated hashes of several, as hex."""
    checksums = [sha256(file) for file in files]
    return (
        checksums[0]
        if len(checksums) == 1
        else hashlib.sha256("".join(checksums).encode()).hexdigest()
    )


def list_files(path: Path) -> list[Path]:
    """Return all files below a folder in sorted order; for a file or a test in it, the file."""
    if path.is_dir():
        return sorted(file for file in path.rglob("*") if file.is_file())
    return [locate_file(path)]


def sum_file_sizes(files: Iterable[Path]) -> int:
    """Return the total size of files in bytes."""
    return sum(file.stat().st_size for file in files)


ProgressCallback = Callable[[float], None]
"""Function that a reader calls with its progress, in the unit of the total."""


@contextmanager
def reading_progress(name: str, size: int, total: float) -> Iterator[ProgressCallback]:
    """Provide a callback by which a reader reports its progress in a large recording.

    Args:
        name: name of the recording.
        size: size in bytes; small recordings are not reported.
        total: value of the callback's argument at the end.
    """
    if size < _PROGRESS_MIN_BYTES:
        yield lambda done: None
        return
    stage_name = f"reading {name}, per cent"
    yield lambda done: report_progress(stage_name, 100.0 * done / total, 100.0)
    report_progress(stage_name, 100.0, 100.0)


@contextmanager
def optional_import(extra: str, package: str, feature: str) -> Iterator[None]:
    """Turn the failed import of an optional package into an error that names its extra.

    Args:
        extra: extra of residnet that installs the package.
        package: name of the package.
        feature: file format or function that needs it, as subject of the message.

    Raises:
        UsageError: if the package is not installed.
    """
    try:
        yield
    except ImportError as error:
        raise UsageError(
            f"{feature} needs the package {package}, which is not installed; install it with: pip"
            f' install "residnet[{extra}]"'
        ) from error


@contextmanager
def wrap_read_errors(path: Path, file_description: str) -> Iterator[None]:
    """Turn any exception of a library on a damaged file into a `DataError` of one line.

    Args:
        path: file that is read.
        file_description: expected kind of file with its article, for example "a bag".
    """
    try:
        yield
    except ResidnetError:
        raise
    except Exception as error:
        reason = truncate(f"{type(error).__name__}: {' '.join(str(error).split())}", 200)
        raise DataError(f"{path}: damaged or not {file_description} ({reason})") from error


@final
class CanonicalConfig(ConfiguredReader):
    """Reader of logs that residnet wrote; they contain channel names, units and masks."""

    kind: Literal["canonical"] = "canonical"

    def read(self, path: Path) -> Log:
        """Read one log; see `LogReader.read`.

        Raises:
            UsageError: if the file is missing, is no canonical log, or has a known channel in
                another unit than SI.
            DataError: if time does not increase, or the log or a channel has no values.
        """
        require_file(path)
        log = Log.load(path)
        for name, unit in log.units.items():
            if unit != CHANNEL_UNITS.get(name, unit):
                raise UsageError(
                    f"{path}: channel {name} is in [{unit}], [{CHANNEL_UNITS[name]}] was expected"
                    " in a canonical log; convert it and save again"
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

"""Files of a recording: their identity, and progress through large ones."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from residnet.core.errors import UsageError
from residnet.core.progress import report

# recordings below this size are read before anybody waits, bytes
_LARGE = 50_000_000


def digest(files: Sequence[Path]) -> str:
    """Return the SHA-256 of one file's bytes, or of the digests of several in order, as hex."""
    if len(files) == 1:
        return _file_digest(files[0])
    return hashlib.sha256("".join(_file_digest(file) for file in files).encode()).hexdigest()


def _file_digest(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


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
        name: of the file.
        size: its bytes; nothing is reported of a small recording.
        total: what the reader counts to.
    """
    if size < _LARGE:
        yield lambda done: None
        return
    stage = f"reading {name}, per cent"
    yield lambda done: report(stage, 100.0 * done / total, 100.0)
    report(stage, 100.0, 100.0)


def missing_package(extra: str, package: str, name: str) -> UsageError:
    """Return the error for a format whose package is not installed."""
    return UsageError(
        f"{name} needs the package {package}, which is not installed; install it with: pip install"
        f' "residnet[{extra}]"'
    )

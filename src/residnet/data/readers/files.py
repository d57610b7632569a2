"""Files of a recording: their identity, and progress through large ones."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

from residnet.core.errors import UsageError

# recordings below this size are read before a bar would be seen, bytes
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


class Advance(Protocol):
    """Tells the bar how far a reader is, in the unit of its total."""

    def __call__(self, done: float) -> None: ...


@contextmanager
def progress(name: str, size: int, total: float) -> Iterator[Advance]:
    """Return a bar on standard error while a recording of `size` bytes is read.

    None where it is small or nobody watches.

    Args:
        what: name of the file.
        size: its bytes.
        total: what `done` counts to.
    """
    import sys

    if size < _LARGE or not sys.stderr.isatty():
        yield lambda done: None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("reading {task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(name, total=total)
        yield lambda done: bar.update(task, completed=done)


def missing_package(extra: str, package: str, name: str) -> UsageError:
    """Return the error for a format whose package is not installed."""
    return UsageError(
        f"{name} needs the package {package}, which is not installed; install it with: pip install"
        f' "residnet[{extra}]"'
    )

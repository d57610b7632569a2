"""Logs by the files and folders that a command names."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from residnet.core.errors import UsageError
from residnet.data.parts import logs_below

_TABLES = (".csv", ".parquet")


def log_files(paths: Sequence[Path], folders: bool = False) -> list[Path]:
    """Return the files, and the logs below folders, in order; each once.

    Args:
        paths: files and folders.
        folders: a folder may itself be a log, as a ROS 2 bag is, and where a folder holds neither
            such nor tables, logs of any other format are taken.

    Raises:
        UsageError: where a path does not exist or a folder holds no log.
    """
    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            below = logs_below(path) if folders else sorted(path.rglob("*"))
            # notes and settings often lie beside tables
            found = [p for p in below if (folders and p.is_dir()) or p.suffix in _TABLES]
            if not found and folders:
                found = below
            if not found:
                more = ", and no log of another format" if folders else ""
                raise UsageError(f"{path}: holds no csv or Parquet file{more}")
            files += found
        elif path.is_file():
            files.append(path)
        else:
            raise UsageError(f"{path}: no such file or folder")
    once: dict[Path, Path] = {}
    for file in files:
        once.setdefault(file.resolve(), file)
    return list(once.values())

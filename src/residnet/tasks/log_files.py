"""Logs by the files and folders that a command names."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from residnet.core.errors import UsageError
from residnet.data.readers.detect import format_of


def log_files(paths: Sequence[Path], folders: bool = False) -> list[Path]:
    """Return the files, and the csv and Parquet files below folders, in order.

    Args:
        paths: files and folders.
        folders: a folder that is itself a recording stays one.

    Raises:
        UsageError: where a path does not exist or a folder holds no log.
    """
    files: list[Path] = []
    for path in paths:
        if path.is_dir() and folders and format_of(path) is not None:
            files.append(path)
        elif path.is_dir():
            found = sorted(p for p in path.rglob("*") if p.suffix in {".csv", ".parquet"})
            if not found:
                raise UsageError(f"{path}: holds no csv or Parquet file")
            files += found
        elif path.is_file():
            files.append(path)
        else:
            raise UsageError(f"{path}: no such file or folder")
    return files

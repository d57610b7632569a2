"""Logs by the files and folders that a command names."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from residnet.core.errors import UsageError
from residnet.data.parts import logs_below


def log_files(paths: Sequence[Path], folders: bool = False) -> list[Path]:
    """Return the files, and the logs below folders, in order.

    Args:
        paths: files and folders.
        folders: a folder may itself be a log, as a ROS 2 bag is, and logs below folders are of any
            format; else they are csv and Parquet files.

    Raises:
        UsageError: where a path does not exist or a folder holds no log.
    """
    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            found = (
                logs_below(path)
                if folders
                else sorted(p for p in path.rglob("*") if p.suffix in {".csv", ".parquet"})
            )
            if not found:
                known = "log of a format that is known" if folders else "csv or Parquet file"
                raise UsageError(f"{path}: holds no {known}")
            files += found
        elif path.is_file():
            files.append(path)
        else:
            raise UsageError(f"{path}: no such file or folder")
    return files

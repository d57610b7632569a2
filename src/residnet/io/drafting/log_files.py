"""Log files in folders, and texts on files that are no logs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from residnet.core.errors import UsageError
from residnet.io.readers.base import locate_file
from residnet.io.readers.detect import suggest_conversion
from residnet.io.readers.several_tests import expand_files
from residnet.io.split import find_logs

_TABLE_SUFFIXES = (".csv", ".tsv", ".parquet")


def find_log_files(paths: Sequence[Path]) -> list[Path]:
    """Return all logs in files and folders without duplicates, in sorted order.

    A file with several tests is a log for each test. A folder may itself be a log, such as a ROS 2
    bag. In a folder without bags, csv and Parquet
    files, logs of other formats are used.

    Raises:
        UsageError: if a path does not exist or a folder has no log.
    """
    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            nested_logs = find_logs(path)
            # other files next to tables are often notes and settings
            preferred_logs = [
                p for p in nested_logs if p.is_dir() or p.suffix in _TABLE_SUFFIXES
            ] or nested_logs
            if not preferred_logs:
                raise UsageError(
                    f"{path}: has no log of a known format{describe_other_files(path)}"
                )
            files += preferred_logs
        elif locate_file(path).is_file():
            files.append(path)
        else:
            raise UsageError(f"{path}: no such file or folder")
    unique_files: dict[Path, Path] = {}
    for file in expand_files(files):
        unique_files.setdefault(file.resolve(), file)
    return list(unique_files.values())


def describe_other_files(folder: Path) -> str:
    """Return a text with the types of files in a folder and how to convert them; may be empty."""
    endings = Counter(path.suffix.lower() for path in folder.rglob("*") if path.is_file())
    counts_text = ", ".join(
        f"{n} file{'s' * (n > 1)} {suffix or 'without ending'}" for suffix, n in endings.items()
    )
    most_frequent = max(endings, key=lambda ending: endings[ending], default="")
    return f", but {counts_text[:120]}; {suggest_conversion(most_frequent)}" if counts_text else ""

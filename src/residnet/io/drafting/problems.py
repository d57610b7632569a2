"""Messages about problems of many files: one line for all files with the same problem."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

from residnet.core.errors import DataError, ResidnetError
from residnet.core.names import truncate

_MAX_FILE_NAMES_LENGTH = 100
"""Largest number of characters for the list of files with the same problem."""


class UnreadableLogsError(DataError):
    """No file of a group of logs can be read.

    Attributes:
        errors: error of each file.
    """

    def __init__(self, errors: Mapping[Path, ResidnetError]) -> None:
        self.errors = dict(errors)
        super().__init__(group_problems({path: str(error) for path, error in errors.items()})[0])


def raise_unreadable(errors: Mapping[Path, ResidnetError]) -> NoReturn:
    """Raise the error of a single file, or one error for several files.

    Raises:
        ResidnetError: always.
    """
    raise next(iter(errors.values())) if len(errors) == 1 else UnreadableLogsError(errors)


@contextmanager
def name_files_in_errors(paths: Sequence[Path]) -> Iterator[None]:
    """Let the message of a `DataError` begin with the path of a file that it is about.

    Args:
        paths: the files of which some or all have the problem, at least one.
    """
    try:
        yield
    except DataError as error:
        message = str(error)
        if any(str(path) in message for path in paths):
            raise
        labels = label_files(paths)
        other_files_text = describe_other_files_with_problem([labels[path] for path in paths[1:]])
        raise DataError(f"{paths[0]}: {message}{other_files_text}") from None


def strip_file_name(paths: Iterable[Path], message: str) -> str:
    """Return a message without the path of one of its files at the start."""
    for path in paths:
        if message.startswith(f"{path}: "):
            return message.removeprefix(f"{path}: ")
    return message


def label_files(paths: Iterable[Path]) -> dict[Path, str]:
    """Return the names of files, with their folders where several files have the same name."""
    all_paths = list(paths)
    counts = Counter(path.name for path in all_paths)
    return {
        path: path.name if counts[path.name] == 1 else f"{path.parent.name}/{path.name}"
        for path in all_paths
    }


def group_problems(messages: Mapping[Path, str], *, has_full_paths: bool = True) -> list[str]:
    """Return one line for each problem, with the number of files that have it.

    Messages that differ in numbers only are one problem; the line has the numbers of the first
    file.

    Args:
        messages: message by path, which may begin with the path.
        has_full_paths: whether a line begins with the path of its first file, not with its name.
    """
    paths_by_problem: dict[str, list[Path]] = {}
    for path, message in messages.items():
        pattern = re.sub(
            r"[-+]?\d+(?:\.\d+)?(?:e[+-]?\d+)?", "#", strip_file_name(messages, message)
        )
        paths_by_problem.setdefault(pattern, []).append(path)
    lines = []
    labels = label_files(messages)
    for paths in paths_by_problem.values():
        first_message = strip_file_name(messages, messages[paths[0]])
        other_files_text = describe_other_files_with_problem([labels[path] for path in paths[1:]])
        file = paths[0] if has_full_paths else labels[paths[0]]
        lines.append(f"{file}: {first_message}{other_files_text}")
    return lines


def describe_other_files_with_problem(file_names: Sequence[str]) -> str:
    """Return a remark on further files with the same problem; empty without such files."""
    if not file_names:
        return ""
    names = truncate(", ".join(file_names), _MAX_FILE_NAMES_LENGTH)
    return f" (and {len(file_names)} other file{'s' * (len(file_names) > 1)}: {names})"

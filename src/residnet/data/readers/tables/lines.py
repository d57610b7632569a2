"""Checks of a text table's lines before anything parses them.

Each has as many cells as the header, no zero bytes, and the last line is whole.

A parser fills short lines with nothing and reads on; cells that slipped by one column would be
numbers like any other.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from residnet.core.errors import DataError
from residnet.data.readers.tables.header import BLANKS


class Lines(NamedTuple):
    """What the lines of a table are, beside values.

    Attributes:
        cut: whether the last line must be left out because the file was cut within it: it has no
            end, and too few cells or a last cell shorter than any in that column shortly before.
        comments: numbers of the lines below the header that are comments, from 0.
    """

    cut: bool
    comments: tuple[int, ...]


_BLOCK = 1 << 18
_COMMENT = (b"#", b"%", b"//")
_TAIL = 1 << 16
_NEWLINE, _RETURN, _QUOTE = 0x0A, b"\r", b'"'


def check_lines(
    path: Path, delimiter: str, header: Sequence[str], above: int = 1, file: Path | None = None
) -> Lines:
    """Look at every line of values, as many cells each as the header; blank lines do not count.

    A delimiter more or less at the end of every line makes no cell.

    Args:
        path: of the table.
        delimiter: between cells.
        header: names of the columns.
        above: number of lines above the values.
        file: that holds its text as UTF-8; None for `path` itself.

    Returns:
        Whether the last line is left out, and which lines are comments: those that begin with `#`,
        `%` or `//`.

    Raises:
        DataError: where a line has more or fewer cells than the header, or a byte is zero.
    """
    wide, file = len(header), file or path
    # names that are missing at the end are those of cells that are not there
    named = max((i for i, name in enumerate(header, start=1) if name), default=wide)
    cut, line = _cut_short(file, delimiter, named), 0
    comments: list[int] = []
    for block, last in _blocks(file):
        if b"\x00" in block:
            at = line + block[: block.index(b"\x00")].count(b"\n") + 1
            raise DataError(
                f"{path}: line {at} holds a zero byte, which no text has; the file is damaged or"
                " not UTF-8, write it again"
            )
        cells, blank = _cells(block, delimiter, wide)
        odd = (cells != wide) & ~blank
        odd[: max(above - line, 0)] = False
        said = [i for i in _comments(block) if line + i >= above]
        comments += [line + i for i in said]
        odd[[i for i in said if i < odd.size]] = False
        if odd.any():
            # rarely so: an empty cell more at the end of lines, or without names
            ended = _ended(block, delimiter, cells.size)
            odd &= ~((cells >= named) & (cells < wide)) & ~((cells == wide + 1) & ended)
        if last and cut:
            odd[-1:] = False
        if odd.any():
            at = int(np.argmax(odd))
            raise DataError(
                f"{path}: line {line + at + 1} has {cells[at]} cells, the header {wide}"
                f" ({int(odd.sum())} such lines nearby); check `delimiter` and `decimal`, or delete"
                " the damaged lines"
            )
        line += cells.size
    return Lines(cut and line - 1 not in comments[-1:], tuple(comments))


def comment_lines(file: Path, above: int) -> list[int]:
    """Return the numbers, from 0, of the lines of a table below its header that are comments."""
    found, line = [], 0
    for block, _ in _blocks(file):
        found += [line + i for i in _comments(block) if line + i >= above]
        line += len(_lines(block))
    return found


def _comments(block: bytes) -> list[int]:
    """Return which lines of a block are comments."""
    if not any(sign in block for sign in _COMMENT):
        return []
    return [i for i, line in enumerate(_lines(block)) if line.lstrip().startswith(_COMMENT)]


def _blocks(path: Path) -> Iterator[tuple[bytes, bool]]:
    """Return the blocks of whole lines with line ends of one byte, and whether it is the last."""
    with path.open("rb") as stream:
        rest = b""
        while True:
            block = stream.read(_BLOCK)
            text = rest + block
            if _RETURN in text:
                # the other half of a line end may stand in the next block
                held = text.endswith(_RETURN) and bool(block)
                text, tail = (text[:-1], _RETURN) if held else (text, b"")
                text = text.replace(b"\r\n", b"\n").replace(_RETURN, b"\n")
            else:
                tail = b""
            if not block:
                if text:
                    yield text, True
                return
            # an open quote takes its line ends along
            end = text.rfind(b"\n") + 1 if text.count(_QUOTE) % 2 == 0 else 0
            if end:
                yield text[:end], False
            rest = text[end:] + tail


def _cells(block: bytes, delimiter: str, wide: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the cells of each line, and whether it is blank."""
    if delimiter == BLANKS:
        counts = np.array([len(line.split()) for line in _lines(block)], dtype=np.int64)
        return counts, counts == 0
    return _quoted(block, delimiter) if _QUOTE in block else _counted(block, delimiter, wide)


def _lines(block: bytes) -> list[bytes]:
    lines = block.split(b"\n")
    return lines if lines[-1] else lines[:-1]


def _ended(block: bytes, delimiter: str, count: int) -> np.ndarray:
    """Return for each line whether it ends with a delimiter; all not where they cannot be told."""
    ended = np.array([line.rstrip(b" ").endswith(delimiter.encode()) for line in _lines(block)])
    return ended if ended.size == count else np.zeros(count, dtype=bool)


def _counted(block: bytes, delimiter: str, wide: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the cells of each line, and whether it is blank."""
    values = np.frombuffer(block, dtype=np.uint8)
    # the usual block: every so many marks one is the end of a line, the others are delimiters
    marks = values[np.flatnonzero((values == _NEWLINE) | (values == ord(delimiter)))]
    if marks.size % wide == 0 and block.endswith(b"\n") and wide > 1:
        rows = marks.reshape(-1, wide)
        if (
            bool((rows[:, -1] == _NEWLINE).all())
            and int((marks == _NEWLINE).sum()) == rows.shape[0]
        ):
            return np.full(rows.shape[0], wide, dtype=np.int64), np.zeros(rows.shape[0], dtype=bool)
    ends = np.flatnonzero(values == _NEWLINE)
    if not ends.size or ends[-1] != values.size - 1:
        ends = np.append(ends, values.size)
    between = np.searchsorted(np.flatnonzero(values == ord(delimiter)), ends)
    starts = np.append(0, ends[:-1] + 1)
    cells = np.diff(np.append(0, between)) + 1
    # only lines without a delimiter can be blank
    blank = np.zeros(cells.size, dtype=bool)
    for i in np.flatnonzero(cells == 1):
        blank[i] = not block[starts[i] : ends[i]].strip()
    return cells, blank


def _quoted(block: bytes, delimiter: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the same where quotes may hold delimiters, but no line ends."""
    try:
        rows = list(
            csv.reader(
                io.StringIO(block.decode("utf-8", errors="replace"), newline=""),
                delimiter=delimiter,
                skipinitialspace=True,
            )
        )
    except csv.Error:
        # a cell of more than 128 kB: an open quote has swallowed the lines after it
        return np.zeros(1, dtype=np.int64), np.zeros(1, dtype=bool)
    cells = np.array([len(row) for row in rows], dtype=np.int64)
    return cells, np.array(
        [not row or (len(row) == 1 and not row[0].strip()) for row in rows], dtype=bool
    )


def _cut_short(path: Path, delimiter: str, wide: int) -> bool:
    """Return whether the file ends within its last line."""
    with path.open("rb") as stream:
        size = stream.seek(0, io.SEEK_END)
        stream.seek(max(0, size - _TAIL))
        tail = stream.read()
    if not tail or tail.endswith((b"\n", b"\r")):
        return False
    lines = [line for line in tail.replace(_RETURN, b"\n").split(b"\n") if line.strip()]
    mark = None if delimiter == BLANKS else delimiter.encode()
    last, before = lines[-1].split(mark), [line.split(mark) for line in lines[-51:-1]]
    # the first of several lines may itself be cut, by the tail, or be the header
    known = [
        len(cells[-1].strip()) for cells in before[1:] if len(cells) == wide and cells[-1].strip()
    ]
    if size <= _TAIL and len(lines) < 2:
        return False
    return len(last) < wide or (
        bool(known) and len(last) == wide and len(last[-1].strip()) < min(known)
    )

"""Lines of text tables: their cells, and the check that every line suits the header."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from residnet.core.errors import DataError
from residnet.io.readers.text_encoding import HEAD_BYTES

WHITESPACE_DELIMITER = " "
"""Delimiter of tables whose cells are separated by any number of blanks and tabs."""
_BLOCK_BYTES = 1 << 18
"""Size in bytes of the blocks in which a file is split into lines."""
_COMMENT_SIGNS = (b"#", b"%", b"//")


class Header(NamedTuple):
    """Header of a text table.

    Attributes:
        names: column names.
        n_lines_above: number of lines above the first line with values.
    """

    names: tuple[str, ...]
    n_lines_above: int


def split_line(line: str, delimiter: str) -> list[str]:
    """Return the cells of one line; a line that the csv parser rejects is one cell."""
    if delimiter == WHITESPACE_DELIMITER:
        return line.split()
    try:
        row = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
    except csv.Error:
        return [line]
    return [cell.strip() for cell in row]


def check_lines(
    path: Path, delimiter: str, header: Header, file: Path
) -> tuple[bool, list[int], int]:
    """Check that every line has the same number of cells as the header.

    pandas fills short lines with NaN and shifts cells silently. Blank lines are accepted, and so is
    an additional or a missing delimiter at the end of all lines.

    Args:
        path: file of the table, for messages.
        delimiter: separator of cells.
        header: header of the table.
        file: the same text in UTF-8.

    Returns:
        Whether the file ends within its last line, and the indices of lines without values, which
        begin with `#`, `%` or `//`, repeat the column names, or hold separators only; and the
        number of the latter.

    Raises:
        DataError: if a line has another number of cells, or a zero byte.
    """
    n_columns = len(header.names)
    n_lines_above = header.n_lines_above
    # columns without a name at the end may have no cells
    n_named_columns = max(
        (i for i, name in enumerate(header.names, start=1) if name), default=n_columns
    )
    is_truncated = _is_truncated(file, delimiter, n_named_columns)
    n_lines = 0
    n_blank_lines = 0
    comments: list[int] = []
    for first_line, block, is_last_block in iter_line_blocks(file):
        if b"\x00" in block:
            line_index = first_line + block[: block.index(b"\x00")].count(b"\n") + 1
            raise DataError(
                f"{path}: line {line_index} contains a zero byte; the file is damaged or not UTF-8,"
                " export it again"
            )
        cells = _count_cells(block, delimiter, n_columns)
        is_irregular = (cells != n_columns) & (cells != 0)
        is_irregular[: max(n_lines_above - first_line, 0)] = False
        skipped_lines = find_comment_lines(
            block, delimiter, header.names, n_lines_above - first_line
        )
        if is_irregular.any():
            # a spreadsheet writes blank rows as separators, often fewer than the header has
            separator_lines = find_separator_lines(block, delimiter, n_columns)
            n_blank_lines += len(separator_lines)
            skipped_lines += separator_lines
        comments += [first_line + i for i in sorted({*skipped_lines})]
        is_irregular[[i for i in skipped_lines if i < is_irregular.size]] = False
        if is_irregular.any():
            # rare, therefore tested only now: an empty cell or a column without a name at the end
            rows = split_lines(block)
            sign = delimiter.encode()
            has_trailing_delimiter = np.array([row.rstrip(b" ").endswith(sign) for row in rows])
            is_irregular &= ~((cells >= n_named_columns) & (cells < n_columns))
            is_irregular &= (
                ~((cells == n_columns + 1) & has_trailing_delimiter)
                if has_trailing_delimiter.size == cells.size
                else True
            )
        if is_last_block and is_truncated:
            is_irregular[-1:] = False
        if is_irregular.any():
            line_index = int(np.argmax(is_irregular))
            raise DataError(
                f"{path}: line {first_line + line_index + 1} has {cells[line_index]} cells, the"
                f" header {n_columns} ({int(is_irregular.sum())} such lines nearby); check"
                " `delimiter` and `decimal`, or delete the damaged lines"
            )
        n_lines = first_line + cells.size
    return is_truncated and n_lines - 1 not in comments[-1:], comments, n_blank_lines


def iter_line_blocks(path: Path) -> Iterator[tuple[int, bytes, bool]]:
    """Yield blocks of complete lines, with line ends of one byte.

    A block ends outside quotation marks, because a quoted cell may contain line ends.

    Yields:
        The index of the first line, the bytes, and whether this is the last block.
    """
    with path.open("rb") as stream:
        pending = b""
        line_number = 0
        while True:
            block = stream.read(_BLOCK_BYTES)
            text = pending + block
            tail = b""
            if b"\r" in text:
                # the \n of a Windows line end may be in the next block
                if block and text.endswith(b"\r"):
                    text = text[:-1]
                    tail = b"\r"
                text = text.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
            if not block:
                if text:
                    yield line_number, text, True
                return
            block_end = text.rfind(b"\n") + 1 if text.count(b'"') % 2 == 0 else 0
            if block_end:
                yield line_number, text[:block_end], False
                line_number += text.count(b"\n", 0, block_end)
            pending = text[block_end:] + tail


def split_lines(block: bytes) -> list[bytes]:
    lines = block.split(b"\n")
    return lines if lines[-1] else lines[:-1]


def find_comment_lines(
    block: bytes, delimiter: str, names: Sequence[str], n_lines_above: int
) -> list[int]:
    """Return the indices of lines in a block that are comments or repeat the column names.

    Args:
        block: complete lines.
        delimiter: separator of cells.
        names: column names.
        n_lines_above: number of lines at the start of the block to ignore; may be negative.
    """
    header_cells = list(names)
    # a search for bytes excludes most blocks without splitting them into lines
    longest_name = max(names, key=len, default="").encode() or _COMMENT_SIGNS[0]
    offset = 0
    for _ in range(n_lines_above):
        offset = block.find(b"\n", offset) + 1 or len(block)
    block = block[offset:]
    if not any(sign in block for sign in (*_COMMENT_SIGNS, longest_name)):
        return []
    return [
        i
        for i, line in enumerate(split_lines(block), max(n_lines_above, 0))
        if line.lstrip().startswith(_COMMENT_SIGNS)
        or (
            longest_name in line
            and split_line(line.decode("utf-8", "replace"), delimiter) == header_cells
        )
    ]


def find_separator_lines(block: bytes, delimiter: str, n_columns: int) -> list[int]:
    """Return the indices of blank lines in a block whose number of separators is irregular.

    Args:
        block: complete lines.
        delimiter: separator of cells.
        n_columns: number of cells of a regular line.
    """
    sign = delimiter.encode()
    if delimiter == WHITESPACE_DELIMITER or not re.search(
        rb"(?m)^[" + re.escape(sign) + rb" ]+$", block
    ):
        return []
    return [
        i
        for i, line in enumerate(split_lines(block))
        if sign in line
        and not line.replace(sign, b"").strip()
        and line.count(sign) + 1 != n_columns
    ]


def _count_cells(block: bytes, delimiter: str, n_columns: int) -> np.ndarray:
    """Return the number of cells in each line, int [K]; 0 for blank lines.

    Args:
        block: complete lines.
        delimiter: separator of cells.
        n_columns: expected number, for which a fast test exists.
    """
    if delimiter == WHITESPACE_DELIMITER:
        return np.array([len(line.split()) for line in split_lines(block)], dtype=np.int64)
    if b'"' in block:
        text = io.StringIO(block.decode("utf-8", errors="replace"), newline="")
        reader = csv.reader(text, delimiter=delimiter, skipinitialspace=True)
        try:
            return np.array([len(row) if any(row) or len(row) > 1 else 0 for row in reader])
        except csv.Error:
            # a cell of more than 128 kB: an unclosed quotation mark includes the following lines
            return np.ones(1, dtype=np.int64)
    delimiter_bytes = delimiter.encode()
    if n_columns > 1 and len(delimiter_bytes) == 1:
        # fast test of regular blocks: n_columns - 1 delimiters and a line end, repeated
        separator_bytes = block.translate(
            None, bytes({*range(256)} - {delimiter_bytes[0], ord("\n")})
        )
        if separator_bytes == (delimiter_bytes * (n_columns - 1) + b"\n") * (
            len(separator_bytes) // n_columns
        ):
            return np.full(len(separator_bytes) // n_columns, n_columns)
    lines = split_lines(block)
    cells = np.array([line.count(delimiter_bytes) for line in lines], dtype=np.int64) + 1
    for i in np.flatnonzero(cells == 1):
        cells[i] = bool(lines[i].strip())
    return cells


def _is_truncated(path: Path, delimiter: str, n_columns: int) -> bool:
    """Return whether the file ends within its last line.

    Such a line has no line end, and either too few cells or a last cell that is shorter than those
    of the 50 previous lines.
    """
    with path.open("rb") as stream:
        size = stream.seek(0, io.SEEK_END)
        stream.seek(max(0, size - HEAD_BYTES))
        tail = stream.read()
    if not tail or tail.endswith((b"\n", b"\r")):
        return False
    lines = [line for line in tail.replace(b"\r", b"\n").split(b"\n") if line.strip()]
    delimiter_bytes = None if delimiter == WHITESPACE_DELIMITER else delimiter.encode()
    last_cells = lines[-1].split(delimiter_bytes)
    previous_lines = [line.split(delimiter_bytes) for line in lines[-51:-1]]
    # the first line of the tail may itself be incomplete, or be the header
    last_cell_lengths = [
        len(cells[-1].strip())
        for cells in previous_lines[1:]
        if len(cells) == n_columns and cells[-1].strip()
    ]
    if size <= HEAD_BYTES and len(lines) < 2:
        return False
    return len(last_cells) < n_columns or (
        bool(last_cell_lengths)
        and len(last_cells) == n_columns
        and len(last_cells[-1].strip()) < min(last_cell_lengths)
    )

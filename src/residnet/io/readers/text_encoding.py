"""Encoding of text files: its detection, and the text of a file in UTF-8."""

from __future__ import annotations

import codecs
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import numpy as np

from residnet.core.errors import DataError
from residnet.io.header_vocabulary import parse_name

_SCAN_BYTES = 1 << 20
"""Size in bytes of the blocks in which a file is searched for bytes that are not UTF-8."""
HEAD_BYTES = 1 << 16
"""Number of bytes at the start of a file in which its format is detected, and at its end in which
the last line is read."""
# longer marks first: the mark of UTF-32 (little endian) starts with that of UTF-16
_BYTE_ORDER_MARKS = {
    codecs.BOM_UTF8: "utf-8",
    codecs.BOM_UTF32_LE: "utf-32",
    codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}
_ENCODINGS = ("cp1252", "cp1250", "cp1251", "cp932", "cp949", "gb18030")
"""Encodings of recorders that do not write Unicode, the most frequent one first."""
_MAX_ENCODING_LINES = 200
"""Lines with other than ASCII characters from which an encoding is detected."""


def detect_encoding(path: Path) -> str:
    """Return the encoding of a text file.

    A byte order mark decides first, then whether the complete file is UTF-8. Otherwise the
    encodings of Western and Central Europe, Russia, Japan, Korea and China are compared:
    charset-normalizer excludes those that give implausible characters. A header has too few words
    for its language statistics, so the encoding wins in which most cells are known column names.
    """
    from charset_normalizer import from_bytes

    with path.open("rb") as stream:
        bom_encoding = _encoding_from_bom(stream.read(HEAD_BYTES))
        if bom_encoding is not None:
            return bom_encoding
        stream.seek(0)
        block = _find_non_utf8_block(stream)
    if not block:
        return "utf-8"
    # numbers say nothing about an encoding, and lines often repeat
    foreign_lines = dict.fromkeys(line for line in block.split(b"\n") if not line.isascii())
    sample = b"\n".join(list(foreign_lines)[:_MAX_ENCODING_LINES])
    candidates: list[tuple[int, float, int]] = []
    for match in from_bytes(sample, cp_isolation=list(_ENCODINGS), preemptive_behaviour=False):
        # the vocabulary of column names maps their words to concepts such as rudder or speed
        cells = {cell for line in str(match).splitlines() for cell in re.split(r"[,;|\t]", line)}
        n_concepts = sum(len(parse_name(cell).concepts) for cell in cells if not cell.isascii())
        # encodings that give the same text are one match
        candidates += [
            (-n_concepts, match.chaos, _ENCODINGS.index(name))
            for name in match.could_be_from_charset
            if name in _ENCODINGS
        ]
    # latin-1 decodes every byte, so that numbers and ASCII names remain readable
    return _ENCODINGS[min(candidates)[2]] if candidates else "latin-1"


def detect_encoding_of_head(head: bytes) -> str:
    """Return the encoding of a text from its first bytes: a Unicode encoding, UTF-8 by default."""
    return _encoding_from_bom(head) or "utf-8"


@contextmanager
def open_as_utf8(path: Path, encoding: str | None = None) -> Iterator[Path]:
    """Provide the text of a file in UTF-8, possibly with a byte order mark.

    Zero bytes at the end, which some recorders write in advance, are removed.

    Args:
        path: file of the text.
        encoding: encoding of the file; None detects it.

    Yields:
        `path` itself if it is UTF-8, otherwise a temporary copy that is deleted afterwards.

    Raises:
        DataError: if the file is not text in this encoding.
    """
    name = codecs.lookup(encoding or detect_encoding(path)).name
    is_multibyte = name.startswith(("utf-16", "utf-32"))
    with path.open("rb") as stream:
        stream.seek(max(0, path.stat().st_size - 1))
        has_trailing_zeros = not is_multibyte and stream.read() == b"\0"
    if name in ("utf-8", "utf-8-sig", "ascii") and not has_trailing_zeros:
        yield path
        return
    content = path.read_bytes()
    content = content.rstrip(b"\0") if has_trailing_zeros else content
    try:
        # an incremental decoder ignores an incomplete character at the end
        text = codecs.getincrementaldecoder(name)().decode(content)
    except UnicodeError as error:
        error_position = getattr(error, "start", 0)
        raise DataError(
            f"{path}: not {name.upper()} text (near byte {error_position}); save the file as UTF-8,"
            " or give its `encoding`"
        ) from error
    with tempfile.TemporaryDirectory() as folder:
        utf8_copy = Path(folder) / path.name
        utf8_copy.write_bytes(text.encode("utf-8"))
        yield utf8_copy


def _encoding_from_bom(head: bytes) -> str | None:
    """Return a Unicode encoding from the byte order mark or the zero bytes of UTF-16, else None."""
    for mark, name in _BYTE_ORDER_MARKS.items():
        if head.startswith(mark):
            return name
    if len(head) < 4 or b"\x00" not in head:
        return None
    byte_pairs = np.frombuffer(head[: len(head) // 2 * 2], dtype=np.uint8).reshape(-1, 2)
    even_zero_share, odd_zero_share = (byte_pairs == 0).mean(axis=0)
    if odd_zero_share > 0.5 and even_zero_share < 0.01:
        return "utf-16-le"
    return "utf-16-be" if even_zero_share > 0.5 and odd_zero_share < 0.01 else None


def _find_non_utf8_block(stream: BinaryIO) -> bytes:
    """Return the complete lines of the first block that is not UTF-8; empty if all blocks are."""
    decoder = codecs.getincrementaldecoder("utf-8")()
    while block := stream.read(_SCAN_BYTES):
        try:
            if not (block.isascii() and decoder.getstate()[0] == b""):
                decoder.decode(block)
        except UnicodeDecodeError:
            return block[: block.rfind(b"\n") + 1] or block
    return b""

"""Text files of any encoding, read as UTF-8: the encoding is found by the bytes themselves."""

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

_BLOCK = 1 << 20
_HEAD = 1 << 16
# the longer marks first: one of UTF-32 begins as one of UTF-16 does
_MARKS = {
    codecs.BOM_UTF8: "utf-8",
    codecs.BOM_UTF32_LE: "utf-32",
    codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}
_JAPANESE = re.compile(r"[\u3040-\u30ff\u4e00-\u9fff]")
_LATIN = re.compile(r"[\x00-\x7fÀ-ÿ°º²³µ·±´×–’]*")
_ASCII = bytes(range(128))


def encoding_of(path: Path) -> str:
    """Return the encoding of a text file: by its byte order mark, else by what its bytes can be.

    Text without a mark is UTF-8 where all of it can be, else UTF-16, Japanese (cp932) or Western
    European (cp1252).
    """
    with path.open("rb") as stream:
        told = _told(stream.read(_HEAD))
        if told is not None:
            return told
        stream.seek(0)
        return _of_bytes(_first_beyond_utf8(stream))


def encoding_of_head(head: bytes) -> str:
    """Return the encoding of a text from its first bytes alone."""
    return _told(head) or "utf-8"


@contextmanager
def as_utf8(path: Path, encoding: str | None = None) -> Iterator[Path]:
    """Yield a file that holds the text of `path` in UTF-8, perhaps behind a byte order mark.

    It is `path` itself where that is UTF-8, or else a temporary one, gone after the context. Zero
    bytes at its end, with which recorders fill what they have not written, are left out.

    Args:
        path: of the text.
        encoding: its name; None finds it.

    Raises:
        DataError: where the text is not of this encoding.
    """
    name = codecs.lookup(encoding or encoding_of(path)).name
    wide = name.startswith(("utf-16", "utf-32"))
    size = path.stat().st_size - (0 if wide else _zeros_at_end(path))
    if name in ("utf-8", "utf-8-sig", "ascii") and size == path.stat().st_size:
        yield path
        return
    with path.open("rb") as stream:
        content = stream.read(size)
    try:
        # half a sign at the end is left out
        text = codecs.getincrementaldecoder(name)().decode(content)
    except UnicodeError as error:
        at = getattr(error, "start", 0)
        raise DataError(
            f"{path}: not {name.upper()} text (near byte {at}); save the file as UTF-8, or give its"
            " `encoding`"
        ) from error
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / path.name
        copy.write_bytes(text.encode("utf-8"))
        yield copy


def _zeros_at_end(path: Path) -> int:
    with path.open("rb") as stream:
        size = at = stream.seek(0, 2)
        while at:
            at = max(0, at - _HEAD)
            stream.seek(at)
            filled = stream.read(_HEAD).rstrip(b"\0")
            if filled:
                return size - at - len(filled)
    return size


def _told(head: bytes) -> str | None:
    """Return the encoding that a mark, or the zeros of wide signs, tell; None for neither."""
    for mark, name in _MARKS.items():
        if head.startswith(mark):
            return name
    if len(head) < 4 or b"\x00" not in head:
        return None
    values = np.frombuffer(head[: len(head) // 2 * 2], dtype=np.uint8).reshape(-1, 2)
    first, second = (values == 0).mean(axis=0)
    if second > 0.5 and first < 0.01:
        return "utf-16-le"
    return "utf-16-be" if first > 0.5 and second < 0.01 else None


def _first_beyond_utf8(stream: BinaryIO) -> bytes:
    """Return the first block that is no UTF-8, whole lines of it; empty where all of it is."""
    decoder = codecs.getincrementaldecoder("utf-8")()
    while block := stream.read(_BLOCK):
        try:
            if not (block.isascii() and decoder.getstate()[0] == b""):
                decoder.decode(block)
        except UnicodeDecodeError:
            return block[: block.rfind(b"\n") + 1] or block
    return b""


def _of_bytes(block: bytes) -> str:
    """Return the encoding of bytes that are no UTF-8; UTF-8 for none."""
    if not block:
        return "utf-8"
    beyond = block.translate(None, _ASCII)
    # a Latin letter and the next one may look like one Japanese sign, but not the other way
    if _LATIN.fullmatch(beyond.decode("cp1252", errors="replace")):
        return "cp1252"
    for name, likely in (("cp932", _JAPANESE), ("cp1252", re.compile(""))):
        try:
            if likely.search(block.decode(name)):
                return name
        except UnicodeDecodeError:
            continue
    # it gives every byte a sign: numbers can be read, and names stay names
    return "latin-1"

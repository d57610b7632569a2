"""Arrays of large data sets in files, whose pages the system may drop from memory."""

from __future__ import annotations

import math
import mmap
import tempfile
import weakref
from collections.abc import Iterator
from pathlib import Path
from threading import Event, Lock, Thread
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from residnet.core.errors import DataError

if TYPE_CHECKING:
    import torch
    from torch import Tensor

Item = TypeVar("Item")

LARGE = 200_000
"""Samples of all logs together from which further ones are kept on disk."""
PIECE = 50_000
"""Rows that are worked on at a time."""
_CHUNK = 1 << 28
"""Bytes of a file that many arrays share: each file holds a descriptor open."""
_ALIGNED = 64
"""Arrays begin at multiples of so many bytes, a cache line, as torch's own do."""

_RESIDENT = 1 << 28
"""Bytes of pages of files beyond which those of arrays are given back."""
_LOOKED_EVERY = 0.02
"""Seconds; pages that the system still has come back at gigabytes a second."""

_files: weakref.WeakSet[mmap.mmap] = weakref.WeakSet()
_lock = Lock()


class _Arena:
    """The file that arrays are being put into."""

    def __init__(self) -> None:
        self.file: mmap.mmap | None = None
        self.end = 0

    def place(self, count: int) -> tuple[mmap.mmap, int]:
        """Return a file with room for so many bytes, and where they go."""
        if self.file is None or self.end + count > len(self.file):
            with tempfile.TemporaryFile(prefix="residnet-") as file:
                try:
                    file.truncate(max(count, _CHUNK))
                    self.file = mmap.mmap(file.fileno(), 0)
                except OSError as error:
                    raise DataError(
                        f"{tempfile.gettempdir()}: no room for the samples of large logs"
                        f" ({error.strerror}); set TMPDIR to a larger disk"
                    ) from error
            with _lock:
                _files.add(self.file)
            _keeper.begin()
            self.end = 0
        start = self.end
        self.end += math.ceil(count / _ALIGNED) * _ALIGNED
        return self.file, start


class _Keeper:
    """Gives back pages while others work with the arrays, who need not know where these lie.

    The system drops them only where another process lacks memory, and until then they count as
    this one's. Where there is no /proc/self/statm they stay.
    """

    def __init__(self) -> None:
        self._begun = False

    def begin(self) -> None:
        """Look after the pages from now on; further calls change nothing."""
        statm = Path("/proc/self/statm")
        if self._begun or not statm.exists():
            return
        self._begun = True
        at_first = _file_pages(statm)

        def look() -> None:
            pause = Event()
            while not pause.wait(_LOOKED_EVERY):
                if (_file_pages(statm) - at_first) * mmap.PAGESIZE > _RESIDENT:
                    forget()

        Thread(target=look, name="pages of arrays in files", daemon=True).start()


def _file_pages(statm: Path) -> int:
    """Return how many pages of files this process holds in memory."""
    return int(statm.read_text().split()[2])


_arena, _keeper = _Arena(), _Keeper()


def empty(shape: tuple[int, ...], dtype: Any = np.float64) -> np.ndarray:
    """Return an array of zeros in a file that vanishes with the arrays in it.

    Raises:
        DataError: where the disk is full.
    """
    kind = np.dtype(dtype)
    file, start = _arena.place(max(math.prod(shape) * kind.itemsize, 1))
    return np.ndarray(shape, kind, buffer=file, offset=start)


def on_disk(values: np.ndarray) -> np.ndarray:
    """Return a copy of an array in a file; the array itself where it lies in one."""
    if lies_on_disk(values):
        return values
    out = empty(values.shape, values.dtype)
    out[...] = values
    return out


def lies_on_disk(values: np.ndarray) -> bool:
    """Return whether an array is a view of a file, one of these or another."""
    return _file_of(values) is not None


def _file_of(values: np.ndarray) -> mmap.mmap | None:
    owner: Any = values
    while isinstance(owner, np.ndarray):
        owner = owner.base
    return owner if isinstance(owner, mmap.mmap) else None


def rows(count: int, *shape: int, dtype: torch.dtype | None = None) -> Tensor:
    """Return a tensor [count, *shape] to be filled: in memory, or in a file where it is large."""
    # what reads logs imports no torch
    import torch

    dtype = torch.float64 if dtype is None else dtype
    if count <= LARGE:
        return torch.zeros(count, *shape, dtype=dtype)
    kind = torch.zeros(0, dtype=dtype).numpy().dtype
    return torch.from_numpy(empty((count, *shape), kind))


def row_pieces(count: int) -> Iterator[slice]:
    """Yield the rows of data: all at once, or in pieces where there are many."""
    step = PIECE if count > LARGE else max(count, 1)
    for start in range(0, count, step):
        yield slice(start, min(start + step, count))


class OneByOne(list[Item]):
    """A list of items with arrays in files: on the way through, each item's pages are given back.

    A loop that only looks at a few samples of each log reaches the pages of all logs sooner than
    anyone else could notice.
    """

    def __iter__(self) -> Iterator[Item]:
        """Yield the items; before each further one, no pages of arrays are held."""
        for item in super().__iter__():
            yield item
            forget()


def taken(values: Tensor, keep: Tensor) -> Tensor:
    """Return the rows of `values` [N, ...] where `keep` [N] is True; many of them in a file."""
    out = rows(int(keep.sum()), *values.shape[1:], dtype=values.dtype)
    begin = 0
    for part in row_pieces(len(values)):
        some = values[part][keep[part]]
        out[begin : begin + len(some)] = some
        begin += len(some)
    return out


def forget() -> None:
    """Give back the memory of all arrays in files; they are read again when they are next used."""
    with _lock:
        files = list(_files)
    for file in files:
        file.madvise(mmap.MADV_DONTNEED)


def forget_pages(values: np.ndarray) -> None:
    """Give back the memory of one array that lies in a file; others stay as they are.

    So does a file of another's that may be written to: its changes might live in memory alone.
    """
    file = _file_of(values)
    if file is not None and (file in _files or not values.flags.writeable):
        file.madvise(mmap.MADV_DONTNEED)

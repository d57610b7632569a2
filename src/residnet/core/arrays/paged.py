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

MAX_SAMPLES_IN_MEMORY = 200_000
"""Samples of all logs together from which further ones are kept on disk."""
CHUNK_ROWS = 50_000
"""Rows that are worked on at a time."""
_FILE_BYTES = 1 << 28
"""Bytes of a file that many arrays share: each file holds a descriptor open."""
_ALIGNMENT_BYTES = 64
"""Arrays begin at multiples of so many bytes, a cache line, as torch's own do."""

_MAX_RESIDENT_BYTES = 1 << 28
"""Bytes of pages of files beyond which those of arrays are given back."""
_CHECK_INTERVAL = 0.02
"""Seconds; pages that the system still has come back at gigabytes a second."""

_mapped_files: weakref.WeakSet[mmap.mmap] = weakref.WeakSet()
_lock = Lock()


class _FileArena:
    """The file that arrays are being put into."""

    def __init__(self) -> None:
        self.file: mmap.mmap | None = None
        self.end_offset = 0

    def allocate(self, n_bytes: int) -> tuple[mmap.mmap, int]:
        """Return a file with room for so many bytes, and where they go."""
        if self.file is None or self.end_offset + n_bytes > len(self.file):
            with tempfile.TemporaryFile(prefix="residnet-") as file:
                try:
                    file.truncate(max(n_bytes, _FILE_BYTES))
                    self.file = mmap.mmap(file.fileno(), 0)
                except OSError as error:
                    raise DataError(
                        f"{tempfile.gettempdir()}: no room for the samples of large logs"
                        f" ({error.strerror}); set TMPDIR to a larger disk"
                    ) from error
            with _lock:
                _mapped_files.add(self.file)
            _page_releaser.start()
            self.end_offset = 0
        offset = self.end_offset
        self.end_offset += math.ceil(n_bytes / _ALIGNMENT_BYTES) * _ALIGNMENT_BYTES
        return self.file, offset


class _PageReleaser:
    """Gives back pages while others work with the arrays, who need not know where these lie.

    The system drops them only where another process lacks memory, and until then they count as
    this one's. Where there is no /proc/self/statm they stay.
    """

    def __init__(self) -> None:
        self._is_started = False

    def start(self) -> None:
        """Look after the pages from now on; further calls change nothing."""
        statm = Path("/proc/self/statm")
        if self._is_started or not statm.exists():
            return
        self._is_started = True
        initial_pages = _count_file_pages(statm)

        def release_when_large() -> None:
            stop_event = Event()
            while not stop_event.wait(_CHECK_INTERVAL):
                if (_count_file_pages(statm) - initial_pages) * mmap.PAGESIZE > _MAX_RESIDENT_BYTES:
                    release_pages()

        Thread(target=release_when_large, name="pages of arrays in files", daemon=True).start()


def _count_file_pages(statm: Path) -> int:
    """Return how many pages of files this process holds in memory."""
    return int(statm.read_text().split()[2])


_arena, _page_releaser = _FileArena(), _PageReleaser()


def allocate_on_disk(shape: tuple[int, ...], dtype: Any = np.float64) -> np.ndarray:
    """Return an array of zeros in a file that vanishes with the arrays in it.

    Raises:
        DataError: where the disk is full.
    """
    numpy_dtype = np.dtype(dtype)
    file, offset = _arena.allocate(max(math.prod(shape) * numpy_dtype.itemsize, 1))
    return np.ndarray(shape, numpy_dtype, buffer=file, offset=offset)


def copy_to_disk(values: np.ndarray) -> np.ndarray:
    """Return a copy of an array in a file; the array itself where it lies in one."""
    if is_memory_mapped(values):
        return values
    array_on_disk = allocate_on_disk(values.shape, values.dtype)
    array_on_disk[...] = values
    return array_on_disk


def is_memory_mapped(values: np.ndarray) -> bool:
    """Return whether an array is a view of a file, one of these or another."""
    return _find_mapped_file(values) is not None


def _find_mapped_file(values: np.ndarray) -> mmap.mmap | None:
    owner: Any = values
    while isinstance(owner, np.ndarray):
        owner = owner.base
    return owner if isinstance(owner, mmap.mmap) else None


def allocate_rows(n_rows: int, *shape: int, dtype: torch.dtype | None = None) -> Tensor:
    """Return a tensor [count, *shape] to be filled: in memory, or in a file where it is large."""
    # what reads logs imports no torch
    import torch

    dtype = torch.float64 if dtype is None else dtype
    if n_rows <= MAX_SAMPLES_IN_MEMORY:
        return torch.zeros(n_rows, *shape, dtype=dtype)
    numpy_dtype = torch.zeros(0, dtype=dtype).numpy().dtype
    return torch.from_numpy(allocate_on_disk((n_rows, *shape), numpy_dtype))


def iterate_row_chunks(n_rows: int) -> Iterator[slice]:
    """Yield the rows of data: all at once, or in pieces where there are many."""
    chunk_rows = CHUNK_ROWS if n_rows > MAX_SAMPLES_IN_MEMORY else max(n_rows, 1)
    for start in range(0, n_rows, chunk_rows):
        yield slice(start, min(start + chunk_rows, n_rows))


class PageReleasingList(list[Item]):
    """A list of items with arrays in files: on the way through, each item's pages are given back.

    A loop that only looks at a few samples of each log reaches the pages of all logs sooner than
    anyone else could notice.
    """

    def __iter__(self) -> Iterator[Item]:
        """Yield the items; before each further one, no pages of arrays are held."""
        for item in super().__iter__():
            yield item
            release_pages()


def take_rows(values: Tensor, mask: Tensor) -> Tensor:
    """Return the rows of `values` [N, ...] where `mask` [N] is True; many of them in a file."""
    selected = allocate_rows(int(mask.sum()), *values.shape[1:], dtype=values.dtype)
    first_row = 0
    for chunk in iterate_row_chunks(len(values)):
        selected_chunk = values[chunk][mask[chunk]]
        selected[first_row : first_row + len(selected_chunk)] = selected_chunk
        first_row += len(selected_chunk)
    return selected


def release_pages() -> None:
    """Give back the memory of all arrays in files; they are read again when they are next used."""
    with _lock:
        files = list(_mapped_files)
    for file in files:
        file.madvise(mmap.MADV_DONTNEED)


def release_pages_of(values: np.ndarray) -> None:
    """Give back the memory of one array that lies in a file; others stay as they are.

    So does a file of another's that may be written to: its changes might live in memory alone.
    """
    file = _find_mapped_file(values)
    if file is not None and (file in _mapped_files or not values.flags.writeable):
        file.madvise(mmap.MADV_DONTNEED)

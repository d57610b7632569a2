"""Memory-mapped arrays for large data sets, whose pages can be released from memory."""

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
"""Total number of samples of all logs beyond which arrays are memory-mapped."""
CHUNK_ROWS = 50_000
"""Rows that are processed at a time."""
_FILE_BYTES = 1 << 28
"""Size of a file in bytes; many arrays share it to save file descriptors."""
_ALIGNMENT_BYTES = 64
"""Alignment of arrays in bytes: a cache line, as in PyTorch."""

_MAX_RESIDENT_BYTES = 1 << 28
"""Resident bytes of file pages above which the pages of arrays are released."""
_CHECK_INTERVAL = 0.02
"""Interval of the check in s; reading files from the cache adds gigabytes of pages per second."""

_mapped_files: weakref.WeakSet[mmap.mmap] = weakref.WeakSet()
_lock = Lock()


class _FileArena:
    """Allocator of arrays in a temporary memory-mapped file."""

    def __init__(self) -> None:
        self.file: mmap.mmap | None = None
        self.end_offset = 0

    def allocate(self, n_bytes: int) -> tuple[mmap.mmap, int]:
        """Return a mapped file with free space for `n_bytes`, and the offset of that space."""
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
    """Background thread that releases the pages of mapped arrays when there are too many.

    The system drops such pages only under memory pressure, and counts them as memory of this
    process until then. Without /proc/self/statm (not on Linux) no pages are released.
    """

    def __init__(self) -> None:
        self._is_started = False

    def start(self) -> None:
        """Start the thread; further calls have no effect."""
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
    """Return the number of resident file pages of this process."""
    return int(statm.read_text().split()[2])


_arena = _FileArena()
_page_releaser = _PageReleaser()


def allocate_on_disk(shape: tuple[int, ...], dtype: Any = np.float64) -> np.ndarray:
    """Return an array of zeros in a temporary file, which is deleted with its last array.

    Raises:
        DataError: if the disk is full.
    """
    numpy_dtype = np.dtype(dtype)
    file, offset = _arena.allocate(max(math.prod(shape) * numpy_dtype.itemsize, 1))
    return np.ndarray(shape, numpy_dtype, buffer=file, offset=offset)


def copy_to_disk(values: np.ndarray) -> np.ndarray:
    """Return a memory-mapped copy of an array; the array itself if it is memory-mapped."""
    if is_memory_mapped(values):
        return values
    array_on_disk = allocate_on_disk(values.shape, values.dtype)
    array_on_disk[...] = values
    return array_on_disk


def is_memory_mapped(values: np.ndarray) -> bool:
    """Return whether an array is a view of a memory-mapped file."""
    return _find_mapped_file(values) is not None


def _find_mapped_file(values: np.ndarray) -> mmap.mmap | None:
    owner: Any = values
    while isinstance(owner, np.ndarray):
        owner = owner.base
    return owner if isinstance(owner, mmap.mmap) else None


def allocate_rows(n_rows: int, *shape: int, dtype: torch.dtype | None = None) -> Tensor:
    """Return a tensor of zeros [n_rows, *shape], memory-mapped if it has many rows."""
    # readers of logs must not import PyTorch
    import torch

    dtype = torch.float64 if dtype is None else dtype
    if n_rows <= MAX_SAMPLES_IN_MEMORY:
        return torch.zeros(n_rows, *shape, dtype=dtype)
    numpy_dtype = torch.zeros(0, dtype=dtype).numpy().dtype
    return torch.from_numpy(allocate_on_disk((n_rows, *shape), numpy_dtype))


def iterate_row_chunks(n_rows: int) -> Iterator[slice]:
    """Yield slices that cover `n_rows` rows: one slice, or chunks if there are many."""
    chunk_rows = CHUNK_ROWS if n_rows > MAX_SAMPLES_IN_MEMORY else max(n_rows, 1)
    for start in range(0, n_rows, chunk_rows):
        yield slice(start, min(start + chunk_rows, n_rows))


class PageReleasingList(list[Item]):
    """List of items with mapped arrays that releases pages after each item of an iteration.

    A loop that reads few samples of each log would load pages of all logs faster than the
    background thread checks.
    """

    def __iter__(self) -> Iterator[Item]:
        """Yield the items and release all pages after each."""
        for item in super().__iter__():
            yield item
            release_pages()


def take_rows(values: Tensor, mask: Tensor) -> Tensor:
    """Return the rows of `values` [N, ...] where `mask` [N] is True, mapped if there are many."""
    selected = allocate_rows(int(mask.sum()), *values.shape[1:], dtype=values.dtype)
    first_row = 0
    for chunk in iterate_row_chunks(len(values)):
        selected_chunk = values[chunk][mask[chunk]]
        selected[first_row : first_row + len(selected_chunk)] = selected_chunk
        first_row += len(selected_chunk)
    return selected


def release_pages() -> None:
    """Release the memory of all mapped arrays; they are read again on their next use."""
    with _lock:
        files = list(_mapped_files)
    for file in files:
        file.madvise(mmap.MADV_DONTNEED)


def release_pages_of(values: np.ndarray) -> None:
    """Release the memory of one mapped array; an array in memory is not changed.

    A writable file of another owner is not released, because its changes may exist in memory only.
    """
    file = _find_mapped_file(values)
    if file is not None and (file in _mapped_files or not values.flags.writeable):
        file.madvise(mmap.MADV_DONTNEED)

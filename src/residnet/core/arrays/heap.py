"""How the C library of Linux keeps the memory of tensors that a computation frees."""

from __future__ import annotations

import ctypes
import platform

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
"""Numbers of the settings in malloc.h of the GNU C library."""
_KEPT = 128 << 20
_LARGEST = 64 << 20


def keep_freed_memory() -> None:
    """Let this process keep up to 128 MB of freed memory, so that tensors find it ready again.

    By default the GNU C library gives the memory of tensors back when they are freed, and each new
    one has to be filled with zeros page by page: a third of the time of training an LSTM of 100
    units. Larger arrays than 64 MB are given back as before. Other C libraries are left alone.
    """
    if platform.libc_ver()[0] != "glibc":
        return
    library = ctypes.CDLL(None)
    library.mallopt(_MMAP_THRESHOLD, _LARGEST)
    library.mallopt(_TRIM_THRESHOLD, _KEPT)

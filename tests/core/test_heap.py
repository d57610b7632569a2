"""Freed memory stays with the process, so that large arrays do not fault its pages in again."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

_FAULTS = """
import resource, sys
from residnet.core.processes import retain_freed_memory
if sys.argv[1] == "keep":
    retain_freed_memory()
def fill():
    number = 48 << 20
    b"1" * number
fill()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(4):
    fill()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only the GNU C library is set")
def test_retain_freed_memory_reduces_page_faults() -> None:
    kept, usual = (
        int(subprocess.check_output([sys.executable, "-c", _FAULTS, word])) for word in ("keep", "")
    )
    assert kept < usual / 10

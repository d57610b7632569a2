"""C source compiled for this machine and kept, so that the same source is compiled once."""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import subprocess
import tempfile
from pathlib import Path

from residnet.core.errors import ExportError
from residnet.export.c.compiled import compiler

_FLAGS = ("-O2", "-ftree-vectorize", "-ffast-math", "-march=native", "-fPIC", "-shared", "-w")
_KEPT = 64
"""Libraries that are kept, those used last."""


def compiled_library(source: str) -> ctypes.CDLL:
    """Return a C source as a library compiled for this machine, from the cache where it is there.

    The cache is `residnet/compiled` in `XDG_CACHE_HOME`, or in `~/.cache`; `RESIDNET_CACHE` names
    another folder. Without a folder to write to the library is compiled every time.

    Raises:
        ExportError: where there is no compiler, or it fails.
    """
    tool = compiler()
    key = hashlib.sha256("\n".join((source, *_FLAGS, *_machine(tool))).encode()).hexdigest()
    file = _folder() / f"{key[:32]}.so"
    try:
        if not file.is_file():
            file.parent.mkdir(parents=True, exist_ok=True)
            # two processes that compile the same source do not write to one file
            partial = file.with_name(f"{file.stem}.{os.getpid()}")
            _compile(tool, source, partial)
            partial.replace(file)
            _forget(file.parent)
        file.touch()
        return ctypes.CDLL(str(file))
    except OSError:
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "closed_loop.so"
            _compile(tool, source, out)
            return ctypes.CDLL(str(out))


def _folder() -> Path:
    """Return the folder of the cache."""
    if named := os.environ.get("RESIDNET_CACHE"):
        return Path(named)
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "residnet" / "compiled"


def _machine(tool: str) -> tuple[str, ...]:
    """Return what a compiled library depends on beside its source: compiler and processor."""
    said = subprocess.run([tool, "--version"], capture_output=True, text=True).stdout
    return tool, said, platform.node(), platform.machine(), platform.processor()


def _compile(tool: str, source: str, out: Path) -> None:
    """Compile a C source to a library.

    Raises:
        ExportError: with the compiler's first complaint.
    """
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "closed_loop.c"
        file.write_text(source)
        call = [tool, "-std=gnu99", *_FLAGS, str(file), "-o", str(out), "-lm"]
        done = subprocess.run(call, capture_output=True, text=True)
    if done.returncode:
        said = done.stderr.strip().splitlines() or ["no message"]
        raise ExportError(f"the closed loop does not compile ({said[0]})")


def _forget(folder: Path) -> None:
    """Delete all but the libraries that were used last."""
    files = sorted(folder.iterdir(), key=lambda file: file.stat().st_mtime, reverse=True)
    for file in files[_KEPT:]:
        file.unlink(missing_ok=True)

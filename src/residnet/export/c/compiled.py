"""Exported C files, compiled and loaded back into Python to be checked."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from residnet.core.errors import ExportError
from residnet.export.contract import Numbers

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
"""Flags under which every exported file compiles without a warning."""


def compiler() -> str:
    """Return the C compiler: what CC names, or cc, gcc or clang.

    Raises:
        ExportError: where there is none.
    """
    for name in (os.environ.get("CC", ""), "cc", "gcc", "clang"):
        if name and (found := shutil.which(name)):
            return found
    raise ExportError(
        "no C compiler was found to check the exported file with; install gcc or clang, or name"
        " one in the environment variable CC"
    )


def compile_shared(sources: Sequence[Path], out: Path, flags: Sequence[str] = ()) -> Path:
    """Compile C files to a shared library, without a single warning.

    Raises:
        ExportError: with the compiler's first complaint.
    """
    call = [compiler(), "-O2", *STRICT, "-shared", "-fPIC", *flags, *map(str, sources)]
    done = subprocess.run([*call, "-o", str(out), "-lm"], capture_output=True, text=True)
    if done.returncode:
        lines = done.stderr.strip().splitlines()
        said = next((line for line in lines if "error" in line), "no message")
        raise ExportError(f"{sources[0].name}: does not compile ({said})")
    return out


class CompiledModel:
    """An exported model's C file as a library.

    Args:
        library: compiled.
        prefix: of its names.
        memory: number of entries of the memory.
        precision: that it was compiled for.
    """

    def __init__(
        self, library: Path, prefix: str, memory: int, precision: Literal["single", "double"]
    ) -> None:
        self.dtype: Any = np.float32 if precision == "single" else np.float64
        self.memory = memory
        loaded = ctypes.CDLL(str(library))
        self._step, self._warmup = (
            getattr(loaded, f"{prefix}_{name}") for name in ("step", "warmup")
        )
        self._step.argtypes = [ctypes.c_void_p] * 5
        self._step.restype = ctypes.c_int
        self._warmup.argtypes = [
            ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p,
        ]  # fmt: skip
        self._warmup.restype = None

    def step(self, x: Numbers, w: Numbers, s: Numbers) -> tuple[Numbers, Numbers, bool]:
        """Return state, memory and flag one step later."""
        given = [np.ascontiguousarray(part, dtype=self.dtype) for part in (x, w, s)]
        after, memory = np.zeros(len(x), self.dtype), np.zeros(self.memory, self.dtype)
        flag = self._step(*(part.ctypes.data for part in (*given, after, memory)))
        return after, memory, bool(flag)

    def warmup(self, y: Numbers, w: Numbers) -> Numbers:
        """Return the memory that a measured past leaves."""
        y, w = (np.ascontiguousarray(part, dtype=self.dtype) for part in (y, w))
        memory = np.zeros(self.memory, self.dtype)
        self._warmup(y.ctypes.data, w.ctypes.data, len(y), memory.ctypes.data)
        return memory

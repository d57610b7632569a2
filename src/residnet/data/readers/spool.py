"""Columns that grow piece by piece: in memory, or on disk where a file is large."""

from __future__ import annotations

import tempfile
from typing import IO, final

import numpy as np

from residnet.core.errors import DataError

# files below this size are kept in memory, bytes
LARGE = 300_000_000


@final
class Spool:
    """Float64 columns side by side.

    Args:
        columns: how many.
        on_disk: collects them in temporary files, whose pages the system may drop; they vanish with
            the arrays that `finish` gives.
    """

    def __init__(self, columns: int, *, on_disk: bool) -> None:
        self._parts: list[list[np.ndarray]] = [[] for _ in range(columns)]
        # they outlive this call, and vanish when the last array over them does
        self._files: list[IO[bytes]] = [
            tempfile.TemporaryFile(prefix="residnet-")  # noqa: SIM115
            for _ in range(columns if on_disk else 0)
        ]

    def add(self, columns: list[np.ndarray]) -> None:
        """Return one more piece of each column.

        Raises:
            DataError: where the disk is full.
        """
        if not self._files:
            for parts, values in zip(self._parts, columns, strict=True):
                parts.append(values)
            return
        try:
            for file, values in zip(self._files, columns, strict=True):
                file.write(np.ascontiguousarray(values, dtype=np.float64).data)
        except OSError as error:
            raise DataError(
                f"{tempfile.gettempdir()}: no room for the columns of a large log"
                f" ({error.strerror}); set TMPDIR to a larger disk"
            ) from error

    def finish(self) -> list[np.ndarray]:
        """Return the columns [T], read-only where they lie on disk; the spool is empty then."""
        out = []
        for file in self._files:
            file.flush()
            out.append(
                np.asarray(np.memmap(file, dtype=np.float64, mode="r"))
                if file.tell()
                else np.zeros(0)
            )
            file.close()
        for i, parts in enumerate([] if self._files else self._parts):
            out.append(
                parts[0] if len(parts) == 1 else np.concatenate(parts) if parts else np.zeros(0)
            )
            self._parts[i] = []
        return out

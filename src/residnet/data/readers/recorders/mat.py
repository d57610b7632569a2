"""Reader of MATLAB files: v5 to v7 through SciPy, v7.3 (HDF5) through h5py."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, final

import numpy as np
from pydantic import Field

from residnet.core.errors import DataError
from residnet.data.readers.base import require_file
from residnet.data.readers.composing.composed import RecordingConfig
from residnet.data.readers.composing.wanted import EVERYTHING, Wanted
from residnet.data.readers.recorders.hdf5 import is_hdf5, load_hdf5
from residnet.data.readers.recorders.tree import TreeTime, tree_recording
from residnet.data.readers.recording import Recording


@final
class MatConfig(RecordingConfig):
    """A MATLAB file, v5 or v7.3: vectors, matrices, structs, Simulink's structures with time.

    Matrices have one row per sample.

    Attributes:
        time: which variable of a struct (or of the workspace) holds time.
        table: the only struct that is read, where a file holds several experiments; null reads all.
    """

    kind: Literal["mat"] = "mat"
    time: TreeTime = Field(default_factory=TreeTime)
    table: str | None = Field(default=None, min_length=1)

    def load(self, path: Path, wanted: Wanted) -> Recording:
        """Read the wanted variables of a MATLAB file."""
        return load_mat(
            path, wanted if self.table is None else Wanted([(self.table, "")]), self.time
        )


def load_mat(path: Path, wanted: Wanted = EVERYTHING, time: TreeTime | None = None) -> Recording:
    """Return the recording in a MATLAB file.

    Raises:
        UsageError: where the file is missing, has no time, or is v7.3 and h5py is not installed.
        DataError: where it cannot be read.
    """
    require_file(path)
    if is_hdf5(path):
        return load_hdf5(path, wanted, time, what="a MATLAB 7.3 file")
    from scipy.io import loadmat

    try:
        content = loadmat(path, simplify_cells=True)
    # SciPy's parser fails in its own ways on damaged bytes
    except Exception as error:
        raise DataError(
            f"{path}: damaged or not a MATLAB file ({type(error).__name__}:"
            f" {' '.join(str(error).split())[:200]})"
        ) from error
    leaves = dict(_leaves(content, ""))
    return tree_recording(path, leaves, time or TreeTime(), wanted)


def _leaves(node: Any, prefix: str) -> Iterator[tuple[str, np.ndarray]]:
    """Return the paths and arrays below a struct."""
    if isinstance(node, dict):
        for name, value in node.items():
            if not name.startswith("__"):
                yield from _leaves(value, f"{prefix}/{name}" if prefix else name)
    elif (isinstance(node, np.ndarray) and node.dtype == object) or isinstance(node, list):
        parts = list(node)
        if parts and all(isinstance(part, str) for part in parts):
            yield prefix, np.array(parts, dtype=object)
            return
        for i, part in enumerate(parts):
            yield from _leaves(part, f"{prefix}/{i}")
    elif isinstance(node, np.ndarray) and node.ndim:
        yield prefix, node

"""Reader of HDF5 files, through h5py; MATLAB 7.3 files are HDF5 too."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, final

import numpy as np
from pydantic import Field

from residnet.core.errors import DataError
from residnet.data.readers.base import require_file
from residnet.data.readers.composing.composed import RecordingConfig
from residnet.data.readers.composing.wanted import EVERYTHING, Wanted
from residnet.data.readers.files import missing_package
from residnet.data.readers.recorders.tree import TreeTime, Vector, tree_recording
from residnet.data.readers.recording import Recording

if TYPE_CHECKING:
    import h5py

_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_ALWAYS_HELD = 200_000_000
_MOST_COMPRESSED = 1000
"""Bytes of a dataset for each byte of its file at most; a constant channel has some 900."""


@final
class Hdf5Config(RecordingConfig):
    """HDF5 file: datasets in groups, or tables of named columns.

    Attributes:
        time: which dataset of a group (or column of a table) holds time.
        table: the only group or table that is read, where a file holds several experiments; null
            reads all.
    """

    kind: Literal["hdf5"] = "hdf5"
    time: TreeTime = Field(default_factory=TreeTime)
    table: str | None = Field(default=None, min_length=1)

    def load(self, path: Path, wanted: Wanted) -> Recording:
        """Read the wanted groups of an HDF5 file."""
        return load_hdf5(
            path, wanted if self.table is None else Wanted([(self.table, "")]), self.time
        )


def is_hdf5(path: Path) -> bool:
    """Return whether a file starts as HDF5 does, at once or behind MATLAB's header of 512 bytes."""
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        head = stream.read(520)
    return head.startswith(_SIGNATURE) or head[512:520] == _SIGNATURE


def load_hdf5(
    path: Path,
    wanted: Wanted = EVERYTHING,
    time: TreeTime | None = None,
    what: str = "an HDF5 file",
) -> Recording:
    """Return the recording in an HDF5 file.

    Raises:
        UsageError: where the file is missing, has no time, or h5py is not installed.
        DataError: where it cannot be read.
    """
    require_file(path)
    try:
        import h5py
    except ImportError as error:
        raise missing_package("hdf5", "h5py", what) from error
    leaves: dict[str, Vector] = {}
    try:
        with h5py.File(path, "r") as file:
            found: list[h5py.Dataset] = []
            file.visititems(
                lambda name, node: (
                    found.append(node)
                    if isinstance(node, h5py.Dataset) and not name.startswith("#")
                    else None
                )
            )
            for dataset in found:
                _require_held(path, dataset)
                leaves.update(_vectors(dataset))
            return tree_recording(path, leaves, time or TreeTime(), wanted)
    except (OSError, RuntimeError, KeyError, ValueError) as error:
        raise DataError(
            f"{path}: damaged or not an HDF5 file ({' '.join(str(error).split())[:200]})"
        ) from error


def _require_held(path: Path, dataset: h5py.Dataset) -> None:
    """Check that a dataset is not larger than its file can hold; a size is only a number in it.

    Raises:
        DataError: where it claims far more than the file has, even compressed.
    """
    claimed, held = dataset.size * dataset.dtype.itemsize, path.stat().st_size
    if claimed > max(_ALWAYS_HELD, _MOST_COMPRESSED * held):
        raise DataError(
            f"{path}: {dataset.name} claims {claimed / 1e9:.3g} GB in a file of {held / 1e6:.3g}"
            " MB; the file is damaged, or was made and never filled"
        )


def _vectors(dataset: h5py.Dataset) -> dict[str, Vector]:
    """Return the arrays of one dataset by path, not yet read; a table gives one for each column."""
    name = dataset.name.strip("/")
    if dataset.dtype.names:
        plain = [
            column
            for column in dataset.dtype.names
            if dataset.ndim == 1 and not dataset.dtype[column].shape
        ]
        return {f"{name}/{column}": _Column(dataset, column) for column in plain}
    if (
        dataset.ndim == 0
        or dataset.size == 0
        or dataset.attrs.get("MATLAB_class") in (b"char", b"cell")
    ):
        return {}
    return {
        name: _plain(dataset[()]) if dataset.dtype.kind in "SO" and dataset.ndim == 1 else dataset
    }


@final
class _Column:
    """One column of a table, read when it is used."""

    def __init__(self, dataset: h5py.Dataset, name: str) -> None:
        self._dataset, self._name = dataset, name
        self.shape, self.size, self.dtype = dataset.shape, dataset.size, dataset.dtype[name]

    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        values = _plain(self._dataset.fields(self._name)[()])
        return values if dtype is None else values.astype(dtype)


def _plain(values: np.ndarray) -> np.ndarray:
    """Return the bytes as text, everything else as it is."""
    if values.dtype.kind in "SO" and values.ndim == 1:
        return np.array(
            [v.decode(errors="replace") if isinstance(v, bytes) else str(v) for v in values],
            dtype=object,
        )
    return values

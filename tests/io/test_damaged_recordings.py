"""Damaged recordings of every format end in a log whose clock runs forward, or in one line; nothing
else gets out.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import written_logs
import written_recorders

from residnet.core.config import validate_config
from residnet.core.errors import DataError, UsageError
from residnet.core.log import Log
from residnet.io.readers import ReaderConfig

CASES: list[tuple[str, Callable[[Log, Path], Path]]] = [
    *(("mat", written_logs.mat5), ("mat", written_logs.mat73)),
    *(("hdf5", written_logs.hdf5), ("hdf5", written_logs.hdf5_table)),
    *(("rosbag", written_logs.bag1), ("rosbag", written_logs.bag2)),
    *(("rosbag", written_logs.bag2_mcap), ("rosbag", written_logs.mcap)),
    *(("csv_topics", written_logs.topics), ("nmea", written_recorders.nmea)),
    *(("ulog", written_recorders.ulog), ("ardupilot", written_recorders.ardupilot)),
]


def damaged(whole: bytes, rng: np.random.Generator) -> bytes:
    """Bits flipped, a stretch zeroed, cut, repeated, noise put in, or lines shuffled."""
    at = int(rng.integers(len(whole)))
    size = int(rng.integers(1, 400))
    flipped = bytearray(whole)
    for i in rng.integers(len(whole), size=int(rng.choice([1, 5, 50]))):
        flipped[i] ^= 1 << int(rng.integers(8))
    lines = whole.split(b"\n")
    ways = (
        bytes(flipped),
        whole[:at] + bytes(size) + whole[at + size :],
        whole[:at],
        whole[: at + size] + whole[at:],
        whole[:at] + rng.bytes(size % 40) + whole[at:],
        b"\n".join(lines[i] for i in rng.permutation(len(lines))),
    )
    return ways[int(rng.integers(len(ways)))]


@pytest.mark.parametrize(("kind", "write"), CASES)
def test_damage(
    kind: str,
    write: Callable[[Log, Path], Path],
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    reader = validate_config({"kind": kind}, ReaderConfig, "test").build()
    path = write(written_logs.trial(3.0), tmp_path)
    files = [file for file in path.rglob("*") if file.is_file()] if path.is_dir() else [path]
    whole = {file: file.read_bytes() for file in files}
    rng = np.random.default_rng(5)
    for number in range(22):
        for file, content in whole.items():
            file.write_bytes(content)
        file = files[int(rng.integers(len(files)))]
        # cut to little or to nothing, and then by chance
        few = whole[file][: number * len(whole[file]) // 50]
        file.write_bytes(few if number < 2 else damaged(whole[file], rng))
        said = ""
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                assert (np.diff(reader.read(path).t) > 0.0).all()
        except (UsageError, DataError) as error:
            said = str(error)
        assert "\n" not in said
        assert len(said) < 600
        assert not said or path.name in said
    assert capfd.readouterr() == ("", "")


def test_a_dataset_that_claims_more_than_its_file_holds_is_one_line(tmp_path: Path) -> None:
    """Its size is a number in the file; reading it would take the machine's memory."""
    path = tmp_path / "huge.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("t", shape=(10**13,), dtype="f8", chunks=(10**6,))
        file.create_dataset("u", data=np.zeros(100))
    reader = validate_config({"kind": "hdf5"}, ReaderConfig, "test").build()
    with pytest.raises(DataError, match=r"huge.h5: /t claims 8e\+04 GB in a file of") as caught:
        reader.read(path)
    assert "\n" not in str(caught.value)

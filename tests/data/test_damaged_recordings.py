"""Damaged recordings of every format end in a log whose clock runs forward, or in one line; nothing
else gets out.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import written_logs
import written_recorders

from residnet.core.errors import DataError, UsageError
from residnet.core.log import Log
from residnet.data.readers.compose import RecordingConfig
from residnet.data.readers.formats.ardupilot import ArduPilotConfig
from residnet.data.readers.formats.nmea import NmeaConfig
from residnet.data.readers.formats.rosbag import RosbagConfig
from residnet.data.readers.formats.topic_folder import TopicFolderConfig
from residnet.data.readers.formats.trees import Hdf5Config, MatConfig
from residnet.data.readers.formats.ulog import UlogConfig

CASES: list[tuple[Callable[[Log, Path], Path], RecordingConfig]] = [
    (written_logs.mat5, MatConfig()),
    (written_logs.mat73, MatConfig()),
    (written_logs.hdf5, Hdf5Config()),
    (written_logs.hdf5_table, Hdf5Config()),
    (written_logs.bag1, RosbagConfig()),
    (written_logs.bag2, RosbagConfig()),
    (written_logs.bag2_mcap, RosbagConfig()),
    (written_logs.mcap, RosbagConfig()),
    (written_logs.topics, TopicFolderConfig()),
    (written_recorders.nmea, NmeaConfig()),
    (written_recorders.ulog, UlogConfig()),
    (written_recorders.ardupilot, ArduPilotConfig()),
]


def damaged(whole: bytes, rng: np.random.Generator) -> bytes:
    """Bits flipped, a stretch zeroed, cut, repeated, noise put in, or lines shuffled."""
    at, size = int(rng.integers(len(whole))), int(rng.integers(1, 400))
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


def outcome(path: Path, config: RecordingConfig) -> Log | str:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return config.build().read(path)
        except (UsageError, DataError) as error:
            return str(error)


@pytest.mark.parametrize(("write", "config"), CASES)
def test_damage(
    write: Callable[[Log, Path], Path],
    config: RecordingConfig,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    path = write(written_logs.trial(3.0), tmp_path)
    files = [file for file in path.rglob("*") if file.is_file()] if path.is_dir() else [path]
    whole = {file: file.read_bytes() for file in files}
    rng = np.random.default_rng(5)
    for _ in range(20):
        for file, content in whole.items():
            file.write_bytes(content)
        file = files[int(rng.integers(len(files)))]
        file.write_bytes(damaged(whole[file], rng))
        result = outcome(path, config)
        if isinstance(result, Log):
            assert (np.diff(result.t) > 0.0).all()
        else:
            assert "\n" not in result
            assert len(result) < 600
            assert path.name in result
    assert capfd.readouterr() == ("", "")


def test_a_dataset_that_claims_more_than_its_file_holds_is_one_line(tmp_path: Path) -> None:
    """Its size is a number in the file; reading it would take the machine's memory."""
    import h5py

    path = tmp_path / "huge.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("t", shape=(10**13,), dtype="f8", chunks=(10**6,))
        file.create_dataset("u", data=np.zeros(100))
    with pytest.raises(DataError, match=r"huge.h5: /t claims 8e\+04 GB in a file of") as caught:
        Hdf5Config().build().read(path)
    assert "\n" not in str(caught.value)

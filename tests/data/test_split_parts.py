"""Splits by folder, stretch of time and manoeuvre, and the division where nobody says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from known_logs import wavy

from residnet.core.config import validate
from residnet.core.errors import ConfigError, DataError
from residnet.core.log import Log
from residnet.data.sources import MeasuredLogs, read_logs
from residnet.data.split import divided


def saved(folder: Path, *names: str, seconds: float = 60.0) -> list[Log]:
    """Canonical logs that share no row; the first word of a name is the manoeuvre."""
    logs = []
    for number, name in enumerate(names):
        log = wavy(seconds=seconds, name=Path(name).name)
        x = log["x"] + 1000.0 * (number + 1)
        log = log.replace(channels={**log.channels, "x": x}, manoeuvre=log.name.split("_")[0])
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        log.save(folder / f"{name}.parquet")
        logs.append(log)
    return logs


def splits(root: Path, **split: Any) -> dict[str, list[tuple[str, float, float]]]:
    """Name, first and last time of every log by split."""
    settings = {"reader": {"kind": "canonical"}, "split": {"root": str(root), **split}}
    read = read_logs(validate(settings, MeasuredLogs, "here"))
    return {
        name: [(log.name, float(log.t[0]), float(log.t[-1])) for log in logs]
        for name, logs in read.items()
    }


def test_stretches_of_one_log(tmp_path: Path) -> None:
    saved(tmp_path, "trip")
    found = splits(
        tmp_path,
        train=[{"log": "trip.parquet", "to": "30 s"}],
        validation=[{"log": "trip.parquet", "from": "30 s", "to": "0.75 min"}],
        test=[{"log": "trip.parquet", "from": 45}],
    )
    assert found == {
        "train": [("trip_0s_30s", 0.0, pytest.approx(29.9))],
        "validation": [("trip_30s_45s", 30.0, pytest.approx(44.9))],
        "test": [("trip_45s_59p9s", 45.0, pytest.approx(59.9))],
    }


def test_folders_and_manoeuvres(tmp_path: Path) -> None:
    saved(tmp_path, "a/zigzag_1", "a/turn_1", "b/zigzag_2", "b/turn_2", "c/deep/zigzag_3")
    found = splits(
        tmp_path,
        train=["a", {"log": "b", "manoeuvre": "turn"}],
        validation=[{"log": "b", "manoeuvre": "zigzag"}],
        test=["c"],
    )
    assert {split: [name for name, _, _ in logs] for split, logs in found.items()} == {
        "train": ["turn_1", "zigzag_1", "turn_2"],
        "validation": ["zigzag_2"],
        "test": ["zigzag_3"],
    }


def test_residnet_divides(tmp_path: Path) -> None:
    saved(tmp_path, *(f"{kind}_{i}" for kind in ("zigzag", "turn") for i in range(5)))
    found = splits(tmp_path, auto=["."])
    assert {split: [name for name, _, _ in logs] for split, logs in found.items()} == {
        "train": ["turn_0", "turn_1", "turn_3", "zigzag_0", "zigzag_1", "zigzag_3"],
        "validation": ["turn_2", "zigzag_2"],
        "test": ["turn_4", "zigzag_4"],
    }


def test_few_logs_are_cut_and_copies_left_out() -> None:
    log = wavy(seconds=100.0)
    part = log.replace(
        name="copy", t=log.t[:500], channels={key: v[:500] for key, v in log.channels.items()}
    )
    found = divided([part, log])
    assert {split: [one.name for one in logs] for split, logs in found.items()} == {
        "train": ["wavy_0s_30s", "wavy_50s_79p9s"],
        "validation": ["wavy_30s_50s"],
        "test": ["wavy_79p9s_99p9s"],
    }
    together = np.concatenate([one.t for logs in found.values() for one in logs])
    assert np.array_equal(np.sort(together), log.t)


@pytest.mark.parametrize(
    ("split", "words"),
    [
        (
            {
                "train": [{"log": "a.parquet", "to": "40 s"}],
                "validation": [{"log": "a.parquet", "from": "30 s", "to": "50 s"}],
                "test": [{"log": "a.parquet", "from": "50 s"}],
            },
            "the same stretch of .*a.parquet stands in train and in validation",
        ),
        ({"train": [{"log": "a.parquet", "from": "9 s", "to": "3 s"}]}, "holds nothing"),
        ({"auto": ["."], "train": ["a.parquet"]}, "either `auto`, `file` or patterns"),
        ({"train": ["a.parquet"], "validation": ["b.parquet"]}, "no files for test"),
        ({"auto": ["nowhere"]}, "'nowhere' matches no file"),
    ],
)
def test_splits_that_cannot_be(split: dict[str, Any], words: str, tmp_path: Path) -> None:
    saved(tmp_path, "a", "b")
    with pytest.raises(ConfigError, match=words):
        splits(tmp_path, **split)


def test_a_stretch_outside_the_log_and_a_manoeuvre_that_is_not_there(tmp_path: Path) -> None:
    saved(tmp_path, "zigzag_1", "turn_1", "turn_2")
    whole = {"train": ["zigzag_1.parquet"], "validation": ["turn_1.parquet"]}
    with pytest.raises(DataError, match="0 samples from 200 s"):
        splits(tmp_path, **whole, test=[{"log": "turn_2.parquet", "from": "200 s"}])
    with pytest.raises(DataError, match=r"no log of test is of its manoeuvre \(there are turn"):
        splits(tmp_path, **whole, test=[{"log": "turn_2.parquet", "manoeuvre": "spiral"}])

"""The data layer on measured logs: skipped where RESIDNET_DATA does not name a folder that holds
them.
"""

from __future__ import annotations

import itertools
import os
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from known_logs import frozen_by_loop

from residnet.core.config import validate
from residnet.core.errors import DataError
from residnet.core.log import Log
from residnet.data.align import GridConfig, align
from residnet.data.doctor import inspect
from residnet.data.masks import Frozen
from residnet.data.readers import ReaderConfig
from residnet.data.split import SplitConfig, check_leaks

DATA = Path(os.environ.get("RESIDNET_DATA", ""))
pytestmark = [
    pytest.mark.skipif(
        "RESIDNET_DATA" not in os.environ,
        reason="RESIDNET_DATA is not set: measured logs are absent",
    )
]
needs_kvlcc2 = pytest.mark.skipif(
    not (DATA / "kvlcc2").is_dir(), reason=f"no kvlcc2 in RESIDNET_DATA={DATA}"
)

ESSO = {
    "x": ("x_position_mid [m]", "m"),
    "y": ("y_position_mid [m]", "m"),
    "psi": ("psi_hat [rad]", "rad"),
    "u": ("u_velo [m/s]", "m/s"),
    "v": ("vm_velo [m/s]", "m/s"),
    "r": ("r_angvelo [rad/s]", "rad/s"),
    "n": ("n_prop [rps]", "rps"),
    "delta": ("delta_rudder [rad]", "rad"),
    "wind_speed": ("wind_velo_true [m/s]", "m/s"),
    "wind_dir": ("wind_dir_true [rad]", "rad"),
}
KVLCC2 = {
    name: (name, unit)
    for name, unit in [
        ("x", "m"),
        ("y", "m"),
        ("psi", "rad"),
        ("u", "m/s"),
        ("v", "m/s"),
        ("r", "rad/s"),
    ]
}


def read(path: Path, columns: dict[str, tuple[str, str]], time: str) -> Log:
    channels = {name: {"column": column, "unit": unit} for name, (column, unit) in columns.items()}
    config = {"kind": "csv", "time": {"column": time}, "channels": channels, "manoeuvre": "folder"}
    return validate(config, ReaderConfig, "test").build().read(path)


def esso(path: Path) -> Log:
    return read(path, ESSO, "t [s]")


@pytest.fixture(scope="module")
def logs() -> dict[str, list[Log]]:
    if not (DATA / "esso_osaka").is_dir():
        pytest.skip(f"no esso_osaka in RESIDNET_DATA={DATA}")
    files = validate(
        {"file": str(DATA / "esso_osaka" / "split.yaml")}, SplitConfig, "test"
    ).resolve()
    return {split: [esso(path) for path in paths] for split, paths in files.items()}


def test_frozen_positions_of_every_file_equal_the_published_rule(
    logs: dict[str, list[Log]],
) -> None:
    for log in itertools.chain(*logs.values()):
        np.testing.assert_array_equal(Frozen().apply(log), frozen_by_loop(log["x"], log["y"]))


def test_logs_are_on_the_grid_and_stay_as_published(logs: dict[str, list[Log]]) -> None:
    assert {split: len(members) for split, members in logs.items()} == {
        "train": 21,
        "validation": 5,
        "test": 6,
    }
    for log in logs["test"]:
        table = pd.read_csv(log.meta["source"])
        out = align(log, GridConfig(step=0.1, held=("n", "delta")))
        np.testing.assert_array_equal(out.t, table["t [s]"])
        for name in ("x", "u", "n", "delta"):
            np.testing.assert_array_equal(out[name], table[ESSO[name][0]])
        np.testing.assert_allclose(np.cos(out["psi"]), np.cos(table["psi_hat [rad]"]), atol=1e-12)
        assert np.abs(np.diff(out["psi"])).max() < 0.2
    assert {log.manoeuvre for log in logs["test"]} == {"random", "turning", "zigzag", "berthing"}


def test_the_copied_file_is_caught_and_the_published_split_passes(
    logs: dict[str, list[Log]],
) -> None:
    check_leaks(logs)
    copy = esso(DATA / "esso_osaka" / "turning" / "turn_cut_14-Sep-2020_15_58_08.csv")
    with pytest.raises(DataError, match="share 2869 identical rows"):
        check_leaks({**logs, "test": [*logs["test"], copy]})


@pytest.mark.long
def test_the_doctor_finds_the_known_illnesses(logs: dict[str, list[Log]]) -> None:
    lags, gyro, freezes = [], {}, []
    for log in itertools.chain(*logs.values()):
        report = inspect(log)
        assert not any(finding.level == "fatal" for finding in report.findings), report.lines()
        (frames,) = report.find("frames")
        assert (frames.level, frames.figures["coherence"] > 0.97) == ("note", True)
        trailing = [
            finding
            for name in "uv"
            for finding in report.find(f"follows_{name}")
            if "trails" in finding.text
        ]
        assert trailing or log.manoeuvre == "berthing"
        lags += [
            finding.figures["lag"] for name in "uv" for finding in report.find(f"follows_{name}")
        ]
        gyro[log.name] = np.degrees(report.find("yaw_drift")[0].figures["end"])
        freezes += [
            finding.figures["share"]
            for finding in report.find("frozen")
            if finding.text.startswith("position")
        ]
    assert np.median(lags) == pytest.approx(0.62, abs=0.05)
    assert gyro.pop("random_31-Jul-2020_12_48_39") == pytest.approx(29.3, abs=0.2)
    assert max(abs(drift) for drift in gyro.values()) < 13.0
    assert len(freezes) == 30
    assert max(freezes) < 0.06


@pytest.mark.long
@needs_kvlcc2
def test_tank_data_are_consistent_and_their_mistakes_would_be_seen() -> None:
    columns = {**KVLCC2, "delta": ("delta", "rad"), "n": ("rev", "1/s")}
    for path in sorted((DATA / "kvlcc2").glob("*.csv")):
        raw = read(path, columns, "t")
        loud = {finding.code for finding in inspect(raw).findings if finding.level != "note"}
        # published with the trailing edge to port positive
        assert "rudder_sign" in loud
        log = raw.replace(channels={**raw.channels, "delta": -raw["delta"]})
        report = inspect(log)
        assert "rudder_sign" not in {
            finding.code for finding in report.findings if finding.level != "note"
        }, report.lines()
        assert report.find("frames")[0].figures["coherence"] > 0.9999
        assert abs(report.find("follows_r")[0].figures["lag"]) < 0.1
        exchanged = log.replace(channels={**log.channels, "x": log["y"], "y": log["x"]})
        assert inspect(exchanged).misled

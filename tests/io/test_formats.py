"""Every format gives the same log of the same trial; every reader says what it cannot read."""

from __future__ import annotations

import sys
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import written_logs
import written_recorders
from scipy.io import savemat
from written_logs import COMMANDS, EPOCH, reader_for, recording_for, trial

from residnet.core.config import validate_config
from residnet.core.errors import UsageError
from residnet.core.log import Log
from residnet.core.names import CHANNEL_UNITS
from residnet.io.readers import ReaderConfig
from residnet.io.readers.detect import detect_recording_format

Writer = Callable[[Log, Path], Path]
TREES: list[Writer] = [written_logs.mat5, written_logs.mat73, written_logs.hdf5]
BAGS: list[Writer] = [
    *(written_logs.bag1, written_logs.bag2, written_logs.bag2_mcap, written_logs.mcap),
    written_logs.topics,
]


def read(path: Path, **config: Any) -> Log:
    return validate_config(config, ReaderConfig, "test").build().read(path)


def assert_same(read: Log, expected: Log) -> None:
    assert read.name == "trial"
    np.testing.assert_allclose(read.t, expected.t, rtol=0, atol=1e-9)
    assert set(read.channels) == set(expected.channels)
    assert read.units == {name: CHANNEL_UNITS[name] for name in expected.channels}
    for name, values in expected.channels.items():
        np.testing.assert_allclose(read[name], values, rtol=0, atol=1e-9, err_msg=name)
    assert not read.masks


@pytest.mark.parametrize("write", [written_logs.csv, written_logs.parquet])
def test_read_of_tables_returns_the_trial(write: Writer, tmp_path: Path) -> None:
    log = trial()
    channels = {name: {"column": name, "unit": CHANNEL_UNITS[name]} for name in log.channels}
    path = write(log, tmp_path)
    assert_same(read(path, kind=write.__name__, time={"column": "t"}, channels=channels), log)


@pytest.mark.parametrize("write", [*TREES, written_logs.hdf5_table, *BAGS])
def test_read_of_self_describing_recordings(write: Writer, tmp_path: Path) -> None:
    log = trial()
    got = read(write(log, tmp_path), kind="auto")
    assert_same(got, log)
    assert len(got.meta["sha256"]) == 64
    assert [one for one in got.meta["findings"] if one["level"] != "note"] == []
    if write in BAGS:
        assert got.meta["epoch"] == EPOCH
        assert got.meta["start_utc"] == "2025-04-11T09:15:45.000000000Z"
        assert any("REP-103" in said for said in got.meta["frames"])


@pytest.mark.parametrize(
    ("write", "kind"), [(written_logs.bag2_mcap, "rosbag"), (written_logs.topics, "csv_topics")]
)
def test_read_with_channel_maps_of_topics(write: Writer, kind: str, tmp_path: Path) -> None:
    """The same bag with every part declared, read field by field, and one part of it alone."""
    log = trial()
    path = write(log, tmp_path)
    told: dict[str, Any] = {"kind": kind, "standard_messages": False}
    pose = {"topic": "odometry", "field": "pose.pose.orientation"}
    place = {"north": "pose.pose.position.y", "east": "pose/pose/position/x"}
    channels: dict[str, Any] = {
        name: {"topic": f"/{name}", "field": "data", "unit": "rps", "hold": True}
        for name in COMMANDS
    }
    got = read(path, **told, channels={"cmd_port": channels["cmd_port"]})
    assert list(got.channels) == ["cmd_port"]
    assert {name.strip("/") for name in got.meta["topics_not_used"]} == {"odometry", "cmd_stbd"}
    for name, field, unit in (
        ("u", "linear.x", "m/s"),
        ("v", "linear.y", "m/s"),
        ("r", "angular.z", "rad/s"),
    ):
        turned = {"topic": "/odometry", "unit": unit, "frame": "body_fpu"}
        channels[name] = {**turned, "field": f"twist.twist.{field}"}
    got = read(
        path,
        **told,
        position={"kind": "local", "topic": "/odometry", **place},
        heading={"kind": "quaternion", "frame": "enu", **pose},
        channels=channels,
    )
    assert_same(got, log)


def test_load_of_a_bag_returns_all_series(tmp_path: Path) -> None:
    recording = recording_for(written_logs.bag2(trial(2.0), tmp_path))
    assert sorted(recording.series) == ["/cmd_port", "/cmd_stbd", "/odometry"]
    assert recording["odometry"].message_type == "nav_msgs/msg/Odometry"
    assert recording["odometry"].sender is not None
    assert len(recording["cmd_port"]) == 21


def test_read_of_matlab_datenum_and_nested_struct(tmp_path: Path) -> None:
    values = np.stack((np.arange(50.0), 2 * np.arange(50.0)), axis=1)
    nested = {"time": 739352.25 + np.arange(50) / 86400.0, "signals": {"values": values}}
    savemat(path := tmp_path / "a.mat", {"log": nested})
    channels = {"u": {"field": "signals.values.1", "unit": "kn"}}
    log = read(path, kind="mat", time={"unit": "datenum"}, channels=channels)
    np.testing.assert_allclose(log["u"], 2 * np.arange(50.0) * 1852 / 3600)
    np.testing.assert_allclose(log.t, np.arange(50.0), atol=2e-5)
    # MATLAB: datenum(2024, 4, 10) is Python ordinal + 366
    assert date(2024, 4, 10).toordinal() + 366 == 739352
    assert log.meta["start_utc"].startswith("2024-04-10T06:00:00.0")


def test_read_of_several_experiments_in_one_file(tmp_path: Path) -> None:
    logs = {"first": trial(20.0), "second": trial(12.5)}
    path = tmp_path / "trial.mat"
    savemat(path, {name: {"t": log.t, **log.channels} for name, log in logs.items()})
    for name, log in logs.items():
        assert_same(read(path, kind="mat", table=name), log)
    both = reader_for(path).read(path)
    assert "several_tables" in {finding["code"] for finding in both.meta["findings"]}


def test_load_of_vectors_next_to_a_struct_with_time(tmp_path: Path) -> None:
    """One struct has the time, its neighbours do not; two times that differ leave it open."""
    t = np.arange(0.0, 30.0, 0.1)
    nav, act = {"t": t, "pos": {"N": 2.0 * t}}, {"rudder": np.sin(t), "gains": np.ones(3)}
    savemat(tmp_path / "one.mat", {"data": {"nav": nav, "act": act}})
    recording = recording_for(tmp_path / "one.mat")
    fields = recording.series["data/nav"].fields
    assert set(fields) == {"pos.N", "act.rudder"}
    np.testing.assert_array_equal(fields["act.rudder"], np.sin(t))
    assert {note["code"] for note in recording.remarks} == {"no_time", "time_of_others"}
    savemat(tmp_path / "two.mat", {"nav": nav, "imu": {"t": t + 0.05, "r": t}, "act": act})
    series = recording_for(tmp_path / "two.mat").series
    assert {name for one in series.values() for name in one.fields} == {"pos.N", "r"}


@pytest.mark.parametrize(
    ("write", "package", "extra"),
    [(written_logs.bag1, "rosbags", "ros"), (written_logs.mat73, "h5py", "hdf5")],
)
def test_read_without_package_names_its_extra(
    write: Writer, package: str, extra: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(trial(), tmp_path)
    for name in [name for name in sys.modules if name.split(".")[0] == package]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(UsageError, match=rf'pip install "residnet\[{extra}\]"'):
        reader_for(path).read(path)


@pytest.mark.parametrize(
    ("write", "name"),
    [
        (written_logs.bag1, "ROS 1 bag"),
        (written_recorders.nmea, "NMEA 0183"),
        (written_recorders.ulog, "PX4 ULog"),
        (written_recorders.ardupilot, "ArduPilot log"),
        (written_recorders.nmea2000, "NMEA 2000"),
    ],
)
def test_detect_recording_format_by_content(write: Writer, name: str, tmp_path: Path) -> None:
    found = detect_recording_format(write(trial(2.0), tmp_path).rename(tmp_path / "recording"))
    assert found is not None
    assert found.name == name
    (table := tmp_path / "table.csv").write_text("a,b\n1,2\n")
    assert detect_recording_format(table) is None
    with pytest.raises(UsageError, match="`channels`, which `residnet new FOLDER` drafts"):
        reader_for(table).read(table)

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
from written_logs import COMMANDS, EPOCH, outcome, reader_for, recording_for, trial

from residnet.core.config import validate
from residnet.core.errors import UsageError
from residnet.core.log import Log
from residnet.core.names import CHANNEL_UNITS
from residnet.data.readers import ReaderConfig
from residnet.data.readers.detect import format_of

Writer = Callable[[Log, Path], Path]
TABLES: list[Writer] = [written_logs.csv, written_logs.parquet]
TREES: list[Writer] = [
    written_logs.mat5,
    written_logs.mat73,
    written_logs.hdf5,
    written_logs.hdf5_table,
]
BAGS: list[Writer] = [
    written_logs.bag1,
    written_logs.bag2,
    written_logs.bag2_mcap,
    written_logs.mcap,
    written_logs.topics,
]


def assert_same(read: Log, expected: Log) -> None:
    assert read.name == "trial"
    np.testing.assert_allclose(read.t, expected.t, rtol=0, atol=1e-9)
    assert set(read.channels) == set(expected.channels)
    assert read.units == {name: CHANNEL_UNITS[name] for name in expected.channels}
    for name, values in expected.channels.items():
        np.testing.assert_allclose(read[name], values, rtol=0, atol=1e-9, err_msg=name)
    assert not read.masks


@pytest.mark.parametrize("write", TABLES)
def test_tables(write: Writer, tmp_path: Path) -> None:
    log = trial()
    channels = {name: {"column": name, "unit": CHANNEL_UNITS[name]} for name in log.channels}
    reader = validate(
        {"kind": write.__name__, "time": {"column": "t"}, "channels": channels},
        ReaderConfig,
        "test",
    ).build()
    assert_same(reader.read(write(log, tmp_path)), log)


@pytest.mark.parametrize("write", [*TREES, *BAGS])
def test_recordings_that_describe_themselves(write: Writer, tmp_path: Path) -> None:
    log = trial()
    path = write(log, tmp_path)
    read = validate({"kind": "auto"}, ReaderConfig, "test").build().read(path)
    assert_same(read, log)
    assert len(read.meta["sha256"]) == 64
    assert all(finding["level"] == "note" for finding in read.meta["findings"]), read.meta[
        "findings"
    ]
    if write in BAGS:
        assert read.meta["epoch"] == EPOCH
        assert read.meta["start_utc"] == "2025-04-11T09:15:45.000000000Z"
        assert any("REP-103" in said for said in read.meta["frames"])


@pytest.mark.parametrize("write", BAGS)
def test_channel_maps_of_topics(write: Writer, tmp_path: Path) -> None:
    """The same bag with every part declared, read field by field."""
    log = trial()
    path = write(log, tmp_path)
    turned = {
        "u": ("twist.twist.linear.x", "m/s"),
        "v": ("twist.twist.linear.y", "m/s"),
        "r": ("twist.twist.angular.z", "rad/s"),
    }
    config: dict[str, Any] = {
        "kind": "csv_topics" if write is written_logs.topics else "rosbag",
        "standard_messages": False,
        "position": {
            "kind": "local",
            "topic": "/odometry",
            "north": "pose.pose.position.y",
            "east": "pose/pose/position/x",
        },
        "heading": {
            "kind": "quaternion",
            "topic": "odometry",
            "field": "pose.pose.orientation",
            "frame": "enu",
        },
        "channels": {
            **{
                name: {"topic": "/odometry", "field": f, "unit": unit, "frame": "body_fpu"}
                for name, (f, unit) in turned.items()
            },
            **{
                name: {"topic": f"/{name}", "field": "data", "unit": "rps", "hold": True}
                for name in COMMANDS
            },
        },
    }
    assert_same(validate(config, ReaderConfig, "test").build().read(path), log)


@pytest.mark.parametrize("write", BAGS)
def test_only_what_is_wanted_is_kept(write: Writer, tmp_path: Path) -> None:
    path = write(trial(), tmp_path)
    kind = "csv_topics" if write is written_logs.topics else "rosbag"
    config = {
        "kind": kind,
        "standard_messages": False,
        "channels": {"cmd_port": {"topic": "cmd_port", "field": "data", "unit": "rps"}},
    }
    read = validate(config, ReaderConfig, "test").build().read(path)
    assert list(read.channels) == ["cmd_port"]
    assert {name.strip("/") for name in read.meta["topics_not_used"]} == {"odometry", "cmd_stbd"}


def test_matlab_matrix_datenum_and_nested_struct(tmp_path: Path) -> None:
    from scipy.io import savemat

    t = 739352.25 + np.arange(50) / 86400.0
    path = tmp_path / "a.mat"
    savemat(
        path,
        {
            "log": {
                "time": t,
                "signals": {"values": np.stack((np.arange(50.0), 2 * np.arange(50.0)), axis=1)},
            }
        },
    )
    config = {
        "kind": "mat",
        "time": {"unit": "datenum"},
        "channels": {"u": {"field": "signals.values.1", "unit": "kn"}},
    }
    log = validate(config, ReaderConfig, "test").build().read(path)
    np.testing.assert_allclose(log["u"], 2 * np.arange(50.0) * 1852 / 3600)
    np.testing.assert_allclose(log.t, np.arange(50.0), atol=2e-5)
    # MATLAB: datenum(2024, 4, 10) is Python ordinal + 366
    assert date(2024, 4, 10).toordinal() + 366 == 739352
    assert log.meta["start_utc"].startswith("2024-04-10T06:00:00.0")


def test_several_experiments_in_one_file(tmp_path: Path) -> None:
    from scipy.io import savemat

    logs = {"first": trial(20.0), "second": trial(12.5)}
    path = tmp_path / "trial.mat"
    savemat(path, {name: {"t": log.t, **log.channels} for name, log in logs.items()})
    for name, log in logs.items():
        assert_same(
            validate({"kind": "mat", "table": name}, ReaderConfig, "test").build().read(path), log
        )
    both = reader_for(path).read(path)
    assert "several_tables" in {finding["code"] for finding in both.meta["findings"]}


RECORDERS = [written_recorders.nmea, written_recorders.ulog, written_recorders.ardupilot]


@pytest.mark.parametrize("write", [*TREES, *BAGS, *RECORDERS])
def test_truncated_files_end_in_one_line(write: Writer, tmp_path: Path) -> None:
    path = write(trial(3.0), tmp_path)
    if path.is_dir():
        path = max(
            (file for file in path.iterdir() if file.suffix != ".yaml"),
            key=lambda file: file.stat().st_size,
        )
    if path.suffix == ".csv":
        return
    whole = path.read_bytes()
    for share in (0.0, 0.02, 0.1, 0.3, 0.5, 0.9, 0.99):
        path.write_bytes(whole[: int(share * len(whole))])
        said = outcome(path)
        assert said is None or ("\n" not in said and path.name in said)


@pytest.mark.parametrize(
    ("write", "package", "extra"),
    [
        (written_logs.bag1, "rosbags", "ros"),
        (written_logs.hdf5, "h5py", "hdf5"),
        (written_logs.mat73, "h5py", "hdf5"),
    ],
)
def test_a_missing_package_is_named_with_its_extra(
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
    ],
)
def test_formats_by_content(write: Writer, name: str, tmp_path: Path) -> None:
    found = format_of(write(trial(2.0), tmp_path).rename(tmp_path / "recording"))
    assert found is not None
    assert found.name == name
    (tmp_path / "table.csv").write_text("a,b\n1,2\n")
    assert format_of(tmp_path / "table.csv") is None
    with pytest.raises(UsageError, match="give a channel map"):
        reader_for(tmp_path / "table.csv").read(tmp_path / "table.csv")


def test_everything_that_a_bag_holds(tmp_path: Path) -> None:
    recording = recording_for(written_logs.bag2(trial(2.0), tmp_path))
    assert sorted(recording.series) == ["/cmd_port", "/cmd_stbd", "/odometry"]
    assert recording["odometry"].kind == "nav_msgs/msg/Odometry"
    assert recording["odometry"].sender is not None
    assert len(recording["cmd_port"]) == 21


def test_vectors_beside_a_struct_with_the_time(tmp_path: Path) -> None:
    """One struct has the time, its neighbours do not; two times that differ leave it open."""
    from scipy.io import savemat

    t = np.arange(0.0, 30.0, 0.1)
    nav = {"t": t, "pos": {"N": 2.0 * t}}
    act = {"rudder": np.sin(t), "gains": np.ones(3)}
    savemat(tmp_path / "one.mat", {"data": {"nav": nav, "act": act}})
    recording = recording_for(tmp_path / "one.mat")
    fields = recording.series["data/nav"].fields
    assert set(fields) == {"pos.N", "act.rudder"}
    np.testing.assert_array_equal(fields["act.rudder"], np.sin(t))
    assert {note["code"] for note in recording.remarks} == {"no_time", "time_of_others"}
    savemat(tmp_path / "two.mat", {"nav": nav, "imu": {"t": t + 0.05, "r": t}, "act": act})
    series = recording_for(tmp_path / "two.mat").series
    assert {name for one in series.values() for name in one.fields} == {"pos.N", "r"}

"""One simulated trial, written in the formats that boats record, by those formats' libraries."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore
from scipy.io import savemat

from residnet.core.log import Log
from residnet.core.names import CHANNEL_UNITS
from residnet.io.readers.base import CanonicalConfig, LogReader
from residnet.io.readers.detect import AutoConfig
from residnet.io.readers.recording import ALL_FIELDS, Recording
from residnet.io.readers.topics import align_clocks

EPOCH = 1_744_362_945
COMMANDS = ("cmd_port", "cmd_stbd")


def trial(seconds: float = 40.0, step: float = 0.1) -> Log:
    """A manoeuvre with two full turns: closed forms, every channel exact, clock on whole ns."""
    t = np.arange(round(seconds / step) + 1) * round(step * 1e9) * 1e-9
    psi = 0.4 + 0.35 * t - 0.3 * np.sin(0.4 * t)
    u, v = 1.2 + 0.2 * np.sin(0.5 * t), 0.1 * np.cos(0.4 * t)
    channels = {
        "x": 12.0 + 9.0 * np.sin(0.3 * t),
        "y": -7.0 + 9.0 * np.cos(0.3 * t),
        "psi": psi,
        "u": u,
        "v": v,
        "r": 0.35 - 0.12 * np.cos(0.4 * t),
        "cmd_port": np.where(np.sin(0.7 * t) > 0, 3.0, -2.0),
        "cmd_stbd": np.where(np.cos(0.6 * t) > 0, 4.0, 1.0),
    }
    return Log("trial", t, channels)


PARTS: dict[str, Any] = {
    word: {
        "kind": "csv",
        "time": {"column": "t"},
        "channels": {name: {"column": name, "unit": CHANNEL_UNITS[name]} for name in names},
    }
    for word, names in (("nav", ("x", "y", "psi", "u", "v", "r")), ("cmd", ("cmd_port",)))
}
"""Reader of what `two_files` writes."""


def two_files(log: Log, folder: Path) -> Path:
    """The motion in a file and a command in another one beside it; returns that of the motion."""
    for word, part in PARTS.items():
        table = pd.DataFrame({"t": log.t, **{name: log[name] for name in part["channels"]}})
        table.to_csv(folder / f"trial_{word}.csv", index=False)
    return folder / "trial_nav.csv"


def csv(log: Log, folder: Path) -> Path:
    """A table with every digit."""
    path = folder / "trial.csv"
    _table(log).to_csv(path, index=False, float_format="%.17g")
    return path


def parquet(log: Log, folder: Path) -> Path:
    """A foreign table."""
    path = folder / "trial.parquet"
    _table(log).to_parquet(path)
    return path


def json_lines(log: Log, folder: Path) -> Path:
    """An object a line."""
    path = folder / "trial.jsonl"
    _table(log).to_json(path, orient="records", lines=True, double_precision=15)
    return path


def excel(log: Log, folder: Path) -> Path:
    """The first sheet of an Excel file."""
    path = folder / "trial.xlsx"
    _table(log).to_excel(path, index=False)
    return path


def mat5(log: Log, folder: Path) -> Path:
    """A struct in a file of MATLAB 5 to 7."""
    path = folder / "trial.mat"
    savemat(path, {"trial": {"t": log.t, **log.channels}, "note": "sea trial"})
    return path


def mat73(log: Log, folder: Path) -> Path:
    """The same struct as MATLAB 7.3 writes it: HDF5 behind a header of 512 bytes, vectors as rows
    of one.
    """
    path = folder / "trial.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        group = file.create_group("trial")
        group.attrs["MATLAB_class"] = np.bytes_("struct")
        for name, values in {"t": log.t, **log.channels}.items():
            made = group.create_dataset(name, data=values[None, :])
            made.attrs["MATLAB_class"] = np.bytes_("double")
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")
    return path


def hdf5(log: Log, folder: Path) -> Path:
    """Datasets in a group."""
    path = folder / "trial.h5"
    with h5py.File(path, "w") as file:
        for name, values in {"t": log.t, **log.channels}.items():
            file.create_dataset(f"run/{name}", data=values)
    return path


def hdf5_table(log: Log, folder: Path) -> Path:
    """One table of named columns."""
    path = folder / "trial.hdf5"
    with h5py.File(path, "w") as file:
        file.create_dataset("table", data=_table(log).to_records(index=False))
    return path


def topics(log: Log, folder: Path) -> Path:
    """One csv per topic, by REP-103, arrivals in local time two hours ahead of the stamps."""
    path = folder / "trial"
    path.mkdir()
    ns = _stamps(log)
    late = (ns + 7200 * 10**9 + 1_000_000).tolist()
    time = [f"{pd.Timestamp(s // 10**9, unit='s'):%Y/%m/%d %H:%M:%S}.{s % 10**9}" for s in late]
    about = {"time": time, "header_stamp_secs": ns // 10**9, "header_stamp_nsecs": ns % 10**9}
    place = dict(zip("xyz", (log["y"], log["x"], 0.0 * log["x"]), strict=True))
    odometry = {f"pose_pose_position_{axis}": values for axis, values in place.items()}
    for part, values in zip("xyzw", _quaternion(log), strict=True):
        odometry[f"pose_pose_orientation_{part}"] = values
    odometry |= {"twist_twist_linear_x": log["u"], "twist_twist_linear_y": -log["v"]}
    odometry |= {"twist_twist_angular_z": -log["r"]}
    tables = {"odometry": odometry, **{name: {"data": log[name]} for name in COMMANDS}}
    for name, columns in tables.items():
        table = pd.DataFrame({**about, **columns})
        table.to_csv(path / f"{name}.csv", index=False, float_format="%.17g")
    return path


def bag1(log: Log, folder: Path) -> Path:
    """ROS 1 bag."""
    path = folder / "trial.bag"
    store = get_typestore(Stores.ROS1_NOETIC)
    with Writer1(path) as writer:
        _messages(log, writer, store, store.serialize_ros1)
    return path


def bag2(log: Log, folder: Path) -> Path:
    """ROS 2 bag in SQLite."""
    return _bag2(log, folder / "trial", StoragePlugin.SQLITE3)


def bag2_mcap(log: Log, folder: Path) -> Path:
    """ROS 2 bag in MCAP."""
    return _bag2(log, folder / "trial", StoragePlugin.MCAP)


def mcap(log: Log, folder: Path) -> Path:
    """The MCAP file alone."""
    found = next(_bag2(log, folder / "whole", StoragePlugin.MCAP).glob("*.mcap"))
    return found.rename(folder / "trial.mcap")


def _bag2(log: Log, path: Path, plugin: StoragePlugin) -> Path:
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Writer2(path, version=9, storage_plugin=plugin) as writer:
        _messages(log, writer, store, store.serialize_cdr)
    return path


def _messages(log: Log, writer: Any, store: Any, serialize: Callable[[Any, str], Any]) -> None:
    """Odometry by REP-103 with header stamps, commands as std_msgs/Float64 at the arrival of the
    odometry.
    """
    odometry = "nav_msgs/msg/Odometry"
    number = "std_msgs/msg/Float64"
    kinds = {"odometry": odometry, **dict.fromkeys(COMMANDS, number)}
    to = {n: writer.add_connection(f"/{n}", kind, typestore=store) for n, kind in kinds.items()}
    types = {name.rpartition("/")[2]: kind for name, kind in store.types.items()}
    qx, qy, qz, qw = _quaternion(log)
    vector = types["Vector3"]
    none = np.zeros(36)
    clock = store.types["builtin_interfaces/msg/Time"]
    for i, at in enumerate(_stamps(log).tolist()):
        time = clock(sec=at // 10**9, nanosec=at % 10**9)
        extra = {"seq": i} if "seq" in types["Header"].__dataclass_fields__ else {}
        point = types["Point"](x=log["y"][i], y=log["x"][i], z=0.0)
        turned = types["Quaternion"](x=qx[i], y=qy[i], z=qz[i], w=qw[i])
        moved = vector(log["u"][i], -log["v"][i], 0.0), vector(0.0, 0.0, -log["r"][i])
        message = types["Odometry"](
            header=types["Header"](stamp=time, frame_id="odom", **extra),
            child_frame_id="base_link",
            pose=types["PoseWithCovariance"](types["Pose"](point, turned), none),
            twist=types["TwistWithCovariance"](types["Twist"](*moved), none),
        )
        writer.write(to["odometry"], at, serialize(message, odometry))
        for name in COMMANDS:
            told = store.types[number](data=log[name][i])
            writer.write(to[name], at, serialize(told, number))


def _table(log: Log) -> pd.DataFrame:
    return pd.DataFrame({"t": log.t, **log.channels})


def _stamps(log: Log) -> np.ndarray:
    """Unix time in ns."""
    return EPOCH * 10**9 + np.rint(log.t * 1e9).astype(np.int64)


def _quaternion(log: Log) -> tuple[np.ndarray, ...]:
    """Of the heading, counter-clockwise from east; its sign flips wherever the wrapped yaw does."""
    yaw = np.remainder(np.pi / 2 - log["psi"] + np.pi, 2 * np.pi) - np.pi
    return 0.0 * yaw, 0.0 * yaw, np.sin(yaw / 2), np.cos(yaw / 2)


def reader_for(path: Path) -> LogReader:
    """The reader of a file or folder that describes itself."""
    return (CanonicalConfig() if Log.is_canonical_log(path) else AutoConfig()).build()


def recording_for(path: Path) -> Recording:
    """All that a file or folder holds, its clocks settled, before it becomes a log."""
    return align_clocks(AutoConfig().load(path, ALL_FIELDS), {}, None)

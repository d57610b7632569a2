"""`residnet demo`: realistic logs of a simulated boat, with typical errors of recordings."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from residnet.core.config import validate_config
from residnet.core.errors import UsageError
from residnet.core.files import atomic_write
from residnet.core.log import Log
from residnet.core.ownership import Manifest, record_folder
from residnet.core.progress import report_progress
from residnet.manoeuvres.trials import simulate_trial_logs
from residnet.manoeuvres.trials_config import SimulatedTrials

if TYPE_CHECKING:
    import pandas as pd

DEMO_TRIALS: dict[str, Any] = {
    "vessel": "example_rudder_boat",
    "seed": 11,
    "duration": "80 s",
    "step": "0.1 s",
    "trials": [
        {"kind": "zigzag", "count": 8, "heading": ["10 deg", "20 deg"], "drive": [0.5, 0.9]},
        {"kind": "constant", "drive": [0.5, 0.8], "steer": [-0.5, 0.5]},
        {"kind": "three_two_one_one", "count": 4},
    ],
    "disturbance": {
        "wind": {"speed": "8 kn", "direction": "220 deg", "gust": 0.6, "correlation": "8 s"}
    },
    "noise": {
        "u": 0.03,
        "v": 0.03,
        "r": "0.2 deg/s",
        "sensors": {
            # the position of the receiver is delayed by 0.3 s
            "x": {"noise": 0.03, "latency": "300 ms"},
            "y": {"noise": 0.03, "latency": "300 ms"},
            "psi": {"noise": "0.3 deg"},
            # offset of the rudder angle sensor
            "delta": {"bias": "2 deg", "noise": "0.1 deg"},
            "n": {"noise": 0.05},
            "wind_speed": {"noise": 0.3},
            "wind_dir": {"noise": "3 deg"},
        },
    },
    "identification": {"zigzag": 6, "constant": 3, "three_two_one_one": 3},
    "validation": {"zigzag": 2, "constant": 1, "three_two_one_one": 1},
}
COLUMN_NAMES = {
    "x": ("north [m]", 1.0),
    "y": ("east [m]", 1.0),
    "psi": ("heading [deg]", 180.0 / np.pi),
    "u": ("speed ahead [kn]", 3600.0 / 1852.0),
    "v": ("speed to starboard [kn]", 3600.0 / 1852.0),
    "r": ("rate of turn [deg/min]", 10800.0 / np.pi),
    "delta": ("rudder [deg]", 180.0 / np.pi),
    "n": ("propeller [rpm]", 60.0),
    "wind_speed": ("true wind speed [kn]", 3600.0 / 1852.0),
    "wind_dir": ("true wind direction [deg]", 180.0 / np.pi),
}
_GAP_SECONDS = (30.0, 32.5)
"""Start and end in s of the gap in every fifth log."""
_START_EPOCH = 1_717_000_000
"""Unix time of the start of the recordings, in May 2024."""


def write_demo(folder: Path, *, overwrite: bool = False) -> list[str]:
    """Write the logs in several layouts; returns the lines for the terminal.

    Args:
        folder: parent of the folders of the layouts.
        overwrite: replace the logs of an earlier demo.

    Raises:
        UsageError: if the logs exist already, or cannot be written.
    """
    manifest = Manifest(folder)
    for name in LAYOUTS:
        layout = folder / name
        if not os.path.lexists(layout):
            continue
        if not layout.is_dir() or not manifest.is_recorded:
            raise UsageError(f"{layout}: exists, and residnet did not make it; give another folder")
        manifest.require_all_owned(layout)
        if not overwrite:
            raise UsageError(f"{layout}: exists; give --overwrite, or another folder")
    config = validate_config(DEMO_TRIALS, SimulatedTrials, "demo")
    logs = [
        _cut_gap(log, number)
        for number, log in enumerate(simulate_trial_logs(config.draw_manoeuvres(), config))
    ]
    with record_folder(folder):
        for name in LAYOUTS:
            manifest.remove_owned(folder / name)
        for number, (name, (_, tables)) in enumerate(LAYOUTS.items()):
            report_progress("writing logs", number, len(LAYOUTS))
            for log in logs:
                for prefix, table in tables(_to_recorder_table(log)).items():
                    with atomic_write(folder / name / f"{prefix}{log.name}.csv") as file:
                        table.to_csv(file, index=False, float_format="%.4f")
        report_progress("writing logs", len(LAYOUTS), len(LAYOUTS))
    seconds = sum(float(log.t[-1] - log.t[0]) for log in logs)
    return [
        f"{len(logs)} logs of a simulated boat in wind, {seconds / 60.0:.0f} minutes, as",
        *(f"{folder}/{name}: {description}" for name, (description, _) in LAYOUTS.items()),
        "their faults: positions 0.3 s late, a rudder that stands 2 degrees off, gaps, noise",
        f"next: residnet new {folder}/two_files",
    ]


def _cut_gap(log: Log, number: int) -> Log:
    """Cut a gap of some seconds into every fifth log."""
    is_kept_mask = np.ones(len(log), dtype=bool)
    if number % 5 == 0:
        is_kept_mask = (log.t < _GAP_SECONDS[0]) | (log.t >= _GAP_SECONDS[1])
    channels = {name: log[name][is_kept_mask] for name in COLUMN_NAMES if name in log.channels}
    return log.replace(t=log.t[is_kept_mask], channels=channels, masks={})


def _to_recorder_table(log: Log) -> pd.DataFrame:
    """Return the table of a log in the units of its recorder, with the time first."""
    import pandas as pd

    table = {"time [s]": np.round(log.t, 3)}
    for name, (column, factor) in COLUMN_NAMES.items():
        values = log[name] * factor
        table[column] = np.remainder(values, 360.0) if name in ("psi", "wind_dir") else values
    return pd.DataFrame(table)


_POSE_COLUMNS = [COLUMN_NAMES[name][0] for name in ("x", "y", "psi")]
_VELOCITY_COLUMNS = [COLUMN_NAMES[name][0] for name in ("u", "v", "r")]
_SURGE_COLUMNS = [COLUMN_NAMES[name][0] for name in ("u", "n")]
_ACTUATOR_COLUMNS = [COLUMN_NAMES[name][0] for name in ("delta", "n")]


def _actuators_as_pulses(table: pd.DataFrame) -> pd.DataFrame:
    """Convert rudder and propeller commands to pulse widths in us (full scale 35 deg, 1500 rpm)."""
    rudder, propeller = (table[name] for name in _ACTUATOR_COLUMNS)
    table = table.drop(columns=_ACTUATOR_COLUMNS)
    table["rudder_pwm"] = (1500.0 + 500.0 / 35.0 * rudder).round().astype(int)
    table["motor_pwm"] = (1500.0 + 500.0 / 1500.0 * propeller).round().astype(int)
    return table


def _split_recorders(table: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Split a log into the tables of a receiver with compass and anemometer, and of the motors."""
    actuator_table = _actuators_as_pulses(table)[["time [s]", "rudder_pwm", "motor_pwm"]]
    # the clock of the motor controller starts seven seconds before the receiver
    actuator_table["time [s]"] = (1e3 * actuator_table["time [s]"] + 7e3).round().astype(int)
    receiver_table = table.drop(columns=[*_VELOCITY_COLUMNS, *_ACTUATOR_COLUMNS])[::2]
    receiver_table["time [s]"] += _START_EPOCH
    return {
        "gnss_": receiver_table.rename(columns={"time [s]": "utc [s]"}),
        "motors_": actuator_table.rename(columns={"time [s]": "millis"}),
    }


def _decimate_columns(table: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Keep positions in each fifth row and wind in each tenth, like a logger of several sensors."""
    table = table.copy()
    for stride, names in ((5, ("x", "y")), (10, ("wind_speed", "wind_dir"))):
        table.loc[np.arange(len(table)) % stride > 0, [COLUMN_NAMES[name][0] for name in names]] = (
            np.nan
        )
    return {"": table}


LAYOUTS: dict[str, tuple[str, Callable[[pd.DataFrame], dict[str, pd.DataFrame]]]] = {
    "csv": ("one table a log", lambda table: {"": table}),
    "two_files": (
        "a receiver and the motors, each with a file and a clock of its own",
        _split_recorders,
    ),
    "rates": ("one table whose columns come at three rates", _decimate_columns),
    "pwm": ("commands as pulses", lambda table: {"": _actuators_as_pulses(table)}),
    "no_pose": (
        "velocities and commands alone",
        lambda table: {"": table.drop(columns=_POSE_COLUMNS)},
    ),
    "surge": (
        "speed and propeller alone",
        lambda table: {"": table[["time [s]", *_SURGE_COLUMNS]]},
    ),
}
"""Layouts by folder: description, and function that returns the tables by prefix of the file."""

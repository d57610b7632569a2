"""`residnet demo`: realistic logs of a simulated boat, with typical errors of recordings."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from residnet.core.config import validate_config
from residnet.core.errors import UsageError
from residnet.core.files import atomic_write
from residnet.core.log import Log
from residnet.core.ownership import Manifest, record_folder
from residnet.core.progress import report_progress
from residnet.identification.scaling import scale_log
from residnet.manoeuvres import ManoeuvreConfig
from residnet.manoeuvres.trials import simulate_trial_logs, simulate_trials
from residnet.manoeuvres.trials_config import SimulatedTrials
from residnet.physics.similarity import FroudeScaling

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
"""Config of the simulated trials of the demonstration logs."""
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
"""Column of each channel in the demonstration logs, and the factor from SI to its unit."""
BASIN_FOLDER = "basin"
"""Folder of the workbooks of a model basin."""
BASIN_SCALE = 50.0
"""Length of the ship divided by that of the model in the basin."""
BASIN_LENGTH = 160.93 / BASIN_SCALE
"""Length of the model in m; the ship is the vessel `mariner`."""
_BASIN_MANOEUVRES: dict[str, dict[str, Any]] = {
    "TC_35_S": {"kind": "turning_circle", "rudder": "35 deg"},
    "TC_35_P": {"kind": "turning_circle", "rudder": "-35 deg"},
    "TC_20_S": {"kind": "turning_circle", "rudder": "20 deg"},
    "ZZ_20-20_S": {"kind": "zigzag", "rudder": "20 deg", "heading": "20 deg", "reversals": 5},
    "ZZ_20-20_P": {
        "kind": "zigzag", "rudder": "20 deg", "heading": "20 deg", "reversals": 5, "first": "port",
    },
    "ZZ_10-10_S": {"kind": "zigzag", "rudder": "10 deg", "heading": "10 deg", "reversals": 5},
    "ZZ_10-10_P": {
        "kind": "zigzag", "rudder": "10 deg", "heading": "10 deg", "reversals": 5, "first": "port",
    },
    "ZZ_15-5_S": {"kind": "zigzag", "rudder": "15 deg", "heading": "5 deg", "reversals": 5},
}  # fmt: skip
"""Tests of the model basin by the name of the workbook."""
_BASIN_COLUMNS = {
    "x": ("X", "m", 1.0, 0.003),
    "y": ("Y", "m", 1.0, 0.003),
    "psi": ("Heading", "deg", 180.0 / np.pi, 0.05),
    "u": ("u", "m/s", 1.0, 0.004),
    "v": ("v", "m/s", 1.0, 0.004),
    "r": ("ROT", "deg/s", 180.0 / np.pi, 0.05),
    "cmd_delta": ("Rudder order", "deg", 180.0 / np.pi, 0.0),
    "delta": ("Rudder", "deg", 180.0 / np.pi, 0.03),
}
"""Columns of the workbooks: header, unit, factor from SI, standard deviation of the noise."""
_BASIN_STEP = 0.1
"""Sample interval of the workbooks in s."""
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
    for name in (*LAYOUTS, BASIN_FOLDER):
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
        manifest.remove_owned(folder / BASIN_FOLDER)
        basin_line = write_basin_workbooks(folder / BASIN_FOLDER)
    seconds = sum(float(log.t[-1] - log.t[0]) for log in logs)
    return [
        f"{len(logs)} logs of a simulated boat in wind, {seconds / 60.0:.0f} minutes, as",
        *(f"{folder}/{name}: {description}" for name, (description, _) in LAYOUTS.items()),
        "their faults: positions 0.3 s late, a rudder offset of 2 degrees, gaps, noise",
        basin_line,
        f"next: residnet new {folder}/two_files",
    ]


def write_basin_workbooks(folder: Path) -> str:
    """Write Excel workbooks of tests with a model of the vessel `mariner`; returns a line on them.

    The ship performs the manoeuvres at full scale, and Froude's law of similarity gives the motion
    of the model, so that full-scale predictions of the model have a known truth.

    Args:
        folder: folder of the workbooks.
    """
    try:
        import openpyxl
    except ImportError:
        return f'{folder}: not written, it needs the extra excel (pip install "residnet[excel]")'
    generator = np.random.default_rng(50)
    logs = measure_basin_tests(simulate_basin_tests(), generator)
    for test_number, (name, log) in enumerate(logs.items(), start=1):
        workbook = openpyxl.Workbook()
        sheet = workbook.active
        assert sheet is not None
        sheet.title = "Data"
        kind = "Turning circle" if name.startswith("TC") else "Zigzag"
        angle = name.split("_")[1].replace("-", "/")
        for row in (
            ("Model test", f"M-4711, scale 1:{BASIN_SCALE:g}"),
            ("Test no.", 4711000 + test_number),
            ("Type", f"{kind} {angle}" + (" deg" if kind == "Turning circle" else "")),
            ("Lpp [m]", BASIN_LENGTH),
            (),
            ("Time", *(header for header, *_ in _BASIN_COLUMNS.values())),
            ("s", *(unit for _, unit, *_ in _BASIN_COLUMNS.values())),
        ):
            sheet.append(row)
        columns = [np.round(log.t, 3)]
        for channel, (_, _, factor, _) in _BASIN_COLUMNS.items():
            columns.append(np.round(factor * log[channel], 5))
        for values in np.column_stack(columns).tolist():
            sheet.append(values)
        with atomic_write(folder / f"{name}.xlsx") as file:
            workbook.save(file)
    return (
        f"{folder}: {len(_BASIN_MANOEUVRES)} Excel files of a model basin (a ship at"
        f" 1:{BASIN_SCALE:g}); residnet new {folder} --length {BASIN_LENGTH:.4g} --scale"
        f" {BASIN_SCALE:g}"
    )


def simulate_basin_tests(vessel: str = "mariner") -> dict[str, Log]:
    """Return the motion of the model in the tests of the basin, without noise, by name.

    Args:
        vessel: name or file of a ship as long and as fast as the vessel `mariner`.
    """
    scaling = FroudeScaling(BASIN_SCALE)
    config = validate_config(
        {
            "vessel": vessel,
            "duration": 900.0,
            "step": _BASIN_STEP * scaling.time_factor,
            # the manoeuvres below replace the random trials of the config
            "trials": [{"kind": "zigzag", "count": 1, "heading": ["10 deg"]}],
            "identification": {},
            "validation": {},
        },
        SimulatedTrials,
        "demo",
    )
    # the helm order comes after two ship lengths of approach
    start = 2.0 * 160.93 / 7.7175
    manoeuvres = [
        validate_config(
            {"name": name, "drive": 1.0, "start": start, **settings}, ManoeuvreConfig, "demo"
        )
        for name, settings in _BASIN_MANOEUVRES.items()
    ]
    runs = simulate_trials(manoeuvres, config)
    return {
        name: scale_log(run.true_log, scaling.inverse)
        for name, run in zip(_BASIN_MANOEUVRES, runs, strict=True)
    }


def measure_basin_tests(logs: Mapping[str, Log], generator: np.random.Generator) -> dict[str, Log]:
    """Return the tests of the basin with the noise of its sensors, by name.

    Args:
        logs: true motion by name.
        generator: generator of the noise.
    """
    factors = {
        channel: (factor, noise) for channel, (_, _, factor, noise) in _BASIN_COLUMNS.items()
    }
    return {
        name: log.replace(
            t=log.t - log.t[0],
            channels={
                channel: log[channel] + noise / factor * generator.standard_normal(len(log))
                for channel, (factor, noise) in factors.items()
            },
        )
        for name, log in logs.items()
    }


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

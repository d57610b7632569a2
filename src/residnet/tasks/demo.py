"""Realistic logs of a simulated boat with the faults of real ones, to try things on."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from residnet.core.config import validate
from residnet.core.errors import UsageError
from residnet.core.files import whole
from residnet.core.log import Log
from residnet.core.ownership import Manifest, recorded_folder
from residnet.core.progress import report
from residnet.data.simulated import SimulatedTrials, simulate

if TYPE_CHECKING:
    import pandas as pd

TRIALS: dict[str, Any] = {
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
            # the receiver tells where the antenna was 0.3 s ago
            "x": {"noise": 0.03, "latency": "300 ms"},
            "y": {"noise": 0.03, "latency": "300 ms"},
            "psi": {"noise": "0.3 deg"},
            # the rudder's zero was set by eye
            "delta": {"bias": "2 deg", "noise": "0.1 deg"},
            "n": {"noise": 0.05},
            "wind_speed": {"noise": 0.3},
            "wind_dir": {"noise": "3 deg"},
        },
    },
    "identification": {"zigzag": 6, "constant": 3, "three_two_one_one": 3},
    "validation": {"zigzag": 2, "constant": 1, "three_two_one_one": 1},
}
COLUMNS = {
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
_GAP = (30.0, 32.5)
"""Seconds that every fifth log lacks."""
_EPOCH = 1_717_000_000
"""Unix time at which the made recordings begin, in May 2024."""


def write_demo(folder: Path, *, overwrite: bool = False) -> list[str]:
    """Write the logs in several layouts; returns what to say.

    Args:
        folder: that a folder for each layout is made in.

    Raises:
        UsageError: where they exist already, or cannot be written.
    """
    manifest = Manifest(folder)
    for name in LAYOUTS:
        layout = folder / name
        if not os.path.lexists(layout):
            continue
        if not layout.is_dir() or not manifest.exists:
            raise UsageError(f"{layout}: exists, and residnet did not make it; give another folder")
        manifest.require_all_owned(layout)
        if not overwrite:
            raise UsageError(f"{layout}: exists; give --overwrite, or another folder")
    config = validate(TRIALS, SimulatedTrials, "demo")
    logs = [_with_gap(log, number) for number, log in enumerate(simulate(config.draw(), config))]
    with recorded_folder(folder):
        for name in LAYOUTS:
            manifest.remove_owned(folder / name)
        for number, (name, (_, tables)) in enumerate(LAYOUTS.items()):
            report("writing logs", number, len(LAYOUTS))
            for log in logs:
                for word, table in tables(_table(log)).items():
                    with whole(folder / name / f"{word}{log.name}.csv") as file:
                        table.to_csv(file, index=False, float_format="%.4f")
        report("writing logs", len(LAYOUTS), len(LAYOUTS))
    seconds = sum(float(log.t[-1] - log.t[0]) for log in logs)
    return [
        f"{len(logs)} logs of a simulated boat in wind, {seconds / 60.0:.0f} minutes, as",
        *(f"{folder}/{name}: {about}" for name, (about, _) in LAYOUTS.items()),
        "their faults: positions 0.3 s late, a rudder that stands 2 degrees off, gaps, noise",
        f"next: residnet new {folder}/two_files",
    ]


def _with_gap(log: Log, number: int) -> Log:
    """Return every fifth log without some seconds."""
    keep = np.ones(len(log), dtype=bool)
    if number % 5 == 0:
        keep = (log.t < _GAP[0]) | (log.t >= _GAP[1])
    channels = {name: log[name][keep] for name in COLUMNS if name in log.channels}
    return log.replace(t=log.t[keep], channels=channels, masks={})


def _table(log: Log) -> pd.DataFrame:
    """Return a log in the units of its recorder, its time first."""
    import pandas as pd

    table = {"time [s]": np.round(log.t, 3)}
    for name, (column, factor) in COLUMNS.items():
        values = log[name] * factor
        table[column] = np.remainder(values, 360.0) if name in ("psi", "wind_dir") else values
    return pd.DataFrame(table)


_POSE = [COLUMNS[name][0] for name in ("x", "y", "psi")]
_OWN = [COLUMNS[name][0] for name in ("u", "v", "r")]
_SURGE = [COLUMNS[name][0] for name in ("u", "n")]
_ACTS = [COLUMNS[name][0] for name in ("delta", "n")]


def _pulses(table: pd.DataFrame) -> pd.DataFrame:
    """Return rudder and propeller as the pulses that drive them, in us: 35 deg, 1500 rpm."""
    rudder, propeller = (table[name] for name in _ACTS)
    table = table.drop(columns=_ACTS)
    table["rudder_pwm"] = (1500.0 + 500.0 / 35.0 * rudder).round().astype(int)
    table["motor_pwm"] = (1500.0 + 500.0 / 1500.0 * propeller).round().astype(int)
    return table


def _two_files(table: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Return what a receiver with compass and anemometer writes, and what the motors do."""
    acts = _pulses(table)[["time [s]", "rudder_pwm", "motor_pwm"]]
    # the board was switched on seven seconds before the receiver began
    acts["time [s]"] = (1e3 * acts["time [s]"] + 7e3).round().astype(int)
    fixes = table.drop(columns=[*_OWN, *_ACTS])[::2]
    fixes["time [s]"] += _EPOCH
    return {
        "gnss_": fixes.rename(columns={"time [s]": "utc [s]"}),
        "motors_": acts.rename(columns={"time [s]": "millis"}),
    }


def _rates(table: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Return positions in each fifth row and wind in each tenth, as one logger of all writes."""
    table = table.copy()
    for every, names in ((5, ("x", "y")), (10, ("wind_speed", "wind_dir"))):
        table.loc[np.arange(len(table)) % every > 0, [COLUMNS[name][0] for name in names]] = np.nan
    return {"": table}


LAYOUTS: dict[str, tuple[str, Callable[[pd.DataFrame], dict[str, pd.DataFrame]]]] = {
    "csv": ("one table a log", lambda table: {"": table}),
    "two_files": ("a receiver and the motors, each with a file and a clock of its own", _two_files),
    "rates": ("one table whose columns come at three rates", _rates),
    "pwm": ("commands as pulses", lambda table: {"": _pulses(table)}),
    "no_pose": ("velocities and commands alone", lambda table: {"": table.drop(columns=_POSE)}),
    "surge": ("speed and propeller alone", lambda table: {"": table[["time [s]", *_SURGE]]}),
}
"""Folder -> what it holds, and the tables of a log by the word that its file's name begins with."""

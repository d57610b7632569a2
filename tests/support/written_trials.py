"""Sea trials of a catamaran as a stranger would hand them over: csv, odd names, degrees and rpm."""

from __future__ import annotations

import math
from pathlib import Path

import pandas as pd

import residnet

CHANNELS = {
    "x": ("north", "m"),
    "y": ("east", "m"),
    "psi": ("heading", "deg"),
    "u": ("surge", "m/s"),
    "v": ("sway", "m/s"),
    "r": ("yaw rate", "deg/s"),
    "n_port": ("port", "rpm"),
    "n_stbd": ("starboard", "rpm"),
}
_FACTORS = {"deg": 180.0 / math.pi, "deg/s": 180.0 / math.pi, "rpm": 60.0}


def write_trials(folder: Path, *, duration: float = 60.0, seed: int = 1) -> list[residnet.Log]:
    """Ten csv files in `folder`; returns the logs that they were written from."""
    folder.mkdir(parents=True, exist_ok=True)
    zigzags = [
        {"kind": "zigzag", "drive": drive, "steer": steer, "heading": "20 deg", "start": 3}
        for drive in (0.4, 0.6, 0.8)
        for steer in (0.3, 0.5)
    ]
    circles = [
        {"kind": "turning_circle", "drive": drive, "steer": steer, "start": 3}
        for drive in (0.4, 0.8)
        for steer in (0.3, -0.5)
    ]
    noise = {"u": 0.01, "v": 0.01, "r": 0.002}
    trials = residnet.simulate(
        "wam_v_cal", [*zigzags, *circles], duration=duration, step=0.1, noise=noise, seed=seed
    )
    for log in trials.logs:
        columns = {"time": log.t}
        for name, (column, unit) in CHANNELS.items():
            columns[column] = log[name] * _FACTORS.get(unit, 1.0)
        pd.DataFrame(columns).to_csv(folder / f"{log.name}.csv", index=False)
    return trials.logs

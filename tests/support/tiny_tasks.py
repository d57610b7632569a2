"""The smallest run of each kind of task, as configs: each takes a second or two."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from residnet.core.config import dump_config
from residnet.tasks.registry import load_task

CHANNELS = {
    "x": "m",
    "y": "m",
    "psi": "rad",
    "u": "m/s",
    "v": "m/s",
    "r": "rad/s",
    "n": "1/s",
    "delta": "rad",
}
WINDOWS = {"T5": {"kind": "windows", "length": 5, "first": 1, "history": 1}}


def boat(seed: int, seconds: float = 20.0, step: float = 0.1) -> pd.DataFrame:
    """A small boat in the plane under random revolutions and rudder angles, with some noise."""
    rng = np.random.default_rng(seed)
    count = round(seconds / step)
    n = np.repeat(rng.uniform(4.0, 9.0, count // 40 + 1), 40)[:count]
    delta = np.repeat(rng.uniform(-0.5, 0.5, count // 25 + 1), 25)[:count]
    state = np.zeros((count, 6))
    state[0, 3] = 1.0
    for k in range(count - 1):
        psi, u, v, r = state[k, 2:]
        rates = (
            u * np.cos(psi) - v * np.sin(psi),
            u * np.sin(psi) + v * np.cos(psi),
            r,
            0.2 * (0.25 * n[k] - u) + 0.1 * v * r,
            0.4 * (-v - 0.5 * u * r),
            0.6 * (0.35 * u * delta[k] - r),
        )
        state[k + 1] = state[k] + step * np.array(rates)
    state[:, 3:] += rng.normal(scale=(0.01, 0.01, 0.002), size=(count, 3))
    table = pd.DataFrame(state, columns=list(CHANNELS)[:6])
    table.insert(0, "t", np.arange(count) * step)
    return table.assign(n=n, delta=delta)


def write_logs(folder: Path, count: int = 6) -> None:
    """Write csv logs of the small boat."""
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        boat(number).to_csv(folder / f"log_{number}.csv", index=False, float_format="%.9g")


def _reader() -> dict[str, Any]:
    return {
        "kind": "csv",
        "time": {"column": "t", "unit": "s"},
        "channels": {name: {"column": name, "unit": unit} for name, unit in CHANNELS.items()},
    }


def measured(folder: Path) -> dict[str, Any]:
    """A fit to csv logs: a baseline, a ridge and a perceptron of one epoch."""
    if not (folder / "logs").is_dir():
        write_logs(folder / "logs")
    return {
        "task": "fit",
        "name": "measured",
        "data": {
            "kind": "measured",
            "reader": _reader(),
            "split": {
                "root": str(folder / "logs"),
                "train": ["log_[0-3].csv"],
                "validation": ["log_4.csv"],
                "test": ["log_5.csv"],
            },
        },
        "prepare": {
            "grid": {"step": 0.1, "held": ["n", "delta"]},
            "derivative": {"kind": "savitzky_golay", "window": 1.1, "order": 2},
        },
        "signals": {"inputs": ["n", "delta"]},
        "baseline": {"kind": "regressors", "terms": ["u", "v", "r", "n", "delta"]},
        "heads": {
            "ridge": {"kind": "ridge", "degree": 1, "folds": 2},
            "mlp": {"kind": "mlp", "hidden": [3]},
        },
        "training": {
            "mlp": {
                "steps": 1,
                "one_step": {"epochs": 1, "window": 2.0, "batch": 8},
                "multi_step": [{"horizon": 1.0, "epochs": 1, "batch": 8}],
            }
        },
        "evaluation": {
            "splits": ["train", "validation", "test"],
            "protocols": WINDOWS,
            "selection": "T5",
            "scales": {"u": 0.4, "v": 0.1, "r": 0.1},
        },
        "export": {"models": []},
    }


def simulated(folder: Path) -> dict[str, Any]:
    """A fit to simulated trials: a baseline and a head in closed form."""
    return {
        **measured(folder),
        "name": "simulated",
        "data": {
            "kind": "simulated",
            "vessel": "wam_v_cal",
            "duration": 12,
            "substeps": 1,
            "step": 0.1,
            "trials": [{"kind": "zigzag", "count": 4, "heading": ["20 deg"], "start": 1}],
            "identification": {"zigzag": 3},
            "validation": {"zigzag": 1},
        },
        "prepare": {
            "grid": {"step": 0.1},
            "derivative": {"kind": "savitzky_golay", "window": 1.1, "order": 2},
        },
        "signals": {"inputs": ["n_port", "n_stbd"], "forces": "wam_v_cal"},
        "baseline": {"kind": "regressors", "terms": ["u", "v", "r", "tau_x", "tau_n"]},
        "heads": {"plsr": {"kind": "plsr", "folds": 2}},
        "training": {},
    }


def flown(folder: Path) -> dict[str, Any]:
    """Two manoeuvres of a vessel."""
    return {
        "task": "simulate",
        "name": "flown",
        "programme": {
            "vessel": "wam_v_cal",
            "duration": 8,
            "step": 0.1,
            "manoeuvres": [
                {"kind": "constant", "drive": 0.5, "steer": 0.0},
                {"kind": "zigzag", "heading": "10 deg", "drive": 0.5, "steer": 0.3},
            ],
        },
    }


def autopilot(folder: Path) -> dict[str, Any]:
    """One small policy beside a tuned controller."""
    training = {
        "epochs": 1, "steps": 1, "batch": 8, "dt": "0.2 s", "hold": "0 s", "validation": 4,
        "compiled": False, "steady": None,
    }  # fmt: skip
    stated = {"dt": "0.2 s", "duration": "6 s", "hold": "0 s"}
    search = {"flights": 2, "population": 2, "generations": 1}
    return {
        "task": "autopilot",
        "name": "small",
        "vessel": "nomoto_oceanos",
        "rudder": "5 deg",
        "turning_time": "40 s",
        "test": {"dt": "0.2 s", "duration": "6 s", "plants": 1, "bias_time": "6 s"},
        "conditions": {"stated": stated, "flights": 4, "evolution": search},
        "policies": {"policy": {"start": None, "units": 2, "training": training}},
        "peers": {"pd": {"kind": "pd"}, "bang_bang": {"kind": "bang_bang"}},
        "floor": "bang_bang",
    }


BUOYS = [
    {"north": 50.0, "east": 30.0, "leave_to": "port", "radius": 10.0},
    {"north": 100.0, "east": 20.0, "leave_to": "starboard", "radius": 12.0},
]
COURSE: dict[str, Any] = {
    "task": "course",
    "name": "bend",
    "autopilot": "autopilot.yaml",
    "course": {"buoys": BUOYS, "acceptance": 4.0, "lookahead": 10.0, "planning_dt": "0.2 s"},
    "peers": ["pd"],
    "dt": "0.2 s",
    "duration": "42 s",
}
"""Two way-points; the config of the autopilot lies beside it."""


def roll(folder: Path) -> dict[str, Any]:
    """Roll reduction in two directions of one sea state."""
    return {
        "task": "roll",
        "name": "roll",
        "vessel": "patrol_fins",
        "hull": {"volume": 355.88, "breadth": 7.726, "metacentric_radius": 3.34},
        "rudder": "20 deg",
        "fins": "25 deg",
        "sea_states": [4],
        "directions": ["0 deg", "90 deg"],
        "dt": "0.2 s",
        "transient": "10 s",
        "duration": "30 s",
        "tuning": {"generations": 2, "population": 2},
        "units": 2,
        "training": {"epochs": 1, "steps": 2, "rows_per_sea": 2, "validation_rows": 2},
        "judging": {"duration": "40 s", "realisations": 3},
    }


def imported(folder: Path) -> dict[str, Any]:
    """Tables brought into the canonical form."""
    if not (folder / "logs").is_dir():
        write_logs(folder / "logs")
    return {
        "task": "import",
        "name": "imported",
        "root": str(folder / "logs"),
        "logs": ["log_[01].csv"],
        "reader": _reader(),
    }


def actuators(folder: Path) -> dict[str, Any]:
    """A throttle map."""
    throttle = np.arange(-100, 101, 5)
    rpm = np.clip(28 * throttle, -2380, 2380) + 3 * np.sin(throttle)
    file = folder / "throttle.csv"
    pd.DataFrame({"throttle": throttle, "rpm": rpm}).to_csv(file, index=False)
    return {
        "task": "actuators",
        "name": "thrusters",
        "throttle": {
            "files": [str(file)],
            "throttle": {"column": "throttle", "unit": "%"},
            "n": {"column": "rpm", "unit": "rpm"},
        },
    }


TINY_TASKS: dict[str, Callable[[Path], dict[str, Any]]] = {
    "measured": measured,
    "simulated": simulated,
    "flown": flown,
    "autopilot": autopilot,
    "roll": roll,
    "imported": imported,
    "actuators": actuators,
}


def resolved(config: Path) -> str:
    """The config with every default, which has more keys to go wrong."""
    return dump_config(load_task(config))

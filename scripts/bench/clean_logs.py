"""False accusations on clean logs of ten vessels: findings, instrument errors and drafts.

    python scripts/bench/clean_logs.py [--logs 3] [--seed 5000] [--vessels NAME ...]
        [--checks NAME ...] [--results FILE.json]

The vessels are five shipped simulators with unlike physics, a ferry, two small boats drawn at
random, and two measured model ships (Esso Osaka, KVLCC2) where RESIDNET_DATA names their logs.
Counted for each vessel are findings above a note of single logs and of sets of logs, significant
instrument errors and currents, velocities that are not as declared, and channels that
`residnet new` would read differently from how they were written. All logs are correct, so each is
a false accusation. With --results the counts are added to those of earlier calls in a file, so that
200 logs can be inspected in pieces; the totals are those of the file.
"""

from __future__ import annotations

import json
import math
import os
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import bench
import numpy as np
import pandas as pd
from random_vessels import small_boat_logs

from residnet.core.errors import ResidnetError
from residnet.core.log import Log
from residnet.core.names import CHANNEL_UNITS
from residnet.io.drafting.questions import DraftNotes
from residnet.io.drafting.reading import read_drafted
from residnet.manoeuvres.trials import simulate_trial_logs
from residnet.manoeuvres.trials_config import SimulatedTrials
from residnet.quality import inspect_log, inspect_log_set
from residnet.quality.compatibility import analyse_compatibility

_SET_SIZE = 10
"""Logs that are compared with each other."""
_NOISES: dict[str, tuple[float, str, float, str]] = {
    "small": (0.03, "0.2 deg/s", 0.05, "0.3 deg"),
    "ship": (0.05, "0.05 deg/s", 0.2, "0.2 deg"),
}
"""Noise of velocities in m/s, of the yaw rate, of positions in m, and of the heading."""
_SIMULATORS = {
    "wam_v_cal": ("catamaran", "150 s", "0.1 s", "small"),
    "patrol_p06": ("patrol boat that rolls", "300 s", "0.2 s", "ship"),
    "mariner": ("cargo ship, Abkowitz model", "900 s", "0.5 s", "ship"),
    "odin_planing": ("planing boat", "150 s", "0.1 s", "small"),
    "nomoto_ship": ("ship, Nomoto model", "600 s", "0.5 s", "ship"),
    "milliampere": ("ferry with forces", "150 s", "0.1 s", "small"),
}
"""Shipped vessel -> description, duration and step of its logs, and its noise."""
_MANOEUVRES: tuple[dict[str, Any], ...] = (
    {"kind": "zigzag", "heading": ["20 deg"]},
    {"kind": "random_steps"},
    {"kind": "three_two_one_one"},
    {"kind": "turning_circle"},
)
_KNOWN_FAULTS = {"esso_osaka": ("frozen", "spikes", "yaw_drift", "lag", "jump")}
"""Measured logs -> codes of faults that they have (tests/io/test_measured.py): repeated positions,
outliers, a gyro that drifts by 29 deg in one log, and one that is .7 to 1 s late in all six
berthings; a sway velocity that jumps at the end of repeated positions.
"""
_MAX_DEVIATION = 0.02
"""Deviation of a drafted channel from its values that is no change of its meaning."""
_COLUMN_UNITS = {"rad": ("deg", 180.0 / math.pi), "rad/s": ("deg/s", 180.0 / math.pi)}


def simulate_vessel(vessel: str, seed: int, n_logs: int) -> list[Log]:
    """Simulate logs of a shipped vessel, all manoeuvres in turn."""
    _, duration, step, noise_name = _SIMULATORS[vessel]
    velocity, yaw_rate, position, heading = _NOISES[noise_name]
    sensors = {
        "x": {"noise": position},
        "y": {"noise": position},
        "psi": {"noise": heading},
    }
    counts = [len(range(k, n_logs, len(_MANOEUVRES))) for k in range(len(_MANOEUVRES))]
    trials = [
        {**manoeuvre, "count": count}
        for manoeuvre, count in zip(_MANOEUVRES, counts, strict=True)
        if count
    ]
    config = SimulatedTrials.model_validate(
        {
            "vessel": vessel,
            "seed": seed,
            "duration": duration,
            "step": step,
            "noise": {"u": velocity, "v": velocity, "r": yaw_rate, "sensors": sensors},
            "trials": trials,
            "identification": {},
            "validation": {},
        }
    )
    logs = simulate_trial_logs(config.draw_manoeuvres(), config)
    return [log.replace(name=f"{vessel}_{k:02d}") for k, log in enumerate(logs)]


def read_measured(name: str, n_logs: int) -> list[Log]:
    """Read measured logs of a model ship; none without RESIDNET_DATA."""
    from residnet.tasks.registry import load_task

    folder = Path(os.environ.get("RESIDNET_DATA", "missing")) / name
    if not folder.is_dir():
        return []
    task: Any = load_task(bench.CONFIGS / f"{name}.yaml")
    reader = task.data.reader.build()
    files = sorted(folder.rglob("*.csv"))[:n_logs]
    return [reader.read(file) for file in files]


def list_vessels(seed: int, n_logs: int) -> dict[str, Callable[[], list[Log]]]:
    """Return the functions that make the logs of each vessel."""
    vessels: dict[str, Callable[[], list[Log]]] = {
        name: lambda name=name: simulate_vessel(name, seed, n_logs)  # type: ignore[misc]
        for name in _SIMULATORS
    }
    vessels["small_boat"] = lambda: small_boat_logs("boat", seed, n_logs, 200.0)
    vessels["small_twin"] = lambda: small_boat_logs("twin", seed + 1, n_logs, 200.0)
    vessels["esso_osaka"] = lambda: read_measured("esso_osaka", n_logs)
    vessels["kvlcc2"] = lambda: read_measured("kvlcc2", n_logs)
    return vessels


def check_findings(vessel: str, logs: Sequence[Log]) -> list[str]:
    """Return the findings above a note of each log and of sets of logs."""
    known_faults = _KNOWN_FAULTS.get(vessel, ())
    accusations = [
        f"{finding.code}: {log.name}: {finding.line}"
        for log in logs
        for finding in inspect_log(log).findings
        if finding.level != "note" and finding.code not in known_faults
    ]
    for start in range(0, len(logs), _SET_SIZE):
        accusations += [
            f"{finding.code}: {finding.line}"
            for finding in inspect_log_set(logs[start : start + _SET_SIZE]).findings
            if finding.level != "note"
        ]
    return accusations


def check_compatibility(_vessel: str, logs: Sequence[Log]) -> list[str]:
    """Return significant instrument errors, currents and meanings of correct logs."""
    accusations = []
    for log in logs:
        row = analyse_compatibility(log)
        if row.meaning not in ("", "as declared") and row.current is None:
            accusations.append(f"meaning: {log.name}: {row.meaning}")
        if row.meaning == "u, v in earth axes":
            accusations.append(f"meaning: {log.name}: {row.meaning}")
        if row.current is not None and row.current.is_significant:
            current = row.current
            accusations.append(
                f"current: {log.name}: {math.hypot(current.north, current.east):.3g} m/s"
                f" +- {current.standard_error:.2g}"
            )
        accusations += [
            f"error {error.name}: {log.name}: {error.value:.3g} +- {error.standard_error:.2g}"
            for error in row.errors
            if error.is_significant
        ]
    return accusations


def check_draft(_vessel: str, logs: Sequence[Log]) -> list[str]:
    """Return the channels that a draft of tables reads differently from their values."""
    accusations = []
    with tempfile.TemporaryDirectory() as folder:
        paths = {}
        for log in logs:
            columns = {"time [s]": log.t}
            for name, values in log.channels.items():
                unit = CHANNEL_UNITS.get(name, log.units.get(name, ""))
                unit, factor = _COLUMN_UNITS.get(unit, (unit, 1.0))
                columns[f"{name} [{unit}]" if unit else name] = factor * values
            path = Path(folder) / f"{log.name}.csv"
            pd.DataFrame(columns).to_csv(path, index=False)
            paths[path] = log
        try:
            result = read_drafted([*paths], DraftNotes())
        except ResidnetError as error:
            return [f"draft: {error}"]
        accusations += [f"draft: {error}" for error in result.errors.values()]
        for path, drafted in result.logs.items():
            truth = paths[path]
            accusations += [
                f"draft {name}: {truth.name} is read with another value"
                for name in truth.channels
                if name in drafted.channels and _deviates(truth[name], drafted[name], name)
            ]
    return accusations


def _deviates(truth: np.ndarray, values: np.ndarray, name: str) -> bool:
    """Return whether a drafted channel has another meaning or unit."""
    if truth.shape != values.shape:
        return True
    difference = values - truth
    if name in ("x", "y"):
        # the origin is free
        difference = difference - np.nanmedian(difference)
    if name in ("psi", "wind_dir"):
        difference = np.angle(np.exp(1j * difference))
    spread = max(float(np.nanstd(truth)), 1e-9)
    return float(np.nanmax(np.abs(difference), initial=0.0)) > _MAX_DEVIATION * spread


_CHECKS = {
    "findings": check_findings,
    "compatibility": check_compatibility,
    "draft": check_draft,
}


def print_row(name: str, row: dict[str, Any]) -> None:
    """Print the number of logs, of accusations by check over the logs checked, and the time."""
    cells = "".join(
        f"{len(row['accusations'][check]):8d} in {row['logs'][check]:3d}"
        if row["logs"].get(check)
        else f"{'-':>15s}"
        for check in _CHECKS
    )
    seconds = row["seconds"] / max(row["logs"].values())
    print(f"{name:14s}{cells}  {seconds:.2f}", flush=True)


def add_rows(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the sum of several rows."""
    return {
        "logs": {check: sum(row["logs"].get(check, 0) for row in rows) for check in _CHECKS},
        "seconds": sum(row["seconds"] for row in rows),
        "accusations": {
            check: [text for row in rows for text in row["accusations"].get(check, ())]
            for check in _CHECKS
        },
    }


def main() -> None:
    """Print the accusations of each vessel and their number."""
    arguments = bench.options(__doc__, logs=3, seed=5000, vessels=[""], checks=_CHECKS, results="")
    vessels = list_vessels(arguments.seed, arguments.logs)
    names = [name for name in arguments.vessels if name] or [*vessels]
    file = Path(arguments.results)
    rows: list[dict[str, Any]] = json.loads(file.read_text()) if file.is_file() else []
    print(f"{'vessel':14s}" + "".join(f"{name:>15s}" for name in _CHECKS) + "  seconds a log")
    for name in names:
        logs = vessels[name]()
        start = time.process_time()
        accusations = {}
        for check_name in arguments.checks:
            accusations[check_name] = _CHECKS[check_name](name, logs)
            for text in accusations[check_name]:
                print(f"{name}: {check_name}: {text}", file=sys.stderr, flush=True)
        row = {
            "vessel": name,
            "seed": arguments.seed,
            "logs": dict.fromkeys(accusations, len(logs)),
            "seconds": time.process_time() - start,
            "accusations": accusations,
        }
        rows.append(row)
        if logs:
            print_row(name, row)
        if arguments.results:
            file.write_text(json.dumps(rows, indent=1))
    print_row("all", add_rows(rows))


if __name__ == "__main__":
    main()

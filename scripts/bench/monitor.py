"""Does the monitor find planted changes of simulated vessels, and leave clean logs alone?

Each vessel is identified from clean trials in currents that the fit estimates. Then trials of the
changed vessel, five minutes a seed, go through the monitor, and hours of clean ones. With
--scatter the parameters of the vessels are scattered by about a fifth first. With --seeds 0 only
clean trials are watched. Of each alarm in these a line tells when it came and what scored highest.

    python scripts/bench/monitor.py [--seeds 10] [--hours 2] [--seed 0] [--scatter] [VESSEL...]
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from scattered import scattered

from residnet.core.config import validate
from residnet.core.files import config_folder
from residnet.core.log import Log
from residnet.data.prepare import Prepared, prepare
from residnet.data.simulated import SimulatedTrials, simulate
from residnet.identification.fit import fit
from residnet.identification.fitter import FittedModel
from residnet.identification.monitoring import MonitorConfig, Verdict, Watch, Watcher
from residnet.identification.prepared import prepare_logs, through_currents
from residnet.identification.settings import FitSettings

STEP = 0.1
PER_SEED = 5
"""Trials of 60 s that each seed sees."""
VESSELS: dict[str, dict[str, Any]] = {
    "wam_v_cal": {"inputs": ["n_port", "n_stbd"], "forces": "wam_v_cal"},
    "wam_v_vrx": {"inputs": ["n_port", "n_stbd"], "forces": "wam_v_vrx"},
    "example_rudder_boat": {"inputs": ["n", "delta"]},
}
SEA: dict[str, dict[str, Any]] = {
    "wam_v_cal": {"force_x": 10, "force_y": 10, "force_n": 10},
    "wam_v_vrx": {"force_x": 10, "force_y": 10, "force_n": 10},
    "example_rudder_boat": {"wind": {"speed": "3 m/s", "direction": "220 deg", "gust": 0.5}},
}


def trials(vessel: str, sea: dict[str, Any], seed: int, count: int) -> list[Log]:
    """Return logs of so many trials, a mixture of manoeuvres in random order."""
    third = max(count // 3, 3)
    content: dict[str, Any] = {
        "kind": "simulated",
        "vessel": vessel,
        "seed": seed,
        "trials": [
            {"kind": "zigzag", "count": count - 2 * third + 3, "heading": ["10 deg", "20 deg"]},
            {"kind": "three_two_one_one", "count": third},
            {"kind": "acceleration_deceleration", "count": third},
        ],
        "duration": 60.0,
        "step": STEP,
        "substeps": 2,
        "noise": {"u": 0.02, "v": 0.02, "r": 0.003},
        "disturbance": {"current_each": [0.0, 0.3], **sea},
        "identification": {"zigzag": 2},
        "validation": {"zigzag": 1},
    }
    config = validate(content, SimulatedTrials, "bench")
    logs = simulate(config.draw(), config)
    order = np.random.default_rng(seed).permutation(len(logs))[:count]
    return [logs[i] for i in order]


def identified(
    vessel: str, flown: str, seed: int
) -> tuple[FitSettings, FittedModel, list[Prepared]]:
    """Return a model of the clean vessel, and the logs that fitted it, over ground."""
    logs = trials(flown, SEA[vessel], seed, 40)
    settings = validate(
        {
            "prepare": {
                "grid": {"step": STEP},
                "derivative": {"kind": "savitzky_golay", "window": 1.1, "order": 2},
                "hold": "mean",
            },
            "signals": VESSELS[vessel],
            "baseline": {"kind": "regressors", "sets": ["fossen"], "ridge": 1e-6},
            "refit": {"baseline": {"horizon": 10.0, "every": 10.0, "iterations": 4}},
            "current": {"spread": 0.3},
            "bands": None,
            "evaluation": {
                "protocols": {"T20": {"kind": "windows", "length": 20.0}},
                "selection": "T20",
                "scales": {"u": 0.3, "v": 0.1, "r": 0.1},
            },
        },
        FitSettings,
        "bench",
    )
    prepared = prepare_logs({"train": logs[8:], "validation": logs[:8]}, settings)
    found = fit(through_currents(prepared, settings)[0], settings)
    return settings, found["baseline"], [*prepared["train"], *prepared["validation"]]


def vessel_file(vessel: str) -> Path:
    """Return the file of a vessel of residnet, or of one given by its path."""
    shipped = config_folder() / "vessels" / f"{vessel}.yaml"
    return shipped if shipped.is_file() else Path(vessel)


def changed_vessel(flown: str, change: Callable[[dict[str, Any]], None], folder: Path) -> str:
    """Write a vessel file with a change, and return its path."""
    content = yaml.safe_load(vessel_file(flown).read_text())
    change(content)
    file = folder / f"{Path(flown).stem}_{change.__name__}.yaml"
    file.write_text(yaml.safe_dump(content))
    return str(file)


def heavier(content: dict[str, Any]) -> None:
    """Add 15 % to mass and inertia."""
    for name in ("m", "I_z"):
        content["rigid_body"][name]["value"] *= 1.15


def yaw_damping(content: dict[str, Any]) -> None:
    """Take 20 % off the damping in yaw."""
    for term, entry in content["damping"]["N"].items():
        if term in ("r", "r|r|", "|u|r"):
            entry["value"] *= 0.8


def scaled(name: str, factor: float, offset: float = 0.0) -> Callable[[Log], Log]:
    """Return what changes one channel of a log."""

    def change(log: Log) -> Log:
        channels = dict(log.channels)
        channels[name] = factor * channels[name] + offset
        return log.replace(channels=channels)

    return change


def cases(
    vessel: str, flown: str, folder: Path
) -> dict[str, tuple[str, Callable[[Log], Log], str]]:
    """Return the planted changes: vessel that is flown, what becomes of its logs, right cause."""
    same = scaled("u", 1.0)
    side = "n_stbd" if "n_stbd" in VESSELS[vessel]["inputs"] else "n"
    out = {
        "mass +15 %": (changed_vessel(flown, heavier, folder), same, "mass"),
        "thrust -10 %": (flown, scaled(side, 0.9**-0.5), f"gain {side}"),
        "yaw damping -20 %": (changed_vessel(flown, yaw_damping, folder), same, "damping yaw"),
        "gyro +5 %": (flown, scaled("r", 1.05), "gyro scale"),
    }
    if "delta" in VESSELS[vessel]["inputs"]:
        out["rudder 2 deg"] = (flown, scaled("delta", 1.0, -np.deg2rad(2)), "offset delta")
    return out


def watched(watch: Watch, settings: FitSettings, logs: Sequence[Log]) -> list[Verdict]:
    """Return what the monitor says, window by window."""
    watcher = Watcher(watch)
    out = []
    for log in logs:
        watcher.restart()
        known = prepare(log, "external", settings.signals.columns, settings.prepare)
        out += [watcher.take(sums) for sums in watch.sums(watch.windows(known))]
    return out


def raised(verdicts: Sequence[Verdict]) -> list[int]:
    """Return the windows at which an alarm begins."""
    alarms = [False, *(verdict.alarm for verdict in verdicts)]
    return [k for k in range(len(verdicts)) if alarms[k + 1] and not alarms[k]]


def told(verdict: Verdict) -> str:
    """Return what scores highest, with its size."""
    top = max(verdict.suspects, key=lambda suspect: suspect.score)
    size = f"{top.size:+.3f} +- {top.error:.3f}"
    return f"{top.change.name} {size} scores {top.score:.2f} of {verdict.threshold:.2f}"


def main() -> None:
    """Read the command line, and print a table for each vessel."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("vessels", nargs="*", default=list(VESSELS))
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--hours", type=float, default=2.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scatter", action="store_true")
    given = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        for vessel in given.vessels:
            random = np.random.default_rng(given.seed)
            sailed = vessel
            if given.scatter:
                sailed = str(scattered(vessel, random, Path(folder), ("added_mass", "damping")))
            settings, model, clean = identified(vessel, sailed, 100 + given.seed)
            config = MonitorConfig()
            watch = Watch.of(model.spec, model.model, clean, config)
            print(f"{vessel}: threshold {watch.threshold:.2f}", flush=True)
            planted = cases(vessel, sailed, Path(folder)) if given.seeds else {}
            for name, (flown, change, right) in planted.items():
                count = PER_SEED * given.seeds
                logs = trials(flown, SEA[vessel], 7 + given.seed, count)
                found, first, firsts = 0, 0, []
                for k in range(given.seeds):
                    part = [change(log) for log in logs[PER_SEED * k : PER_SEED * (k + 1)]]
                    verdicts = watched(watch, settings, part)
                    alarmed = any(verdict.alarm for verdict in verdicts)
                    found += alarmed
                    named = verdicts[-1].suspects[0].change.name
                    firsts.append(named)
                    first += alarmed and named == right
                print(
                    f"  {name:18s} found {found}/{given.seeds}, right cause first"
                    f" {first}/{given.seeds} ({', '.join(sorted(set(firsts)))})",
                    flush=True,
                )
            logs = trials(sailed, SEA[vessel], 23 + given.seed, round(60 * given.hours))
            verdicts = watched(watch, settings, logs)
            begun = raised(verdicts)
            hours = len(verdicts) * config.window / 3600
            print(f"  clean: {len(begun)} alarms in {hours:.1f} h", flush=True)
            for k in begun:
                print(f"    after {k * config.window / 3600:.2f} h: {told(verdicts[k])}")


if __name__ == "__main__":
    main()

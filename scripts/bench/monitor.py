"""Does the monitor find planted changes of simulated vessels, and leave clean logs alone?

Each vessel is identified from clean trials in currents that the fit estimates. Then trials of the
changed vessel, five minutes a seed, go through the monitor, and hours of clean ones. With
--scatter the parameters of the vessels are scattered by about a fifth first. With --seeds 0 only
clean trials are watched. Of each alarm in these a line tells when it came and what scored highest.

    python scripts/bench/monitor.py [VESSEL...] [--seeds 10] [--hours 2] [--seed 0] [--scatter]
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import bench
import numpy as np
import yaml

from residnet.core.log import Log
from residnet.identification.fit import fit_models
from residnet.identification.fitter import FittedModel
from residnet.identification.monitoring import (
    ChangeDetector,
    MonitorConfig,
    MonitorVerdict,
    OnlineChangeDetector,
)
from residnet.identification.prepared import convert_to_motion_through_water, prepare_splits
from residnet.identification.settings import FitSettings
from residnet.manoeuvres.trials import simulate_trial_logs
from residnet.preprocessing.prepare import PreparedLog, prepare_log

PER_SEED = 5
"""Trials of 60 s that each seed sees."""
_FORCES = {"force_x": 10, "force_y": 10, "force_n": 10}
SEA: dict[str, dict[str, Any]] = {
    "wam_v_cal": _FORCES,
    "wam_v_vrx": _FORCES,
    "example_rudder_boat": {"wind": {"speed": "3 m/s", "direction": "220 deg", "gust": 0.5}},
}
Change = Callable[[Log], Log]


def trials(vessel: str, sea: dict[str, Any], seed: int, count: int) -> list[Log]:
    """Return logs of so many trials, a mixture of manoeuvres in random order."""
    third = max(count // 3, 3)
    drawn = [
        {"kind": "zigzag", "count": count - 2 * third + 3, "heading": ["10 deg", "20 deg"]},
        {"kind": "three_two_one_one", "count": third},
        {"kind": "acceleration_deceleration", "count": third},
    ]
    sea = {"current_each": [0.0, 0.3], **sea}
    config = bench.programme(vessel, seed, drawn, disturbance=sea)
    logs = simulate_trial_logs(config.draw_manoeuvres(), config)
    order = np.random.default_rng(seed).permutation(len(logs))[:count]
    return [logs[i] for i in order]


def identified(
    vessel: str, flown: str, seed: int
) -> tuple[FitSettings, FittedModel, list[PreparedLog]]:
    """Return a model of the clean vessel, and the logs that fitted it, over ground."""
    logs = trials(flown, SEA[vessel], seed, 40)
    settings = bench.settings(
        vessel,
        baseline={"kind": "regressors", "sets": ["fossen"], "ridge": 1e-6},
        refit={"baseline": {"horizon": 10.0, "every": 10.0, "iterations": 4}},
        current={"spread": 0.3},
        bands=None,
    )
    prepared = prepare_splits({"train": logs[8:], "validation": logs[:8]}, settings)
    found = fit_models(convert_to_motion_through_water(prepared, settings)[0], settings)
    return settings, found["baseline"], [*prepared["train"], *prepared["validation"]]


def changed_vessel(flown: str, change: Callable[[dict[str, Any]], None], folder: Path) -> str:
    """Write a vessel file with a change, and return its path."""
    shipped = bench.CONFIGS / "vessels" / f"{flown}.yaml"
    content = yaml.safe_load((shipped if shipped.is_file() else Path(flown)).read_text())
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


def scaled(name: str, factor: float, offset: float = 0.0) -> Change:
    """Return what changes one channel of a log."""

    def change(log: Log) -> Log:
        channels = dict(log.channels)
        channels[name] = factor * channels[name] + offset
        return log.replace(channels=channels)

    return change


def cases(vessel: str, flown: str, folder: Path) -> dict[str, tuple[str, Change, str]]:
    """Return the planted changes: vessel that is flown, what becomes of its logs, right cause."""
    same = scaled("u", 1.0)
    inputs = bench.SIGNALS[vessel]["inputs"]
    side = "n_stbd" if "n_stbd" in inputs else "n"
    out = {
        "mass +15 %": (changed_vessel(flown, heavier, folder), same, "mass"),
        "thrust -10 %": (flown, scaled(side, 0.9**-0.5), f"gain {side}"),
        "yaw damping -20 %": (changed_vessel(flown, yaw_damping, folder), same, "damping yaw"),
        "gyro +5 %": (flown, scaled("r", 1.05), "gyro scale"),
    }
    if "delta" in inputs:
        out["rudder 2 deg"] = (flown, scaled("delta", 1.0, -np.deg2rad(2)), "offset delta")
    return out


def watched(
    watch: ChangeDetector, settings: FitSettings, logs: Sequence[Log]
) -> list[MonitorVerdict]:
    """Return what the monitor says, window by window."""
    watcher = OnlineChangeDetector(watch)
    out = []
    for log in logs:
        watcher.start_new_log()
        known = prepare_log(log, "external", settings.signals.input_columns, settings.prepare)
        out += [
            watcher.update_with_sums(sums) for sums in watch.compute_sums(watch.make_windows(known))
        ]
    return out


def told(verdict: MonitorVerdict) -> str:
    """Return what scores highest, with its size."""
    top = max(verdict.hypotheses, key=lambda suspect: suspect.test_statistic)
    size = f"{top.estimated_size:+.3f} +- {top.standard_error:.3f}"
    return f"{top.change.name} {size} scores {top.test_statistic:.2f} of {verdict.threshold:.2f}"


def judge(vessel: str, sailed: str, seed: int, seeds: int, hours: float, folder: Path) -> None:
    """Print what is found of each planted change, and the alarms in clean logs."""
    settings, model, clean = identified(vessel, sailed, 100 + seed)
    config = MonitorConfig()
    watch = ChangeDetector.from_logs(model.spec, model.model, clean, config)
    print(f"{vessel}: threshold {watch.threshold:.2f}", flush=True)
    planted = cases(vessel, sailed, folder) if seeds else {}
    for name, (flown, change, right) in planted.items():
        logs = [change(log) for log in trials(flown, SEA[vessel], 7 + seed, PER_SEED * seeds)]
        alarmed = []
        firsts = []
        for k in range(seeds):
            verdicts = watched(watch, settings, logs[PER_SEED * k : PER_SEED * (k + 1)])
            alarmed.append(any(verdict.is_alarm for verdict in verdicts))
            firsts.append(verdicts[-1].hypotheses[0].change.name)
        first = sum(a and named == right for a, named in zip(alarmed, firsts, strict=True))
        print(
            f"  {name:18s} found {sum(alarmed)}/{seeds}, right cause first"
            f" {first}/{seeds} ({', '.join(sorted(set(firsts)))})",
            flush=True,
        )
    verdicts = watched(watch, settings, trials(sailed, SEA[vessel], 23 + seed, round(60 * hours)))
    alarms = [False, *(verdict.is_alarm for verdict in verdicts)]
    begun = [k for k in range(len(verdicts)) if alarms[k + 1] and not alarms[k]]
    hour = config.window / 3600
    print(f"  clean: {len(begun)} alarms in {len(verdicts) * hour:.1f} h", flush=True)
    for k in begun:
        print(f"    after {k * hour:.2f} h: {told(verdicts[k])}")


def main() -> None:
    """Print a table for each vessel."""
    given = bench.options(__doc__, vessels=tuple(SEA), seeds=10, hours=2.0, seed=0, scatter=False)
    with tempfile.TemporaryDirectory() as name:
        for vessel in given.vessels:
            sailed = vessel
            if given.scatter:
                sailed = bench.scattered(vessel, np.random.default_rng(given.seed), Path(name))
            judge(vessel, sailed, given.seed, given.seeds, given.hours, Path(name))


if __name__ == "__main__":
    main()

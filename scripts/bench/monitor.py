"""Evaluate the monitor: detection of changes of simulated vessels, and false alarms.

Each vessel is identified from clean trials in currents that the fit estimates. The monitor is then
applied to trials of the changed vessel, five minutes per seed, and to hours of clean trials. With
--scatter the parameters of the vessels are varied by about 20 %. With --seeds 0 only clean trials
are evaluated. A line for each false alarm has its time and the change with the highest score.

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

TRIALS_PER_SEED = 5
"""Number of trials of 60 s per seed."""
_FORCES = {"force_x": 10, "force_y": 10, "force_n": 10}
DISTURBANCES: dict[str, dict[str, Any]] = {
    "wam_v_cal": _FORCES,
    "wam_v_vrx": _FORCES,
    "example_rudder_boat": {"wind": {"speed": "3 m/s", "direction": "220 deg", "gust": 0.5}},
}
Change = Callable[[Log], Log]


def simulate_logs(vessel: str, sea: dict[str, Any], seed: int, n_trials: int) -> list[Log]:
    """Simulate a number of trials, a mixture of manoeuvres in random order."""
    n_other_kinds = max(n_trials // 3, 3)
    families = [
        {
            "kind": "zigzag",
            "count": n_trials - 2 * n_other_kinds + 3,
            "heading": ["10 deg", "20 deg"],
        },
        {"kind": "three_two_one_one", "count": n_other_kinds},
        {"kind": "acceleration_deceleration", "count": n_other_kinds},
    ]
    sea = {"current_each": [0.0, 0.3], **sea}
    config = bench.programme(vessel, seed, families, disturbance=sea)
    logs = simulate_trial_logs(config.draw_manoeuvres(), config)
    order = np.random.default_rng(seed).permutation(len(logs))[:n_trials]
    return [logs[i] for i in order]


def identify_model(
    vessel: str, simulated_vessel: str, seed: int
) -> tuple[FitSettings, FittedModel, list[PreparedLog]]:
    """Return a model of the unchanged vessel, and its training logs with velocities over ground."""
    logs = simulate_logs(simulated_vessel, DISTURBANCES[vessel], seed, 40)
    settings = bench.settings(
        vessel,
        baseline={"kind": "regressors", "sets": ["fossen"], "ridge": 1e-6},
        refit={"baseline": {"horizon": 10.0, "every": 10.0, "iterations": 4}},
        current={"spread": 0.3},
        bands=None,
    )
    prepared = prepare_splits({"train": logs[8:], "validation": logs[:8]}, settings)
    models = fit_models(convert_to_motion_through_water(prepared, settings)[0], settings)
    return settings, models["baseline"], [*prepared["train"], *prepared["validation"]]


def write_changed_vessel(
    vessel: str, change: Callable[[dict[str, Any]], None], folder: Path
) -> str:
    """Write a vessel file with a change, and return its path."""
    shipped = bench.CONFIGS / "vessels" / f"{vessel}.yaml"
    content = yaml.safe_load((shipped if shipped.is_file() else Path(vessel)).read_text())
    change(content)
    file = folder / f"{Path(vessel).stem}_{change.__name__}.yaml"
    file.write_text(yaml.safe_dump(content))
    return str(file)


def increase_mass(content: dict[str, Any]) -> None:
    """Add 15 % to mass and inertia."""
    for name in ("m", "I_z"):
        content["rigid_body"][name]["value"] *= 1.15


def reduce_yaw_damping(content: dict[str, Any]) -> None:
    """Reduce the damping in yaw by 20 %."""
    for term, entry in content["damping"]["N"].items():
        if term in ("r", "r|r|", "|u|r"):
            entry["value"] *= 0.8


def make_scaling(name: str, factor: float, offset: float = 0.0) -> Change:
    """Return a function that scales one channel of a log."""

    def change(log: Log) -> Log:
        channels = dict(log.channels)
        channels[name] = factor * channels[name] + offset
        return log.replace(channels=channels)

    return change


def list_changes(
    vessel: str, simulated_vessel: str, folder: Path
) -> dict[str, tuple[str, Change, str]]:
    """Return the changes by name: simulated vessel, change of its logs, true cause."""
    unchanged = make_scaling("u", 1.0)
    inputs = bench.SIGNALS[vessel]["inputs"]
    changed_input = "n_stbd" if "n_stbd" in inputs else "n"
    changes = {
        "mass +15 %": (
            write_changed_vessel(simulated_vessel, increase_mass, folder),
            unchanged,
            "mass",
        ),
        "thrust -10 %": (
            simulated_vessel,
            make_scaling(changed_input, 0.9**-0.5),
            f"gain {changed_input}",
        ),
        "yaw damping -20 %": (
            write_changed_vessel(simulated_vessel, reduce_yaw_damping, folder),
            unchanged,
            "damping yaw",
        ),
        "gyro +5 %": (simulated_vessel, make_scaling("r", 1.05), "gyro scale"),
    }
    if "delta" in inputs:
        changes["rudder 2 deg"] = (
            simulated_vessel,
            make_scaling("delta", 1.0, -np.deg2rad(2)),
            "offset delta",
        )
    return changes


def run_detector(
    detector: ChangeDetector, settings: FitSettings, logs: Sequence[Log]
) -> list[MonitorVerdict]:
    """Return the verdict of the monitor for each window."""
    online_detector = OnlineChangeDetector(detector)
    verdicts = []
    for log in logs:
        online_detector.start_new_log()
        prepared_log = prepare_log(
            log, "external", settings.signals.input_columns, settings.prepare
        )
        verdicts += [
            online_detector.update_with_sums(sums)
            for sums in detector.compute_sums(detector.make_windows(prepared_log))
        ]
    return verdicts


def describe_verdict(verdict: MonitorVerdict) -> str:
    """Return the change with the highest score, and its size."""
    main_hypothesis = max(verdict.hypotheses, key=lambda hypothesis: hypothesis.test_statistic)
    size = f"{main_hypothesis.estimated_size:+.3f} +- {main_hypothesis.standard_error:.3f}"
    score = f"{main_hypothesis.test_statistic:.2f} of {verdict.threshold:.2f}"
    return f"{main_hypothesis.change.name} {size} scores {score}"


def evaluate_vessel(
    vessel: str, simulated_vessel: str, seed: int, seeds: int, hours: float, folder: Path
) -> None:
    """Print the detections of each change, and the alarms in clean logs."""
    settings, model, clean_logs = identify_model(vessel, simulated_vessel, 100 + seed)
    config = MonitorConfig()
    detector = ChangeDetector.from_logs(model.spec, model.model, clean_logs, config)
    print(f"{vessel}: threshold {detector.threshold:.2f}", flush=True)
    changes = list_changes(vessel, simulated_vessel, folder) if seeds else {}
    for name, (changed_vessel_name, change, true_cause) in changes.items():
        logs = [
            change(log)
            for log in simulate_logs(
                changed_vessel_name, DISTURBANCES[vessel], 7 + seed, TRIALS_PER_SEED * seeds
            )
        ]
        has_alarm = []
        first_causes = []
        for k in range(seeds):
            verdicts = run_detector(
                detector, settings, logs[TRIALS_PER_SEED * k : TRIALS_PER_SEED * (k + 1)]
            )
            has_alarm.append(any(verdict.is_alarm for verdict in verdicts))
            first_causes.append(verdicts[-1].hypotheses[0].change.name)
        n_correct = sum(
            a and cause == true_cause for a, cause in zip(has_alarm, first_causes, strict=True)
        )
        print(
            f"  {name:18s} found {sum(has_alarm)}/{seeds}, right cause first"
            f" {n_correct}/{seeds} ({', '.join(sorted(set(first_causes)))})",
            flush=True,
        )
    verdicts = run_detector(
        detector,
        settings,
        simulate_logs(simulated_vessel, DISTURBANCES[vessel], 23 + seed, round(60 * hours)),
    )
    alarms = [False, *(verdict.is_alarm for verdict in verdicts)]
    alarm_windows = [k for k in range(len(verdicts)) if alarms[k + 1] and not alarms[k]]
    window_hours = config.window / 3600
    print(
        f"  clean: {len(alarm_windows)} alarms in {len(verdicts) * window_hours:.1f} h", flush=True
    )
    for k in alarm_windows:
        print(f"    after {k * window_hours:.2f} h: {describe_verdict(verdicts[k])}")


def main() -> None:
    """Print a table for each vessel."""
    options = bench.options(
        __doc__, vessels=tuple(DISTURBANCES), seeds=10, hours=2.0, seed=0, scatter=False
    )
    with tempfile.TemporaryDirectory() as folder:
        for vessel in options.vessels:
            simulated_vessel = vessel
            if options.scatter:
                simulated_vessel = bench.scattered(
                    vessel, np.random.default_rng(options.seed), Path(folder)
                )
            evaluate_vessel(
                vessel, simulated_vessel, options.seed, options.seeds, options.hours, Path(folder)
            )


if __name__ == "__main__":
    main()

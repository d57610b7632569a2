"""Evaluate prediction intervals: coverage by channel and kind, and interval scores.

For a finished run the intervals of a model are evaluated on its test logs. With `--cross`, all logs
of a config are divided into five folds: the intervals of each fold are from a fit to the other
folds. With `--kinds` a fold has all logs of a kind of manoeuvre, so that no interval was calibrated
on the kind for which it is evaluated. With `--alone`, models that the evaluated one does not need
are removed from these fits: networks take most of the time.

With `--draws`, simulated vessels are drawn: shipped ones in turn, with random parameters, a
mixture of manoeuvres, noise, random forces and currents. `--logs` of them calibrate the intervals
of three models; `--test` further ones of each kind are for the evaluation, with `--others` of kinds
that were not used for fit or calibration. Tables are means over draws and models. The differences
of coverage among single logs indicate the accuracy of the coverage.

    python scripts/bench/bands.py RUN [--model physics]
    python scripts/bench/bands.py --cross CONFIG [--model physics] [--alone] [--kinds] [-s K=V]
    python scripts/bench/bands.py --draws 12 [--seed 0] [--logs 40] [--test 25] [--others]
        [--calibrated 2] [--level 0.95] [--vessels wam_v_cal example_rudder_boat milliampere]
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import bench
import numpy as np

from residnet.core.config import load_config
from residnet.core.layout import PLANAR_LAYOUT
from residnet.core.log import Log
from residnet.evaluation.band import Band, interval_score, is_covered, largest_error_ratios
from residnet.evaluation.bands import RunErrors, calibrate_band, compute_run_errors
from residnet.identification.bands import assign_logs_to_folds
from residnet.identification.fit import fit_models
from residnet.identification.identified import SplitEvaluation, evaluate_splits, make_candidates
from residnet.identification.prepared import prepare_splits
from residnet.manoeuvres.trials import simulate_trial_logs
from residnet.runs.folder import RunFolder
from residnet.runs.model_store import RunModelStore
from residnet.tasks.fit.config import FitConfig
from residnet.tasks.fit.outcome import divergence_limit

BandedRun = tuple[RunErrors, Band]
RunsByModel = dict[tuple[str, str, int], list[BandedRun]]
"""Free runs with their prediction intervals, by protocol, model and draw."""
KINDS = (
    "zigzag", "three_two_one_one", "acceleration_deceleration", "random_steps", "turning_circle",
)  # fmt: skip
FAMILY_SETTINGS: dict[str, dict[str, Any]] = {
    "zigzag": {"heading": ["10 deg", "20 deg", "30 deg"], "steer": [0.3, 1.0]},
    "three_two_one_one": {"unit": ["2 s", "4 s"], "steer": [0.4, 1.0]},
    "acceleration_deceleration": {"high": [0.5, 1.0], "low": [0.0, 0.3]},
    "random_steps": {"band": [0.02, 0.2]},
    "turning_circle": {"steer": [0.3, 1.0]},
}
MAX_FORCE_STD = {
    "wam_v_cal": (20, 20, 20), "example_rudder_boat": (40, 40, 80), "milliampere": (40, 40, 60),
}  # fmt: skip
"""Largest standard deviations of the random forces on each vessel in N and N m."""
_COVERAGE_TOLERANCE = 0.02
"""Accepted difference of the mean coverage from its level."""


def add_runs(
    runs_by_model: RunsByModel, evaluation: SplitEvaluation, models: Sequence[str], draw: int = 0
) -> None:
    """Add the free runs of models that have prediction intervals."""
    for run in evaluation.free_runs:
        for name in models:
            if band := evaluation.bands_by_model[name].get(run.protocol):
                run_errors = compute_run_errors(run.windows, run.predictions[name], evaluation.logs)
                entries = runs_by_model.setdefault((run.protocol, name, draw), [])
                entries.extend((errors, band) for errors in run_errors)


def read_stored_run(folder: Path, model: str | None) -> RunsByModel:
    """Return the free runs of one model of a finished run over its test logs."""
    run = RunFolder(folder)
    config = load_config(folder / "resolved.yaml", [], FitConfig)
    store = RunModelStore(run)
    runs_by_model = RunsByModel()
    fitted_models = [store.load(name) for name in store.names()]
    logs = {"test": prepare_splits(config.load_logs(), config)["test"]}
    limit = divergence_limit(fitted_models[-1].spec, config)
    step = config.prepare.grid.step
    evaluation = evaluate_splits(
        make_candidates(fitted_models), logs, config.evaluation, step, limit
    )["test"]
    add_runs(runs_by_model, evaluation, [model or run.read_metrics().selected])
    return runs_by_model


def remove_other_models(config: FitConfig, model: str) -> list[str]:
    """Return overrides that remove all models of a config that one model does not need."""
    needed = {model, config.get_baseline_name(model) if model in config.heads else model}
    overrides = ["~ensembles"] if config.ensembles else []
    for key in ("heads", "base_of", "training", "baselines", "refit"):
        parts = getattr(config, key)
        unused = [name for name in parts if name not in needed]
        overrides += (
            [f"~{key}"] if len(unused) == len(parts) > 0 else [f"~{key}.{n}" for n in unused]
        )
    return overrides


def cross_validate(config: FitConfig, model: str, seed: int, by_kind: bool) -> RunsByModel:
    """Return free runs over all logs of a config, with intervals of fits to the other folds."""
    logs = [
        log for members in prepare_splits(config.load_logs(), config).values() for log in members
    ]
    kinds = [log.log.manoeuvre for log in logs]
    fold_of_log = (
        np.unique(kinds, return_inverse=True)[1]
        if by_kind
        else assign_logs_to_folds(kinds, 5, seed)
    )
    runs_by_model = RunsByModel()
    for test_fold in range(int(fold_of_log.max()) + 1):
        training_logs = [
            log for log, fold in zip(logs, fold_of_log, strict=True) if fold != test_fold
        ]
        # a fifth of the training logs is for selection and calibration, as validation logs are
        inner_folds = assign_logs_to_folds(
            [log.log.manoeuvre for log in training_logs], 5, seed + 1
        )
        parts = {
            "train": [
                log for log, fold in zip(training_logs, inner_folds, strict=True) if fold != 0
            ],
            "validation": [
                log for log, fold in zip(training_logs, inner_folds, strict=True) if fold == 0
            ],
        }
        test_logs = [log for log, fold in zip(logs, fold_of_log, strict=True) if fold == test_fold]
        add_runs(
            runs_by_model, fit_models(parts, config).evaluate({"test": test_logs})["test"], [model]
        )
        print(f"fold {test_fold + 1}: {len(test_logs)} logs", flush=True)
    return runs_by_model


def simulate_drawn_logs(
    vessel: str,
    random: np.random.Generator,
    n_logs: int,
    n_test_logs: int,
    uses_other_kinds: bool,
    n_calibrated_kinds: int = 2,
) -> dict[str, list[Log]]:
    """Simulate logs of a vessel with random parameters.

    Args:
        vessel: name of the vessel.
        random: random numbers.
        n_logs: number of logs for fit and calibration.
        n_test_logs: number of test logs of each kind of manoeuvre.
        uses_other_kinds: whether test logs are of kinds that are not used for fits.
        n_calibrated_kinds: number of kinds that are used for fits in this case.
    """
    # each kind has at least a tenth of the logs for calibration
    kinds = ["zigzag", *random.permutation(KINDS[1:4])[: int(random.integers(1, 4))]]
    if uses_other_kinds:
        kinds = [*kinds, *(kind for kind in KINDS[1:4] if kind not in kinds)][:n_calibrated_kinds]
    shares = 0.1 + random.dirichlet(np.full(len(kinds), 2.0)) * (1.0 - 0.1 * len(kinds))
    logs_per_kind = np.floor(shares * n_logs).astype(int)
    logs_per_kind[0] += n_logs - logs_per_kind.sum()
    counts = dict(zip(kinds, logs_per_kind.tolist(), strict=True))
    speed_noise = float(np.exp(random.uniform(np.log(0.005), np.log(0.05))))
    force_std = (random.uniform(0.1, 1.0) * np.array(MAX_FORCE_STD[vessel])).tolist()
    test_kinds = [kind for kind in KINDS if kind not in kinds] if uses_other_kinds else []
    families = [
        {"kind": kind, "count": counts.get(kind, 0) + n_test_logs, **FAMILY_SETTINGS[kind]}
        | ({} if kind == "acceleration_deceleration" else {"drive": [0.3, 1.0]})
        for kind in (*kinds, *test_kinds)
    ]
    with tempfile.TemporaryDirectory() as folder:
        config = bench.programme(
            bench.scattered(vessel, random, Path(folder)),
            int(random.integers(2**31)),
            families,
            noise={"u": speed_noise, "v": speed_noise, "r": f"{random.uniform(0.05, 0.5)} deg/s"},
            disturbance={
                **dict(zip(("force_x", "force_y", "force_n"), force_std, strict=True)),
                "current_each": [0.0, float(random.uniform(0.05, 0.3))],
            },
            identification=counts,
            validation={kind: max(count // 5, 1) for kind, count in counts.items()},
        )
        manoeuvres = config.draw_manoeuvres()
        logs_by_split: dict[str, list[Log]] = {}
        for log, split in zip(
            simulate_trial_logs(manoeuvres, config), config.assign_splits(manoeuvres), strict=True
        ):
            logs_by_split.setdefault("test" if log.manoeuvre in test_kinds else split, []).append(
                log
            )
    if test_kinds:
        logs_by_split["test"] = [
            log for log in logs_by_split["test"] if log.manoeuvre in test_kinds
        ]
    return logs_by_split


def evaluate_drawn_vessel(
    runs_by_model: RunsByModel, vessel: str, number: int, logs: dict[str, list[Log]], level: float
) -> None:
    """Fit models to the logs of a drawn vessel, and add their free runs over the test logs."""
    training_values = {
        c: np.concatenate([log[c] for log in logs["train"]]) for c in ("u", "v", "r")
    }
    settings = bench.settings(
        vessel,
        baseline={"kind": "regressors", "sets": ["linear"]},
        baselines={"hull": {"kind": "regressors", "sets": ["fossen"], "ridge": 1e-6}},
        refit={"hull": {"horizon": 10.0, "every": 10.0, "iterations": 4}},
        heads={"ridge": {"kind": "ridge"}},
        bands={"level": level},
        evaluation={
            "protocols": {
                "T30": {"kind": "windows", "length": 29.0},
                "manoeuvre": {"kind": "manoeuvre", "initial": 0.5},
            },
            "selection": "T30",
            "scales": {name: float(values.std()) for name, values in training_values.items()},
        },
    )
    prepared = prepare_splits(logs, settings)
    models = fit_models(prepared, settings)
    evaluation = models.evaluate({"test": prepared["test"]})["test"]
    add_runs(
        runs_by_model, evaluation, [name for name in models if name != "constant_velocity"], number
    )


def compute_coverage(runs: Sequence[BandedRun]) -> np.ndarray:
    """Return the coverage of each channel, their mean, and the share of covered runs [c + 2]."""
    widths = [run.half_widths(band) for run, band in runs]
    pairs = list(zip(runs, widths, strict=True))
    channel_shares = np.nanmean(
        np.concatenate([is_covered(run.error, width) for (run, _), width in pairs]), 0
    )
    max_ratios = np.stack(
        [largest_error_ratios([run.error], [width])[0] for (run, _), width in pairs]
    )
    max_allowed_ratios = np.stack([band.simultaneous_factor for _, band in runs])
    is_run_covered = np.where(np.isnan(max_ratios), np.nan, max_ratios <= max_allowed_ratios)
    return np.array([*channel_shares, np.nanmean(channel_shares), np.nanmean(is_run_covered)])


def compute_score(runs: Sequence[BandedRun], widths: Sequence[np.ndarray]) -> np.ndarray:
    """Return the mean interval score of each channel [c], in errors of `constant_velocity`."""
    level = runs[0][1].level
    unit = runs[0][1].score_unit
    pairs = zip(runs, widths, strict=True)
    scores = [interval_score(run.error, width, level) for (run, _), width in pairs]
    return np.asarray(np.nanmean(np.concatenate(scores), axis=0) / unit)


def compare_scores(runs: Sequence[BandedRun]) -> dict[str, np.ndarray]:
    """Return ratios of scores to those of simpler intervals: by channel, their mean, of means."""
    first_band = runs[0][1]
    hindsight_band = calibrate_band(
        [run for run, _ in runs], first_band.level, first_band.step, first_band.score_unit
    )
    band_scores = compute_score(runs, [run.half_widths(band) for run, band in runs])
    reference_widths = {
        "one width": [np.broadcast_to(band.constant_width, run.error.shape) for run, band in runs],
        "no distance": [band.half_widths(run.states, run.spread) for run, band in runs],
        "hindsight": [
            hindsight_band.interpolate(hindsight_band.unconditional_width, len(run))
            for run, _ in runs
        ],
    }
    ratios = {}
    for name, widths in reference_widths.items():
        reference_scores = compute_score(runs, widths)
        ratios[name] = np.array(
            [
                *(band_scores / reference_scores),
                (band_scores / reference_scores).mean(),
                band_scores.mean() / reference_scores.mean(),
            ]
        )
    return ratios


def print_tables(runs_by_model: RunsByModel) -> None:
    """Print coverage by protocol, kind and channel, and scores, as means over models and draws."""
    names = (*PLANAR_LAYOUT.band_channels, "mean", "whole")
    for protocol in dict.fromkeys(protocol for protocol, _, _ in runs_by_model):
        runs_of_models = [
            runs for (run_protocol, _, _), runs in runs_by_model.items() if run_protocol == protocol
        ]
        kinds = sorted({run.manoeuvre for runs in runs_of_models for run, _ in runs})
        print(f"\n{protocol:28s}{'runs':>6s}" + "".join(f"{name:>10s}" for name in names))
        for kind in ("all", *kinds):
            selected_runs = [
                [entry for entry in runs_of_model if kind in ("all", entry[0].manoeuvre)]
                for runs_of_model in runs_of_models
            ]
            mean_coverage = np.mean(
                [
                    compute_coverage(runs_of_model)
                    for runs_of_model in selected_runs
                    if runs_of_model
                ],
                axis=0,
            )
            cells = "".join(f"{cell:10.3f}" for cell in mean_coverage)
            print(f"{kind:28s}{sum(map(len, selected_runs)):6d}{cells}")
        runs_without_distance = [
            [(replace(run, distance=None), band) for run, band in runs_of_model]
            for runs_of_model in runs_of_models
        ]
        mean_coverage = np.mean(
            [compute_coverage(runs_of_model) for runs_of_model in runs_without_distance], axis=0
        )
        cells = "".join(f"{cell:10.3f}" for cell in mean_coverage)
        print(f"{'all, without the distance':28s}{sum(map(len, runs_without_distance)):6d}{cells}")
        scores = [compare_scores(runs) for runs in runs_of_models]
        for name in scores[0]:
            mean_ratio = np.mean([entry[name] for entry in scores], axis=0)
            cells = "".join(f"{cell:10.3f}" for cell in mean_ratio)
            print(f"score over that of {name:15s}{cells}")


def print_single_models(runs_by_model: RunsByModel, n_calibration_logs: int, level: float) -> None:
    """Print how single models fare, and how much so few logs let a mean coverage scatter."""
    overall = np.array([compute_coverage(runs)[-2] for runs in runs_by_model.values()])
    share_within = np.mean(np.abs(overall - level) <= _COVERAGE_TOLERANCE)
    print(
        f"\nmean coverage of single models within {_COVERAGE_TOLERANCE} of {level}:"
        f" {share_within:.2f} of {len(overall)}"
    )
    rows = []
    scatters = []
    for (protocol, model, number), runs in runs_by_model.items():
        for kind in ("all", *{run.manoeuvre for run, _ in runs}):
            selected_runs = [entry for entry in runs if kind in ("all", entry[0].manoeuvre)]
            rows.append(
                (
                    compute_coverage(selected_runs)[-2],
                    f"draw {number + 1}: {model}, {protocol}, {kind}",
                )
            )
        logs = {run.log for run, _ in runs}
        coverage_by_log = [
            compute_coverage([entry for entry in runs if entry[0].log == log])[-2] for log in logs
        ]
        scatters.append(
            np.std(coverage_by_log, ddof=1)
            * math.sqrt(1.0 / n_calibration_logs + 1.0 / len(coverage_by_log))
        )
    for share, text in sorted(rows)[:8]:
        print(f"  {share:.3f} {text}")
    expected_share = np.mean(
        [math.erf(_COVERAGE_TOLERANCE / entry / math.sqrt(2.0)) for entry in scatters]
    )
    print(
        "\nstandard deviation of the mean coverage:"
        f" {np.sqrt(np.square(scatters).mean()):.3f} (rms over models)"
        f" for {n_calibration_logs} calibration logs and these test logs: correct intervals have a"
        f" share of {expected_share:.2f} within {_COVERAGE_TOLERANCE} of {level}"
    )


def main() -> None:
    """Print the tables of a run, of the folds of a config, or of drawn vessels."""
    options = bench.options(
        __doc__, run=("runs/esso_osaka",), cross=None, model=None, alone=False, kinds=False, s=[],
        draws=0, seed=0, logs=40, test=25, others=False, calibrated=2,
        level=0.95, vessels=["wam_v_cal", "example_rudder_boat"],
    )  # fmt: skip
    if options.draws:
        runs_by_model = RunsByModel()
        for number in range(options.draws):
            start_time = time.process_time()
            random = np.random.default_rng([options.seed, number])
            vessel = options.vessels[number % len(options.vessels)]
            logs = simulate_drawn_logs(
                vessel, random, options.logs, options.test, options.others, options.calibrated
            )
            evaluate_drawn_vessel(runs_by_model, vessel, number, logs, options.level)
            seconds = time.process_time() - start_time
            print(f"draw {number + 1}: {vessel}, {seconds:.0f} s", flush=True)
    elif options.cross:
        model = options.model or "baseline"
        file = Path(options.cross)
        removed_models = (
            remove_other_models(load_config(file, options.s, FitConfig), model)
            if options.alone
            else []
        )
        config = load_config(file, [*options.s, *removed_models], FitConfig)
        runs_by_model = cross_validate(config, model, options.seed, options.kinds)
    else:
        runs_by_model = read_stored_run(Path(options.run[0]), options.model)
    print_tables(runs_by_model)
    if options.draws:
        print_single_models(runs_by_model, options.logs, options.level)


if __name__ == "__main__":
    main()

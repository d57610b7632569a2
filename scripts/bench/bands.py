"""How bands hold: coverage by channel and kind, and scores beside a band fitted in hindsight.

Of a finished run the bands of a model are judged on its test logs. With `--cross`, all logs of a
config are divided into five folds instead: each is judged with bands of a fit that has seen none of
it. With `--kinds` a fold is all logs of a kind of manoeuvre, so that no band was calibrated on the
kind that judges it. With `--alone`, models that the judged one does not stand on are left out of
these fits: networks take most of the time.

With `--draws`, simulated vessels are drawn: two shipped ones in turn, with scattered parameters, a
mixture of manoeuvres, noise, random forces and currents. `--logs` of them calibrate the bands of
three models; `--test` further ones of each kind judge them, with `--others` kinds that neither
fitted nor calibrated anything. Tables are means over draws and models. How much the coverage of
single logs differs tells how far a band may be off.

    python scripts/bench/bands.py RUN [--model physics]
    python scripts/bench/bands.py --cross CONFIG [--model physics] [--alone] [--kinds] [-s K=V]
    python scripts/bench/bands.py --draws 12 [--seed 0] [--logs 40] [--test 25] [--others]
        [--calibrated 2]
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

Judged = tuple[RunErrors, Band]
Found = dict[tuple[str, str, int], list[Judged]]
"""Judged free runs by protocol, model and draw."""
KINDS = (
    "zigzag", "three_two_one_one", "acceleration_deceleration", "random_steps", "turning_circle",
)  # fmt: skip
GIVEN: dict[str, dict[str, Any]] = {
    "zigzag": {"heading": ["10 deg", "20 deg", "30 deg"], "steer": [0.3, 1.0]},
    "three_two_one_one": {"unit": ["2 s", "4 s"], "steer": [0.4, 1.0]},
    "acceleration_deceleration": {"high": [0.5, 1.0], "low": [0.0, 0.3]},
    "random_steps": {"band": [0.02, 0.2]},
    "turning_circle": {"steer": [0.3, 1.0]},
}
PUSH = {"wam_v_cal": (20, 20, 20), "example_rudder_boat": (40, 40, 80)}
"""Largest standard deviations of the random forces on each vessel in N and N m."""
_ASKED = 0.02
"""Largest distance of the mean coverage from 0.9 that is asked for."""


def add(found: Found, judged: SplitEvaluation, models: Sequence[str], draw: int = 0) -> None:
    """Add the free runs of models, where they have bands."""
    for run in judged.free_runs:
        for name in models:
            if band := judged.bands_by_model[name].get(run.protocol):
                own = compute_run_errors(run.windows, run.predictions[name], judged.logs)
                place = found.setdefault((run.protocol, name, draw), [])
                place.extend((one, band) for one in own)


def stored(folder: Path, model: str | None) -> Found:
    """Return the free runs of one model of a finished run over its test logs."""
    run = RunFolder(folder)
    config = load_config(folder / "resolved.yaml", [], FitConfig)
    store = RunModelStore(run)
    found = Found()
    fitted = [store.load(name) for name in store.names()]
    logs = {"test": prepare_splits(config.load_logs(), config)["test"]}
    limit = divergence_limit(fitted[-1].spec, config)
    step = config.prepare.grid.step
    judged = evaluate_splits(make_candidates(fitted), logs, config.evaluation, step, limit)["test"]
    add(found, judged, [model or run.read_metrics().selected])
    return found


def alone(config: FitConfig, model: str) -> list[str]:
    """Return overrides that leave out all models of a config that one does not stand on."""
    needed = {model, config.get_baseline_name(model) if model in config.heads else model}
    out = ["~ensembles"] if config.ensembles else []
    for key in ("heads", "base_of", "training", "baselines", "refit"):
        given = getattr(config, key)
        unused = [name for name in given if name not in needed]
        out += [f"~{key}"] if len(unused) == len(given) > 0 else [f"~{key}.{n}" for n in unused]
    return out


def crossed(config: FitConfig, model: str, seed: int, by_kind: bool) -> Found:
    """Return free runs over all logs of a config with bands of fits that have not seen them."""
    logs = [
        log for members in prepare_splits(config.load_logs(), config).values() for log in members
    ]
    kinds = [log.log.manoeuvre for log in logs]
    number = (
        np.unique(kinds, return_inverse=True)[1]
        if by_kind
        else assign_logs_to_folds(kinds, 5, seed)
    )
    found = Found()
    for k in range(int(number.max()) + 1):
        others = [log for log, own in zip(logs, number, strict=True) if own != k]
        # every fifth of the others chooses and calibrates, as validation logs do
        inner = assign_logs_to_folds([log.log.manoeuvre for log in others], 5, seed + 1)
        parts = {
            "train": [log for log, own in zip(others, inner, strict=True) if own != 0],
            "validation": [log for log, own in zip(others, inner, strict=True) if own == 0],
        }
        held = [log for log, own in zip(logs, number, strict=True) if own == k]
        add(found, fit_models(parts, config).evaluate({"test": held})["test"], [model])
        print(f"fold {k + 1}: {len(held)} logs", flush=True)
    return found


def trials(
    vessel: str,
    random: np.random.Generator,
    logs: int,
    test: int,
    others: bool,
    calibrated: int = 2,
) -> dict[str, list[Log]]:
    """Return logs of a scattered vessel: so many for fits, and so many of each kind to judge.

    Of `others`, kinds judge that no fit has: all but the first `calibrated` ones.
    """
    # at least a tenth of the calibration's logs is of each kind that there is
    kinds = ["zigzag", *random.permutation(KINDS[1:4])[: int(random.integers(1, 4))]]
    if others:
        kinds = [*kinds, *(kind for kind in KINDS[1:4] if kind not in kinds)][:calibrated]
    shares = 0.1 + random.dirichlet(np.full(len(kinds), 2.0)) * (1.0 - 0.1 * len(kinds))
    each = np.floor(shares * logs).astype(int)
    each[0] += logs - each.sum()
    counts = dict(zip(kinds, each.tolist(), strict=True))
    speed = float(np.exp(random.uniform(np.log(0.005), np.log(0.05))))
    push = (random.uniform(0.1, 1.0) * np.array(PUSH[vessel])).tolist()
    judges = [kind for kind in KINDS if kind not in kinds] if others else []
    drawn = [
        {"kind": kind, "count": counts.get(kind, 0) + test, **GIVEN[kind]}
        | ({} if kind == "acceleration_deceleration" else {"drive": [0.3, 1.0]})
        for kind in (*kinds, *judges)
    ]
    with tempfile.TemporaryDirectory() as folder:
        config = bench.programme(
            bench.scattered(vessel, random, Path(folder)),
            int(random.integers(2**31)),
            drawn,
            noise={"u": speed, "v": speed, "r": f"{random.uniform(0.05, 0.5)} deg/s"},
            disturbance={
                **dict(zip(("force_x", "force_y", "force_n"), push, strict=True)),
                "current_each": [0.0, float(random.uniform(0.05, 0.3))],
            },
            identification=counts,
            validation={kind: max(count // 5, 1) for kind, count in counts.items()},
        )
        manoeuvres = config.draw_manoeuvres()
        out: dict[str, list[Log]] = {}
        for log, split in zip(
            simulate_trial_logs(manoeuvres, config), config.assign_splits(manoeuvres), strict=True
        ):
            out.setdefault("test" if log.manoeuvre in judges else split, []).append(log)
    return out


def drawn(found: Found, vessel: str, number: int, logs: dict[str, list[Log]]) -> None:
    """Fit the logs of a drawn vessel, and add the free runs of all models over its test logs."""
    joined = {c: np.concatenate([log[c] for log in logs["train"]]) for c in ("u", "v", "r")}
    settings = bench.settings(
        vessel,
        baseline={"kind": "regressors", "sets": ["linear"]},
        baselines={"hull": {"kind": "regressors", "sets": ["fossen"], "ridge": 1e-6}},
        refit={"hull": {"horizon": 10.0, "every": 10.0, "iterations": 4}},
        heads={"ridge": {"kind": "ridge"}},
        evaluation={
            "protocols": {
                "T30": {"kind": "windows", "length": 29.0},
                "manoeuvre": {"kind": "manoeuvre", "initial": 0.5},
            },
            "selection": "T30",
            "scales": {name: float(values.std()) for name, values in joined.items()},
        },
    )
    prepared = prepare_splits(logs, settings)
    models = fit_models(prepared, settings)
    judged = models.evaluate({"test": prepared["test"]})["test"]
    add(found, judged, [name for name in models if name != "constant_velocity"], number)


def coverage(judged: Sequence[Judged]) -> np.ndarray:
    """Return the shares held of each channel, their mean, and that of whole runs [c + 2]."""
    widths = [run.half_widths(band) for run, band in judged]
    pairs = list(zip(judged, widths, strict=True))
    share = np.nanmean(
        np.concatenate([is_covered(run.error, width) for (run, _), width in pairs]), 0
    )
    largest = np.stack([largest_error_ratios([run.error], [width])[0] for (run, _), width in pairs])
    allowed = np.stack([band.simultaneous_factor for _, band in judged])
    whole = np.where(np.isnan(largest), np.nan, largest <= allowed)
    return np.array([*share, np.nanmean(share), np.nanmean(whole)])


def score(judged: Sequence[Judged], widths: Sequence[np.ndarray]) -> np.ndarray:
    """Return the mean interval score of each channel [c], in errors of `constant_velocity`."""
    level = judged[0][1].level
    unit = judged[0][1].score_unit
    pairs = zip(judged, widths, strict=True)
    each = [interval_score(run.error, width, level) for (run, _), width in pairs]
    return np.asarray(np.nanmean(np.concatenate(each), axis=0) / unit)


def compared(judged: Sequence[Judged]) -> dict[str, np.ndarray]:
    """Return scores over those of simpler bands: by channel, the mean of these, of mean scores."""
    first = judged[0][1]
    after = calibrate_band([run for run, _ in judged], first.level, first.step, first.score_unit)
    own = score(judged, [run.half_widths(band) for run, band in judged])
    peers = {
        "one width": [
            np.broadcast_to(band.constant_width, run.error.shape) for run, band in judged
        ],
        "no distance": [band.half_widths(run.states, run.spread) for run, band in judged],
        "hindsight": [after.interpolate(after.unconditional_width, len(run)) for run, _ in judged],
    }
    out = {}
    for name, widths in peers.items():
        other = score(judged, widths)
        out[name] = np.array([*(own / other), (own / other).mean(), own.mean() / other.mean()])
    return out


def show(found: Found) -> None:
    """Print coverage by protocol, kind and channel, and scores, as means over models and draws."""
    names = (*PLANAR_LAYOUT.band_channels, "mean", "whole")
    for protocol in dict.fromkeys(protocol for protocol, _, _ in found):
        each = [judged for (under, _, _), judged in found.items() if under == protocol]
        kinds = sorted({run.manoeuvre for judged in each for run, _ in judged})
        print(f"\n{protocol:28s}{'runs':>6s}" + "".join(f"{name:>10s}" for name in names))
        for kind in ("all", *kinds):
            chosen = [[one for one in of if kind in ("all", one[0].manoeuvre)] for of in each]
            held = np.mean([coverage(of) for of in chosen if of], axis=0)
            cells = "".join(f"{cell:10.3f}" for cell in held)
            print(f"{kind:28s}{sum(map(len, chosen)):6d}{cells}")
        near = [[(replace(run, distance=None), band) for run, band in of] for of in each]
        held = np.mean([coverage(of) for of in near], axis=0)
        cells = "".join(f"{cell:10.3f}" for cell in held)
        print(f"{'all, without the distance':28s}{sum(map(len, near)):6d}{cells}")
        scores = [compared(judged) for judged in each]
        for name in scores[0]:
            shown = np.mean([one[name] for one in scores], axis=0)
            cells = "".join(f"{cell:10.3f}" for cell in shown)
            print(f"score over that of {name:15s}{cells}")


def singles(found: Found, calibrate: int) -> None:
    """Print how single models fare, and how much so few logs let a mean coverage scatter."""
    overall = np.array([coverage(judged)[-2] for judged in found.values()])
    within = np.mean(np.abs(overall - 0.9) <= _ASKED)
    print(f"\nmean coverage of single models within .88 and .92: {within:.2f} of {len(overall)}")
    rows = []
    apart = []
    for (protocol, model, number), judged in found.items():
        for kind in ("all", *{run.manoeuvre for run, _ in judged}):
            of = [one for one in judged if kind in ("all", one[0].manoeuvre)]
            rows.append((coverage(of)[-2], f"draw {number + 1}: {model}, {protocol}, {kind}"))
        logs = {run.log for run, _ in judged}
        held = [coverage([one for one in judged if one[0].log == log])[-2] for log in logs]
        apart.append(np.std(held, ddof=1) * math.sqrt(1.0 / calibrate + 1.0 / len(held)))
    for share, text in sorted(rows)[:8]:
        print(f"  {share:.3f} {text}")
    allowed = np.mean([math.erf(_ASKED / one / math.sqrt(2.0)) for one in apart])
    print(
        f"\nmean coverage scatters by {np.sqrt(np.square(apart).mean()):.3f} (rms over models)"
        f" where {calibrate} logs calibrate and these judge, as single logs differ: a share of"
        f" {allowed:.2f} within {_ASKED} of 0.9 is what bands without a fault have"
    )


def main() -> None:
    """Print the tables of a run, of a config's folds, or of drawn vessels."""
    given = bench.options(
        __doc__, run=("runs/esso_osaka",), cross=None, model=None, alone=False, kinds=False, s=[],
        draws=0, seed=0, logs=40, test=25, others=False, calibrated=2,
    )  # fmt: skip
    if given.draws:
        found = Found()
        for number in range(given.draws):
            started = time.process_time()
            random = np.random.default_rng([given.seed, number])
            vessel = list(PUSH)[number % len(PUSH)]
            logs = trials(vessel, random, given.logs, given.test, given.others, given.calibrated)
            drawn(found, vessel, number, logs)
            took = time.process_time() - started
            print(f"draw {number + 1}: {vessel}, {took:.0f} s", flush=True)
    elif given.cross:
        model = given.model or "baseline"
        file = Path(given.cross)
        left_out = alone(load_config(file, given.s, FitConfig), model) if given.alone else []
        config = load_config(file, [*given.s, *left_out], FitConfig)
        found = crossed(config, model, given.seed, given.kinds)
    else:
        found = stored(Path(given.run[0]), given.model)
    show(found)
    if given.draws:
        singles(found, given.logs)


if __name__ == "__main__":
    main()

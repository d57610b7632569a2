"""Do the trials that `residnet plan-trial` picks narrow intervals more than trials at random?

A simulated vessel with scattered parameters sails a few zigzags, and a model is refitted to them.
Three trials are planned; they and all other candidates are then sailed by the vessel, with noise
and random forces. The intervals are those of velocities over turning circles and zigzags of a
booklet, by the covariance that a refit with the new trials ends with: after a whole refit for the
planned trials, and at the first refit's parameters for three at random.

    python scripts/bench/plan_trials.py [--draws 4] [--random 50] [--seed 0]
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import bench
import numpy as np
import torch
from torch import Tensor

from residnet.core.errors import ResidnetError
from residnet.identification.fit import fit_models
from residnet.identification.fitter import FittedModel
from residnet.identification.planning import (
    PredictionGoal,
    TrialLimits,
    compute_expected_uncertainty,
    plan_trials,
    propose_manoeuvres,
    sensitivity_information,
)
from residnet.identification.prepared import compute_velocity_limits, prepare_splits
from residnet.identification.settings import FitSettings
from residnet.manoeuvres.input_shares import InputShare
from residnet.manoeuvres.trials import simulate_trial_logs
from residnet.physics.vessel import load_vessel
from residnet.preprocessing.prepare import PreparedLog
from residnet.preprocessing.samples import make_samples
from residnet.preprocessing.windows import WindowStore
from residnet.training.left_out import RefitUncertainty, estimate_refit_covariance

_HULL = ("u", "v", "r", "u|u|", "r|r|", "u v", "u r", "v r")
TERMS = {
    "wam_v_cal": (*_HULL, "tau_x", "tau_n"),
    "example_rudder_boat": (*_HULL, "n|n|", "|n| u", "u|u| delta"),
}
COMMANDS = {"n_port": "cmd_port", "n_stbd": "cmd_stbd", "n": "cmd_n", "delta": "cmd_delta"}
STEP = 0.1
SECONDS = 60.0
PICKED = 3
BOOKLET = (
    "turn_starboard_drive_100",
    "turn_port_drive_100",
    "zigzag_10_steer_50_drive_100",
    "zigzag_20_steer_100_drive_100",
)
"""Candidates that stand for the manoeuvres of a booklet."""


def shares_of(vessel: str, flown: str) -> dict[str, InputShare]:
    """Return how a vessel's commands follow drive and steer, as its booklet would say."""
    plant = load_vessel(flown).build()
    one = torch.ones(1, dtype=torch.float64)
    none = torch.zeros(1, dtype=torch.float64)
    drive = plant.commands_for_demand(one, none)[0].tolist()
    steer = plant.commands_for_demand(none, one)[0].tolist()
    # a plant has an order of its own, such as the rudder before the propeller
    found = dict(zip(plant.input_names, zip(drive, steer, strict=True), strict=False))
    out = {}
    for name in bench.SIGNALS[vessel]["inputs"]:
        d, s = found[COMMANDS[name]]
        out[name] = InputShare(drive=d, steer=s, limit=max(abs(d), abs(s)))
    return out


def left(
    fitted: FittedModel, settings: FitSettings, logs: Sequence[PreparedLog]
) -> RefitUncertainty:
    """Return what a refit of this model with such logs leaves open."""
    return estimate_refit_covariance(
        fitted.model.double(),
        make_samples(logs, settings.signals.build()),
        WindowStore.from_logs(logs, torch.float64),
        settings.refit["baseline"],
        torch.from_numpy(settings.evaluation.scales.to_array()),
        fitted.notes["refit"].get("at_rest", ()),
    )


def drawn(vessel: str, seed: int, times: int) -> tuple[float, float, np.ndarray]:
    """Return predicted and achieved shrinkage of the planned trials, and those of random ones."""
    random = np.random.default_rng([seed, 5])
    settings = bench.settings(
        vessel,
        baseline={"kind": "regressors", "terms": TERMS[vessel]},
        refit={"baseline": {"horizon": 10.0, "every": 10.0, "prior": 0.0}},
        bands=None,
    )
    scales = settings.evaluation.scales.array()
    limits = TrialLimits(time=SECONDS, count=PICKED)
    with tempfile.TemporaryDirectory() as folder:
        programme = bench.programme(
            bench.scattered(vessel, random, Path(folder)),
            seed,
            [{"kind": "zigzag", "count": 7, "heading": ["10 deg"], "drive": [0.3, 0.7]}],
            disturbance={"force_x": 10, "force_y": 10, "force_n": 10},
        )
        first = simulate_trial_logs(programme.draw_manoeuvres(), programme)
        others = sorted(propose_manoeuvres(limits), key=lambda one: one.kind)
        later = simulate_trial_logs(others, programme.model_copy(update={"seed": seed + 1}))
        shares = shares_of(vessel, programme.vessel)
    split = {"train": first[:6], "validation": first[6:], "later": later}
    prepared = prepare_splits(split, settings)
    fitted = fit_models(prepared, settings)["baseline"]
    open_ = left(fitted, settings, prepared["train"])
    low = np.array(fitted.spec.low)
    high = np.array(fitted.spec.high)
    most = 10.0 * settings.evaluation.divergence
    wide = compute_velocity_limits(low, high, most, fitted.spec.signals.dof)
    refit = settings.refit["baseline"]
    aim = PredictionGoal([one for one in others if one.name.startswith(BOOKLET)], SECONDS, {})
    found = plan_trials(fitted, open_, refit, scales, shares, wide, limits, aim)
    runs = [
        (torch.from_numpy(log.y), torch.from_numpy(log.w[:-1]))
        for log, one in zip(prepared["later"], others, strict=True)
        if one.name.startswith(BOOKLET)
    ]
    steps = round(refit.horizon / STEP)
    # squared sensitivities [P, P] of velocities over the booklet's manoeuvres
    goal = sensitivity_information(
        fitted.model.double(), runs, steps, torch.from_numpy(scales)
    ).sum(dim=0)
    before = compute_expected_uncertainty(open_.covariance, goal)

    def shrinks(covariance: Tensor) -> float:
        return 1.0 - compute_expected_uncertainty(covariance, goal) / before

    names = [one.name for one in others]
    picked = [names.index(trial.simulated_run.manoeuvre.name) for trial in found.selected_trials]
    chosen = [*prepared["train"], *(prepared["later"][i] for i in picked)]
    again = fit_models({**prepared, "train": chosen}, settings)["baseline"]
    assert again.covariance is not None
    total = sum((trial.information for trial in found.selected_trials), torch.zeros_like(goal))
    eye = torch.eye(len(goal), dtype=goal.dtype)
    predicted = shrinks(open_.covariance @ torch.linalg.inv(eye + total @ open_.covariance))
    at_random = []
    for _ in range(times):
        some = random.choice(len(others), PICKED, replace=False)
        logs = [*prepared["train"], *(prepared["later"][i] for i in some)]
        at_random.append(shrinks(left(fitted, settings, logs).covariance))
    return predicted, shrinks(again.covariance), np.array(at_random)


def main() -> None:
    """Run the draws, and print a line for each."""
    given = bench.options(__doc__, draws=4, random=50, seed=0)
    for number in range(given.draws):
        started = time.process_time()
        vessel = list(TERMS)[number % len(TERMS)]
        try:
            predicted, achieved, at_random = drawn(vessel, 100 * given.seed + number, given.random)
        except ResidnetError as error:
            print(f"not counted: {vessel}: {error}", flush=True)
            continue
        middle = float(np.median(at_random))
        print(
            f"{vessel}: planned {achieved:.3f}, predicted {predicted:.3f}"
            f" ({100 * (predicted / achieved - 1):+.0f} %), median of {given.random} at random"
            f" {middle:.3f}, ratio {achieved / middle:.2f}; {time.process_time() - started:.0f} s",
            flush=True,
        )


if __name__ == "__main__":
    main()

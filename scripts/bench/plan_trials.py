"""Compare trials selected by `residnet plan-trial` with random ones by the reduced uncertainty.

A model is refitted to a few zigzags of a simulated vessel with random parameters. Three trials are
planned; they and all other candidates are simulated with noise and random forces. The uncertainty
is that of velocities in turning circles and zigzags of a booklet, from the covariance of a refit
with the new trials: a complete refit for the planned trials, and the parameters of the first refit
for three random ones.

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
N_SELECTED = 3
BOOKLET = (
    "turn_starboard_drive_100",
    "turn_port_drive_100",
    "zigzag_10_steer_50_drive_100",
    "zigzag_20_steer_100_drive_100",
)
"""Candidates that represent the manoeuvres of a booklet."""


def compute_input_shares(vessel: str, simulated_vessel: str) -> dict[str, InputShare]:
    """Return the shares of drive and steer in the commands of a vessel, as in its booklet."""
    plant = load_vessel(simulated_vessel).build()
    unit = torch.ones(1, dtype=torch.float64)
    zero = torch.zeros(1, dtype=torch.float64)
    drive = plant.commands_for_demand(unit, zero)[0].tolist()
    steer = plant.commands_for_demand(zero, unit)[0].tolist()
    # the order of the inputs of a plant differs, such as the rudder before the propeller
    demand_by_command = dict(zip(plant.input_names, zip(drive, steer, strict=True), strict=False))
    shares = {}
    for name in bench.SIGNALS[vessel]["inputs"]:
        drive_share, steer_share = demand_by_command[COMMANDS[name]]
        shares[name] = InputShare(
            drive=drive_share, steer=steer_share, limit=max(abs(drive_share), abs(steer_share))
        )
    return shares


def estimate_uncertainty(
    fitted_model: FittedModel, settings: FitSettings, logs: Sequence[PreparedLog]
) -> RefitUncertainty:
    """Return the uncertainty of the parameters after a refit of this model with some logs."""
    return estimate_refit_covariance(
        fitted_model.model.double(),
        make_samples(logs, settings.signals.build()),
        WindowStore.from_logs(logs, torch.float64),
        settings.refit["baseline"],
        torch.from_numpy(settings.evaluation.scales.to_array()),
        fitted_model.notes["refit"].get("at_rest", ()),
    )


def evaluate_draw(vessel: str, seed: int, n_random: int) -> tuple[float, float, np.ndarray]:
    """Return predicted and achieved reduction by the planned trials, and those by random ones."""
    random = np.random.default_rng([seed, 5])
    settings = bench.settings(
        vessel,
        baseline={"kind": "regressors", "terms": TERMS[vessel]},
        refit={"baseline": {"horizon": 10.0, "every": 10.0, "prior": 0.0}},
        bands=None,
    )
    scales = settings.evaluation.scales.to_array()
    limits = TrialLimits(time=SECONDS, count=N_SELECTED)
    with tempfile.TemporaryDirectory() as folder:
        programme = bench.programme(
            bench.scattered(vessel, random, Path(folder)),
            seed,
            [{"kind": "zigzag", "count": 7, "heading": ["10 deg"], "drive": [0.3, 0.7]}],
            disturbance={"force_x": 10, "force_y": 10, "force_n": 10},
        )
        initial_logs = simulate_trial_logs(programme.draw_manoeuvres(), programme)
        candidates = sorted(propose_manoeuvres(limits), key=lambda manoeuvre: manoeuvre.kind)
        candidate_logs = simulate_trial_logs(
            candidates, programme.model_copy(update={"seed": seed + 1})
        )
        shares = compute_input_shares(vessel, programme.vessel)
    split = {"train": initial_logs[:6], "validation": initial_logs[6:], "later": candidate_logs}
    prepared = prepare_splits(split, settings)
    fitted_model = fit_models(prepared, settings)["baseline"]
    uncertainty = estimate_uncertainty(fitted_model, settings, prepared["train"])
    lower = np.array(fitted_model.spec.low)
    upper = np.array(fitted_model.spec.high)
    max_ratio = 10.0 * settings.evaluation.divergence
    velocity_limits = compute_velocity_limits(
        lower, upper, max_ratio, fitted_model.spec.signals.dof
    )
    refit = settings.refit["baseline"]
    prediction_goal = PredictionGoal(
        [manoeuvre for manoeuvre in candidates if manoeuvre.name.startswith(BOOKLET)], SECONDS, {}
    )
    trial_plan = plan_trials(
        fitted_model, uncertainty, refit, scales, shares, velocity_limits, limits, prediction_goal
    )
    runs = [
        (torch.from_numpy(log.y), torch.from_numpy(log.w[:-1]))
        for log, manoeuvre in zip(prepared["later"], candidates, strict=True)
        if manoeuvre.name.startswith(BOOKLET)
    ]
    steps = round(refit.horizon / STEP)
    # squared sensitivities [P, P] of velocities over the booklet's manoeuvres
    goal_weights = sensitivity_information(
        fitted_model.model.double(), runs, steps, torch.from_numpy(scales)
    ).sum(dim=0)
    initial_uncertainty = compute_expected_uncertainty(uncertainty.covariance, goal_weights)

    def compute_reduction(covariance: Tensor) -> float:
        return 1.0 - compute_expected_uncertainty(covariance, goal_weights) / initial_uncertainty

    names = [manoeuvre.name for manoeuvre in candidates]
    selected_indices = [
        names.index(trial.simulated_run.manoeuvre.name) for trial in trial_plan.selected_trials
    ]
    extended_logs = [*prepared["train"], *(prepared["later"][i] for i in selected_indices)]
    refitted_model = fit_models({**prepared, "train": extended_logs}, settings)["baseline"]
    assert refitted_model.covariance is not None
    total = sum(
        (trial.information for trial in trial_plan.selected_trials), torch.zeros_like(goal_weights)
    )
    eye = torch.eye(len(goal_weights), dtype=goal_weights.dtype)
    predicted = compute_reduction(
        uncertainty.covariance @ torch.linalg.inv(eye + total @ uncertainty.covariance)
    )
    random_reductions = []
    for _ in range(n_random):
        random_indices = random.choice(len(candidates), N_SELECTED, replace=False)
        logs = [*prepared["train"], *(prepared["later"][i] for i in random_indices)]
        random_reductions.append(
            compute_reduction(estimate_uncertainty(fitted_model, settings, logs).covariance)
        )
    return predicted, compute_reduction(refitted_model.covariance), np.array(random_reductions)


def main() -> None:
    """Evaluate the draws, and print a line for each."""
    options = bench.options(__doc__, draws=4, random=50, seed=0)
    for number in range(options.draws):
        start_time = time.process_time()
        vessel = list(TERMS)[number % len(TERMS)]
        try:
            predicted, achieved, random_reductions = evaluate_draw(
                vessel, 100 * options.seed + number, options.random
            )
        except ResidnetError as error:
            print(f"not counted: {vessel}: {error}", flush=True)
            continue
        median_reduction = float(np.median(random_reductions))
        print(
            f"{vessel}: planned {achieved:.3f}, predicted {predicted:.3f}"
            f" ({100 * (predicted / achieved - 1):+.0f} %), median of {options.random} at random"
            f" {median_reduction:.3f}, ratio {achieved / median_reduction:.2f};"
            f" {time.process_time() - start_time:.0f} s",
            flush=True,
        )


if __name__ == "__main__":
    main()

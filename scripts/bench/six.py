"""Evaluate the accuracy of refitted coefficients of underwater vehicles.

The shipped configs `remus_100` and `bluerov2_heavy` draw ten minutes of noisy trials; their `hull`
is fitted and refitted as `residnet run` does. True coefficients are those that give the plant's own
accelerations on its own motion without noise. A coefficient counts as determined by the trials if
the standard deviation of its errors over all draws is at most 2.5 % of the true value: without a
bias its error then exceeds 5 % in at most one of twenty draws.

    python scripts/bench/six.py [--vessels remus_100 bluerov2_heavy] [--seeds 10] [-s KEY=VALUE]
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import bench
import torch

from residnet.baselines.regressors import RegressorBaseline
from residnet.core.config import load_config
from residnet.core.log import Log
from residnet.identification.fitter import FitStore, Fitter
from residnet.identification.prepared import prepare_splits
from residnet.manoeuvres.trials import ManoeuvreRun, build_plant, simulate_trials
from residnet.manoeuvres.trials_config import SimulatedTrials
from residnet.tasks.fit.config import FitConfig

_MAX_DETERMINED_STD = 2.5
_ACCURACY = 5.0
_NEGLIGIBLE = 1e-9


def compute_true_coefficients(
    flights: Sequence[ManoeuvreRun], config: FitConfig, baseline: RegressorBaseline
) -> torch.Tensor:
    """Return the true coefficients [n, J]."""
    assert isinstance(config.data, SimulatedTrials)
    signals = config.signals
    plant = build_plant(config.data.vessel, config.data.disturbance)
    true_logs = [flight.true_log for flight in flights]
    columns = [list(plant.state_names), list(plant.input_names[: plant.n_commands])]
    x, w = (
        torch.cat([torch.from_numpy(log.stack(tuple(names))) for log in true_logs])
        for names in columns
    )
    axes = baseline.axis_names
    states = torch.cat([torch.from_numpy(log.stack(("x", "y", "psi", *axes))) for log in true_logs])
    inputs = torch.cat([torch.from_numpy(log.stack(signals.input_columns)) for log in true_logs])
    built_signals = signals.build()
    with torch.no_grad():
        rates = plant.derivative(x, w)
        phi = baseline.library(built_signals(states, built_signals.prepare(inputs)))
    theta = torch.zeros_like(baseline.theta)
    for axis, name in enumerate(axes):
        term_columns = baseline.term_columns(axis)
        target = rates[:, plant.state_names.index(name)]
        if term_columns:
            solution = torch.linalg.lstsq(
                phi[:, term_columns], target[:, None], driver="gelsd"
            ).solution
            theta[axis, term_columns] = solution[:, 0]
    return theta


def fit_draw(vessel: str, seed: int, overrides: Sequence[str]) -> tuple[list[str], torch.Tensor]:
    """Return the names of the coefficients; refitted and true value of each, [K, 2]."""
    all_overrides = [f"data.seed={seed}", "heads={}", "base_of={}", "training={}", *overrides]
    config = load_config(bench.CONFIGS / f"{vessel}.yaml", all_overrides, FitConfig)
    assert isinstance(config.data, SimulatedTrials)
    manoeuvres = config.data.draw_manoeuvres()
    flights = simulate_trials(manoeuvres, config.data)
    logs: dict[str, list[Log]] = {"train": [], "validation": [], "test": []}
    for flight, split in zip(flights, config.data.assign_splits(manoeuvres), strict=True):
        logs[split].append(flight.measured_log)
    prepared = prepare_splits(logs, config)
    start_time = time.process_time()
    fitted_model = Fitter(prepared, config, FitStore()).fit_baseline("hull")
    seconds = time.process_time() - start_time
    baseline = fitted_model.model.baseline
    assert isinstance(baseline, RegressorBaseline)
    true_theta = compute_true_coefficients(flights, config, baseline)
    print(
        f"{vessel}, seed {seed}: free runs {fitted_model.notes['least_squares']:.4f} ->"
        f" {fitted_model.notes['validation']:.4f} by the refit, {seconds:.1f} s",
        flush=True,
    )
    names = []
    values = []
    for row in fitted_model.notes["coefficients"]:
        index = baseline.output_names.index(row["axis"]), baseline.library.terms.index(row["term"])
        names.append(f"{row['axis']:6} {row['term']}")
        values.append([row["value"], float(true_theta[index])])
    return names, torch.tensor(values, dtype=torch.float64)


def main() -> None:
    """Compare all vessels over all seeds."""
    vessels = ["remus_100", "bluerov2_heavy"]
    options = bench.options(__doc__, vessels=vessels, seeds=10, s=[])
    for vessel in options.vessels:
        draws = [fit_draw(vessel, 1 + k, options.s) for k in range(options.seeds)]
        names = draws[0][0]
        values = torch.stack([part for _, part in draws])
        true_values = values[:, :, 1].mean(0)
        scale = torch.where(true_values.abs() > _NEGLIGIBLE, true_values.abs() / 100.0, 1.0)
        errors = (values[:, :, 0] - values[:, :, 1]) / scale
        error_std = errors.std(0)
        n_accurate = (errors.abs() <= _ACCURACY).sum(0)
        is_determined = (error_std <= _MAX_DETERMINED_STD) & (true_values.abs() > _NEGLIGIBLE)
        print(f"{vessel}: coefficient, truth; mean error, spread, in % where there is a truth")
        for k, name in enumerate(names):
            print(
                f"  {name:33} {true_values[k]:10.4g} {errors[:, k].mean():+8.1f}"
                f" {error_std[k]:7.1f}"
                + f"  {n_accurate[k]} of {len(errors)} within 5 %"
                * bool(is_determined[k])
            )
        n_values = int(is_determined.sum()) * len(errors)
        n_correct = int(n_accurate[is_determined].sum())
        print(
            f"{vessel}: {int(is_determined.sum())} of {len(names)} are determined; {n_correct}"
            f" of {n_values} ({n_correct / max(n_values, 1):.0%}) of these are within 5 %"
        )


if __name__ == "__main__":
    main()

"""Does the refit find the coefficients of the vehicles under water that it should?

The shipped configs `remus_100` and `bluerov2_heavy` draw ten minutes of noisy trials; their `hull`
is fitted and refitted as `residnet run` does. True coefficients are those that give the plant's own
accelerations on its own motion without noise. A coefficient counts as determined by the trials
where its errors over all draws spread by at most 2.5 % of the truth, so that nothing but a bias
takes it 5 % away in more than one of twenty.

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

_DETERMINED = 2.5
_ASKED = 5.0
_NOTHING = 1e-9


def true_rows(
    flights: Sequence[ManoeuvreRun], config: FitConfig, baseline: RegressorBaseline
) -> torch.Tensor:
    """Return the true coefficients [n, J]."""
    assert isinstance(config.data, SimulatedTrials)
    signals = config.signals
    plant = build_plant(config.data.vessel, config.data.disturbance)
    moved = [flight.true_log for flight in flights]
    columns = [list(plant.state_names), list(plant.input_names[: plant.n_commands])]
    x, w = (
        torch.cat([torch.from_numpy(log.stack(tuple(names))) for log in moved]) for names in columns
    )
    live = baseline.axis_names
    own = torch.cat([torch.from_numpy(log.stack(("x", "y", "psi", *live))) for log in moved])
    seen = torch.cat([torch.from_numpy(log.stack(signals.input_columns)) for log in moved])
    built = signals.build()
    with torch.no_grad():
        rates = plant.derivative(x, w)
        phi = baseline.library(built(own, built.prepare(seen)))
    theta = torch.zeros_like(baseline.theta)
    for axis, name in enumerate(live):
        own_terms = baseline.term_columns(axis)
        target = rates[:, plant.state_names.index(name)]
        if own_terms:
            found = torch.linalg.lstsq(phi[:, own_terms], target[:, None], driver="gelsd").solution
            theta[axis, own_terms] = found[:, 0]
    return theta


def drawn(vessel: str, seed: int, overrides: Sequence[str]) -> tuple[list[str], torch.Tensor]:
    """Return the names of the coefficients; refit and truth of each, [K, 2]."""
    given = [f"data.seed={seed}", "heads={}", "base_of={}", "training={}", *overrides]
    config = load_config(bench.CONFIGS / f"{vessel}.yaml", given, FitConfig)
    assert isinstance(config.data, SimulatedTrials)
    manoeuvres = config.data.draw_manoeuvres()
    flights = simulate_trials(manoeuvres, config.data)
    logs: dict[str, list[Log]] = {"train": [], "validation": [], "test": []}
    for flight, split in zip(flights, config.data.assign_splits(manoeuvres), strict=True):
        logs[split].append(flight.measured_log)
    prepared = prepare_splits(logs, config)
    begun = time.process_time()
    fitted = Fitter(prepared, config, FitStore()).fit_baseline("hull")
    seconds = time.process_time() - begun
    baseline = fitted.model.baseline
    assert isinstance(baseline, RegressorBaseline)
    true = true_rows(flights, config, baseline)
    print(
        f"{vessel}, seed {seed}: free runs {fitted.notes['least_squares']:.4f} ->"
        f" {fitted.notes['validation']:.4f} by the refit, {seconds:.1f} s",
        flush=True,
    )
    names = []
    found = []
    for row in fitted.notes["coefficients"]:
        place = baseline.output_names.index(row["axis"]), baseline.library.terms.index(row["term"])
        names.append(f"{row['axis']:6} {row['term']}")
        found.append([row["value"], float(true[place])])
    return names, torch.tensor(found, dtype=torch.float64)


def main() -> None:
    """Compare all vessels over all seeds."""
    vessels = ["remus_100", "bluerov2_heavy"]
    given = bench.options(__doc__, vessels=vessels, seeds=10, s=[])
    for vessel in given.vessels:
        draws = [drawn(vessel, 1 + k, given.s) for k in range(given.seeds)]
        names = draws[0][0]
        found = torch.stack([part for _, part in draws])
        true = found[:, :, 1].mean(0)
        size = torch.where(true.abs() > _NOTHING, true.abs() / 100.0, 1.0)
        off = (found[:, :, 0] - found[:, :, 1]) / size
        spread = off.std(0)
        near = (off.abs() <= _ASKED).sum(0)
        known = (spread <= _DETERMINED) & (true.abs() > _NOTHING)
        print(f"{vessel}: coefficient, truth; mean error, spread, in % where there is a truth")
        for k, name in enumerate(names):
            print(
                f"  {name:33} {true[k]:10.4g} {off[:, k].mean():+8.1f} {spread[k]:7.1f}"
                + f"  {near[k]} of {len(off)} within 5 %" * bool(known[k])
            )
        count = int(known.sum()) * len(off)
        right = int(near[known].sum())
        print(
            f"{vessel}: {int(known.sum())} of {len(names)} are determined; {right} of {count}"
            f" ({right / max(count, 1):.0%}) of these are within 5 %"
        )


if __name__ == "__main__":
    main()

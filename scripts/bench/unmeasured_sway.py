"""Free-run errors of models that are fitted to logs without a measured sway velocity.

    python scripts/bench/unmeasured_sway.py [--draws 4] [--seed 7100] [--cases NAME ...]
        [--no-refit]

Each draw simulates ten logs of a minute of a catamaran with random forces: zigzags and random
steps. Position, heading, yaw rate and surge velocity are measured, but not sway. With a current its
speed and direction differ between logs; velocities are over ground, and the fit estimates the
currents. A hull is fitted by regression and, without --no-refit, in free run. Free runs of 30 s
over ten other logs of true channels without a current give the position error at the end, averaged
over the windows. Printed for each draw, and as geometric means: the error after a fit to the true
channels, to motion by the smoother, and to the reconstructed motion with its sway acceleration.
"""

from __future__ import annotations

from typing import Any
from unittest import mock

import bench
import numpy as np

from residnet.core.log import Log
from residnet.identification.fit import fit_models
from residnet.identification.prepared import convert_to_motion_through_water, prepare_splits
from residnet.manoeuvres.trials import simulate_trial_logs
from residnet.preprocessing.compatibility import sway

VESSEL = "wam_v_cal"
CASES = {"5 Hz": (0.2, 0.0), "1 Hz": (1.0, 0.0), "5 Hz, current": (0.2, 0.4)}
"""Case -> interval of positions in s and largest speed of the current in m/s."""
POSITION_NOISE = 0.3
HORIZON = 30.0


def simulate_logs(seed: int, interval: float, current: float, *, is_exact: bool) -> list[Log]:
    """Return ten logs of a minute, with GPS positions or with true channels."""
    position = {"noise": 0.0 if is_exact else POSITION_NOISE}
    if not is_exact:
        position["interval"] = interval
    heading = {"noise": "0 deg" if is_exact else "0.3 deg"}
    programme = bench.programme(
        VESSEL,
        seed,
        [
            {"kind": "zigzag", "count": 4, "heading": ["20 deg"]},
            {"kind": "random_steps", "count": 6},
        ],
        noise={
            "u": 0.0 if is_exact else 0.03,
            "v": 0.0 if is_exact else 0.03,
            "r": 0.0 if is_exact else 0.0035,
            "sensors": {"x": position, "y": position, "psi": heading},
        },
        disturbance={
            "force_x": 5,
            "force_y": 5,
            "force_n": 5,
            "current_each": [0.5 * current, current] if current else None,
        },
    )
    return simulate_trial_logs(programme.draw_manoeuvres(), programme)


def remove_sway(log: Log) -> Log:
    """Return a log without its sway velocity."""
    return log.replace(channels={n: values for n, values in log.channels.items() if n != "v"})


def evaluate(train: list[Log], test: list[Log], current: float, *, has_refit: bool) -> float:
    """Return the mean position error of a fitted hull after 30 s in m."""
    parts: dict[str, Any] = {}
    if current:
        parts["current"] = {"spread": 0.5}
    if has_refit:
        parts["refit"] = {"baseline": {"horizon": 10.0, "every": 10.0, "iterations": 4}}
    settings = bench.settings(
        VESSEL,
        baseline={"kind": "regressors", "sets": ["fossen"], "ridge": 1e-6},
        evaluation={
            "protocols": {"T30": {"kind": "windows", "length": HORIZON}},
            "selection": "T30",
            "scales": {"u": 0.3, "v": 0.1, "r": 0.1},
        },
        bands=None,
        **parts,
    )
    prepared = prepare_splits({"train": train[:-2], "validation": train[-2:]}, settings)
    models = fit_models(convert_to_motion_through_water(prepared, settings)[0], settings)
    evaluation = models.evaluate(prepare_splits({"test": test}, settings))["test"]
    row = next(r for r in evaluation.rows if r.model == "baseline" and r.manoeuvre == "all")
    assert row.position_error_end is not None
    return row.position_error_end


def main() -> None:
    """Print the errors of all cases."""
    arguments = bench.options(__doc__, draws=4, seed=7100, cases=[""], no_refit=False)
    has_refit = not arguments.no_refit
    use_smoother = mock.patch.object(sway, "reconstruct_without_sway", return_value=None)
    for case in [name for name in arguments.cases if name] or [*CASES]:
        interval, current = CASES[case]
        errors = []
        for seed in range(arguments.seed, arguments.seed + arguments.draws):
            exact = simulate_logs(seed, interval, current, is_exact=True)
            measured = [
                remove_sway(log) for log in simulate_logs(seed, interval, current, is_exact=False)
            ]
            test = simulate_logs(seed + 5000, interval, 0.0, is_exact=True)
            with use_smoother:
                smoothed_error = evaluate(measured, test, current, has_refit=has_refit)
            errors.append(
                (
                    evaluate(exact, test, current, has_refit=has_refit),
                    smoothed_error,
                    evaluate(measured, test, current, has_refit=has_refit),
                )
            )
            print(f"{case}, seed {seed}: " + ", ".join(f"{e:.2f}" for e in errors[-1]), flush=True)
        means = np.exp(np.log(errors).mean(axis=0))
        print(
            f"{case}: true channels {means[0]:.2f} m, smoother {means[1]:.2f} m,"
            f" reconstruction {means[2]:.2f} m",
            flush=True,
        )


if __name__ == "__main__":
    main()

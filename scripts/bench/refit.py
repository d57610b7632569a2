"""Compare the refit of thirty parameters with scipy's least squares on the same free runs.

A simulated boat with quadratic damping (`large_data.simulate`) sails logs of 100 s at 10 Hz. A
model of ten terms in each of three axes is fitted to the accelerations, and refitted through free
runs of 20 s that start every 10 s. scipy minimises the sum of squares of the same errors, with the
same prior, from the same start, by differences of free runs.

Times are processor seconds, one thread, the least of `--repeats`; a first call, in which the free
run is compiled where no earlier process has, stands beside them. Printed is also the error of the
free runs that each reaches.

    python scripts/bench/refit.py [--logs 12] [--repeats 3] [--without-scipy]
"""

from __future__ import annotations

import argparse
import os
import platform

import numpy as np
import torch
from large_data import STEP, simulate

from residnet.baselines.regressors import RegressorBaseline, RegressorsConfig
from residnet.core.columns import velocities_on
from residnet.core.processes import keep_freed_memory
from residnet.core.samples import Samples
from residnet.data.prepare import PrepareConfig, prepare, samples
from residnet.data.windows import WindowStore
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.rollout import Rollout
from residnet.heads.base import ZeroHead
from residnet.physics.signals import SignalsConfig
from residnet.training.refit import RefitConfig, level_of, place, problem_of, refit

_TERMS = (
    *("u", "v", "r", "u|u|", "v|v|", "r|r|", "u r", "u v"),
    *("n_port|n_port|", "n_stbd|n_stbd|"),
)
_SCALES = torch.tensor([0.5, 0.1, 0.3], dtype=torch.float64)


def system(logs: int) -> tuple[HybridDynamics, Samples, WindowStore]:
    """Return the model fitted by least squares, the samples of that fit, and the windows."""
    settings = {
        "grid": {"step": f"{STEP} s", "held": ["n_port", "n_stbd"]},
        "derivative": {"kind": "savitzky_golay", "window": "1.1 s", "order": 2},
    }
    config = PrepareConfig.model_validate(settings)
    signals = SignalsConfig(inputs=("n_port", "n_stbd"))
    prepared = [prepare(log, "train", signals.columns, config) for log in simulate(logs, 1_000, 1)]
    built = signals.build()
    baseline = RegressorBaseline([_TERMS] * 3, built.names)
    model = HybridDynamics(built, baseline, ZeroHead(built.names), STEP, "rk4")
    model.positions = False
    known = samples(prepared, built)
    RegressorsConfig(terms=_TERMS).fit(baseline, known)
    return model, known, WindowStore.gather(prepared, torch.float64)


def spent() -> float:
    """Return the processor time of this process and of the compilers that it has called, s."""
    return sum(os.times()[:4])


def main() -> None:
    """Print the times and the errors reached."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--logs", type=int, default=12)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--without-scipy", action="store_true")
    given = parser.parse_args()
    torch.set_num_threads(1)
    keep_freed_memory()
    model, known, store = system(given.logs)
    baseline, config = model.baseline, RefitConfig(horizon=20.0, every=10.0)
    assert isinstance(baseline, RegressorBaseline)
    start = baseline.theta.detach().clone()
    problem = problem_of(model, baseline, known, store, config, _SCALES)
    windows, steps = problem.w.shape[:2]
    print(
        f"torch {torch.__version__}, {platform.platform()}, load {os.getloadavg()[0]:.1f}:"
        f" {len(problem.active)} parameters, {windows} windows of {steps} steps"
    )
    found = []
    for _ in range(1 + given.repeats):
        place(baseline, start.flatten()[problem.active], problem.active)
        begun = spent()
        notes = refit(model, known, store, config, _SCALES).notes
        found.append(spent() - begun)
    print(
        f"refit: first {found[0]:.2f} s, then {min(found[1:]):.2f} s, {notes['iterations']}"
        f" iterations, cost {notes['cost_before']:.6f} -> {notes['cost_after']:.9f}"
    )
    if given.without_scipy:
        return
    from scipy.optimize import least_squares

    root = np.linalg.cholesky(problem.precision.numpy()).T
    each = np.sqrt(problem.nu.numel())

    def errors(values: np.ndarray) -> np.ndarray:
        place(baseline, torch.from_numpy(values), problem.active)
        flown = Rollout(model)(problem.x0, problem.w, problem.x0[:, :0])[0]
        error = (velocities_on(flown[:, 1:]) - problem.nu) * problem.weight / each
        return np.append(error.numpy().ravel(), root @ (values - problem.start.numpy()))

    begun = spent()
    best = least_squares(errors, problem.start.numpy(), method="lm", x_scale="jac", xtol=1e-4)
    taken = spent() - begun
    place(baseline, torch.from_numpy(best.x), problem.active)
    level = level_of(model, problem)[0]
    print(f"scipy: {taken:.2f} s, {best.nfev} free runs, cost {level:.9f}")


if __name__ == "__main__":
    main()

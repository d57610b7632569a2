"""Parameters of a refitted baseline without some of its logs, by one step of Gauss-Newton each.

A refit for every group of logs that is left out would take as long as so many refits. At the
minimum over all logs, the normal equations of a group say what it alone pulls the parameters to;
taken away, the rest of the logs moves them by one step. All groups together cost as much as one
iteration of the refit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from residnet.core.samples import Samples
from residnet.dynamics.hybrid import HybridDynamics
from residnet.preprocessing.windows import WindowStore
from residnet.training.refit import (
    Problem,
    RefitConfig,
    estimate_initial_states,
    normal_equations,
    parametric,
    problem_of,
    simulate,
)


class LeftOpen(NamedTuple):
    """What a refit has left open.

    Attributes:
        covariance: of the free parameters [P, P].
        square: mean square error of a channel of the free runs, in scales.
    """

    covariance: Tensor
    square: float


def left_open(
    model: HybridDynamics,
    samples: Samples,
    store: WindowStore,
    config: RefitConfig,
    scales: Tensor,
    still: Sequence[int],
) -> LeftOpen:
    """Return the covariance that a refit ends with, from one pass over its free runs.

    Args:
        model: a baseline without a head, after its refit.
        samples: of the refit.
        store: training windows of the refit, float64.
        config: of the refit.
        scales: of what moves, [n].
        still: numbers of the free parameters that the refit has left at zero.
    """
    problem = problem_of(model, samples, store, config, scales).fixing(still)
    problem = estimate_initial_states(model, problem)
    level, states = simulate(model, problem)
    hessian, _ = normal_equations(model, problem, level, states)
    covariance = problem.cost_per_nat(level) * problem.inverse(hessian)
    return LeftOpen(covariance, float(level.square() - config.robust**2))


_HALVINGS = 4
"""Times that a step which does not gain is halved."""


def without_logs(
    model: HybridDynamics,
    samples: Samples,
    store: WindowStore,
    config: RefitConfig,
    scales: Tensor,
    fold: Tensor,
    still: Sequence[int] = (),
) -> list[Tensor]:
    """Return theta of the model's baseline as each fold of logs, left out of the refit, leaves it.

    Args:
        model: a baseline without a head, after its refit; it is handed back as it was.
        samples: of the refit.
        store: training windows of the refit, float64.
        config: of the refit.
        scales: of what moves, [n].
        fold: number of the fold of each log [L], from 0 on.
        still: numbers of the free parameters that the refit has left at zero.

    Returns:
        One theta for each fold; the refitted one where a fold holds no window, or where no part of
        the step keeps the free runs of the other logs finite and no worse.
    """
    baseline = parametric(model)
    problem = problem_of(model, samples, store, config, scales).fixing(still)
    problem = estimate_initial_states(model, problem)
    level, states = simulate(model, problem)
    fitted, parameters = baseline.theta.detach().clone(), baseline.get_free()
    of_window = fold[problem.log]
    folds = int(fold.max()) + 1
    count = torch.bincount(of_window, minlength=folds).to(parameters.dtype)
    parts = [
        _part(model, _rows(problem, of_window == k), states[of_window == k], level)
        for k in range(folds)
    ]
    # at the minimum all logs together pull as hard as the prior holds
    together = sum(
        (share * own for share, (_, own) in zip(count / count.sum(), parts, strict=True)),
        torch.zeros_like(parameters),
    )
    out = []
    for k in range(folds):
        left = float(count.sum() - count[k])
        if count[k] == 0 or left == 0:
            out.append(fitted.clone())
            continue
        hessian = (
            problem.precision
            + problem.symmetry
            + torch.diag(problem.cost_per_nat(level) * problem.belief_precision)
        )
        for j, (own, _) in enumerate(parts):
            if j != k:
                hessian = hessian + count[j] / left * own
        slope = count[k] / left * (parts[k][1] - together)
        step = torch.linalg.lstsq(hessian, slope.unsqueeze(1), driver="gelsd").solution.squeeze(1)
        step[problem.fixed] = 0.0
        others = _rows(problem, of_window != k)
        baseline.set_free(_best_share(model, others, parameters, step))
        out.append(baseline.theta.detach().clone())
        baseline.set_free(parameters)
    return out


def _best_share(model: HybridDynamics, others: Problem, parameters: Tensor, step: Tensor) -> Tensor:
    """Return the parameters after the largest share of the step that the other logs agree to."""
    baseline, (before, _) = parametric(model), simulate(model, others)
    for halving in range(_HALVINGS):
        trial = parameters + 0.5**halving * step
        baseline.set_free(trial)
        after, _ = simulate(model, others)
        baseline.set_free(parameters)
        if torch.isfinite(after) and after <= before:
            return trial
    return parameters


def _rows(problem: Problem, chosen: Tensor) -> Problem:
    """Return the problem of some of its windows, whose starts are as they are."""
    return replace(
        problem,
        x0=problem.x0[chosen],
        inputs=problem.inputs[chosen],
        measured=problem.measured[chosen],
        weight=problem.weight[chosen],
        log=problem.log[chosen],
        initial=None,
    )


def _part(
    model: HybridDynamics, part: Problem, states: Tensor, level: Tensor
) -> tuple[Tensor, Tensor]:
    """Return Hessian [P, P] and half the gradient [P] of the mean cost of some windows alone."""
    size = int(part.free.numel())
    if len(part.x0) == 0:
        return torch.zeros(size, size, dtype=states.dtype), torch.zeros(size, dtype=states.dtype)
    nothing = replace(
        part,
        precision=torch.zeros_like(part.precision),
        symmetry=torch.zeros_like(part.symmetry),
        belief_precision=torch.zeros_like(part.belief_precision),
        prior_mean=parametric(model).get_free(),
    )
    return normal_equations(model, nothing, level, states)

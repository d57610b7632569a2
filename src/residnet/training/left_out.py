"""Leave-one-out parameters of a refitted baseline by one Gauss-Newton step for each fold of logs.

Each fold of logs contributes to the Hessian and the gradient of the cost at the refitted
parameters. One Gauss-Newton step without the contribution of a fold approximates the refit without
this fold (infinitesimal jackknife). All folds together cost as much as one iteration of the refit.
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
    build_problem,
    estimate_initial_states,
    normal_equations,
    require_parametric_baseline,
    simulate,
)
from residnet.training.refit_config import RefitConfig


class RefitUncertainty(NamedTuple):
    """Uncertainty of the parameters of a refit.

    Attributes:
        covariance: covariance of the free parameters [P, P].
        mean_square_error: mean square error of the free runs over all velocities, each divided by
            its scale.
    """

    covariance: Tensor
    mean_square_error: float


def estimate_refit_covariance(
    model: HybridDynamics,
    samples: Samples,
    store: WindowStore,
    config: RefitConfig,
    scales: Tensor,
    fixed: Sequence[int],
) -> RefitUncertainty:
    """Estimate the covariance of a refit's parameters from one pass over its free runs.

    Args:
        model: a baseline without a head, after its refit.
        samples: samples of the refit.
        store: training windows of the refit, float64.
        config: settings of the refit.
        scales: scales of the velocities in SI units [n].
        fixed: indices of the free parameters that the refit has fixed at zero.
    """
    problem = build_problem(model, samples, store, config, scales).with_fixed(fixed)
    problem = estimate_initial_states(model, problem)
    cost, states = simulate(model, problem)
    hessian, _ = normal_equations(model, problem, cost, states)
    covariance = problem.cost_per_nat(cost) * problem.inverse(hessian)
    # the cost of a window is sqrt(mean square error + robust^2)
    return RefitUncertainty(covariance, float(cost.square() - config.robust**2))


class PriorMeans(NamedTuple):
    """Least-squares solutions that are the prior means of refits, free parameters.

    Attributes:
        of_all_logs: solution of all logs [P].
        without_folds: solutions without each fold of logs [K, P].
    """

    of_all_logs: Tensor
    without_folds: Tensor


_MAX_HALVINGS = 4
"""Maximum number of trials per step; each halves the step."""


def estimate_leave_one_out(
    model: HybridDynamics,
    samples: Samples,
    store: WindowStore,
    config: RefitConfig,
    scales: Tensor,
    fold: Tensor,
    fixed: Sequence[int] = (),
    prior_means: PriorMeans | None = None,
) -> list[Tensor]:
    """Estimate the parameters of refits that each leave out one fold of logs.

    Each is one Gauss-Newton step from the refitted parameters (infinitesimal jackknife). The prior
    of the refit is the least-squares solution; that of all logs contains the fold that is left out.

    Args:
        model: a baseline without a head, after its refit; it is not changed.
        samples: samples of the refit.
        store: training windows of the refit, float64.
        config: settings of the refit.
        scales: scales of the velocities in SI units [n].
        fold: index of the fold of each log [L], from 0 on.
        fixed: indices of the free parameters that the refit has fixed at zero.
        prior_means: least-squares solutions with and without the folds; None to leave the prior
            unchanged, which suffices if it has a small weight.

    Returns:
        theta of each fold. It equals the refitted theta if the fold has no window, or if no
        fraction of the step lowers the cost of the other logs.
    """
    baseline = require_parametric_baseline(model)
    problem = build_problem(model, samples, store, config, scales).with_fixed(fixed)
    problem = estimate_initial_states(model, problem)
    cost, states = simulate(model, problem)
    refitted_theta = baseline.theta.detach().clone()
    parameters = baseline.get_free()
    fold_of_window = fold[problem.log_index]
    n_folds = int(fold.max()) + 1
    n_windows = torch.bincount(fold_of_window, minlength=n_folds).to(parameters.dtype)
    equations_by_fold = [
        _normal_equations_of_windows(
            model, _select_windows(problem, fold_of_window == k), states[fold_of_window == k], cost
        )
        for k in range(n_folds)
    ]
    # at the refitted parameters the gradients of the cost and of the prior add to zero, so that the
    # difference of gradients below contains the prior
    total_gradient = sum(
        (
            share * gradient
            for share, (_, gradient) in zip(
                n_windows / n_windows.sum(), equations_by_fold, strict=True
            )
        ),
        torch.zeros_like(parameters),
    )
    thetas = []
    for k in range(n_folds):
        n_remaining = float(n_windows.sum() - n_windows[k])
        if n_windows[k] == 0 or n_remaining == 0:
            thetas.append(refitted_theta.clone())
            continue
        per_nat = problem.cost_per_nat(cost)
        hessian = (
            problem.precision + problem.symmetry + torch.diag(per_nat * problem.belief_precision)
        )
        for j, (hessian_of_fold, _) in enumerate(equations_by_fold):
            if j != k:
                hessian = hessian + n_windows[j] / n_remaining * hessian_of_fold
        gradient_change = n_windows[k] / n_remaining * (equations_by_fold[k][1] - total_gradient)
        remaining_windows = _select_windows(problem, fold_of_window != k)
        objective_scale = None
        if prior_means is not None:
            shift = prior_means.without_folds[k] - prior_means.of_all_logs
            gradient_change = gradient_change + problem.precision @ shift
            remaining_windows = replace(remaining_windows, prior_mean=prior_means.without_folds[k])
            objective_scale = per_nat
        # a fixed parameter keeps its diagonal entry, so that the Hessian is invertible
        is_free = ~problem.fixed
        hessian = hessian * (is_free[:, None] & is_free | torch.eye(len(is_free)).bool())
        step = torch.linalg.lstsq(
            hessian, (gradient_change * is_free).unsqueeze(1), driver="gelsd"
        ).solution.squeeze(1)
        step[problem.fixed] = 0.0
        baseline.set_free(
            _largest_improving_step(model, remaining_windows, parameters, step, objective_scale)
        )
        thetas.append(baseline.theta.detach().clone())
        baseline.set_free(parameters)
    return thetas


def _largest_improving_step(
    model: HybridDynamics,
    remaining_windows: Problem,
    parameters: Tensor,
    step: Tensor,
    per_nat: Tensor | None,
) -> Tensor:
    """Return the parameters after the largest fraction of the step that lowers the cost.

    Args:
        model: the model with its refitted parameters.
        remaining_windows: windows of the other logs, and the prior without the fold.
        parameters: refitted free parameters [P].
        step: the step [P].
        per_nat: change of the cost per nat, if the cost includes the priors; None if not.
    """
    baseline = require_parametric_baseline(model)

    def evaluate(theta: Tensor) -> Tensor:
        baseline.set_free(theta)
        cost, _ = simulate(model, remaining_windows)
        return cost if per_nat is None else cost + remaining_windows.prior_cost(theta, per_nat)

    initial_cost = evaluate(parameters)
    for halving in range(_MAX_HALVINGS):
        trial = parameters + 0.5**halving * step
        trial_cost = evaluate(trial)
        baseline.set_free(parameters)
        if torch.isfinite(trial_cost) and trial_cost <= initial_cost:
            return trial
    return parameters


def _select_windows(problem: Problem, is_selected: Tensor) -> Problem:
    """Return the problem of some windows; their initial states are not estimated again."""
    return replace(
        problem,
        x0=problem.x0[is_selected],
        inputs=problem.inputs[is_selected],
        measured=problem.measured[is_selected],
        weight=problem.weight[is_selected],
        log_index=problem.log_index[is_selected],
        initial=None,
    )


def _normal_equations_of_windows(
    model: HybridDynamics, problem: Problem, states: Tensor, cost: Tensor
) -> tuple[Tensor, Tensor]:
    """Return half the Hessian [P, P] and half the gradient [P] of the mean cost, without prior.

    Args:
        model: a baseline without a head.
        problem: the windows.
        states: free runs of the windows.
        cost: cost of all windows of the refit.
    """
    n_parameters = int(problem.free.numel())
    if len(problem.x0) == 0:
        return torch.zeros(n_parameters, n_parameters, dtype=states.dtype), torch.zeros(
            n_parameters, dtype=states.dtype
        )
    # zero precision of all priors, and no deviation from their mean
    without_prior = replace(
        problem,
        precision=torch.zeros_like(problem.precision),
        symmetry=torch.zeros_like(problem.symmetry),
        belief_precision=torch.zeros_like(problem.belief_precision),
        prior_mean=require_parametric_baseline(model).get_free(),
    )
    return normal_equations(model, without_prior, cost, states)

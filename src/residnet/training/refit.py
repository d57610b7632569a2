"""Refitting a baseline's coefficients through rollouts: Gauss-Newton on free-run errors with forward sensitivities.

Least squares on derivatives weighs every instant alike and ignores how errors add up; this minimises what a free run is
judged by. The least-squares solution and its information matrix stand as the prior, so that directions which the
free runs do not see stay where the derivatives put them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from pydantic import Field
from torch import Tensor

from residnet.baselines.regressors import RegressorBaseline
from residnet.core.config import Config, Seconds
from residnet.core.errors import FitError
from residnet.core.samples import Samples
from residnet.data.windows import WindowStore
from residnet.dynamics.hybrid import HybridDynamics
from residnet.physics.symmetry import wrong_parity


class RefitConfig(Config):
    """Gauss-Newton refit of a baseline that is linear in its coefficients.

    Attributes:
        horizon: length of the free runs.
        every: time between their starts.
        prior: weight of the least-squares solution, as a share of its own information.
        asymmetric: shrinks terms that a mirror-symmetric vessel cannot have towards zero; 0 for no such knowledge.
        robust: windows whose error (in units of the scales) is far above this count by their error and not by its square.
        iterations: at most.
    """

    horizon: Seconds = Field(default=20.0, gt=0)
    every: Seconds = Field(default=10.0, gt=0)
    prior: float = Field(default=1e-2, ge=0)
    asymmetric: float = Field(default=0.0, ge=0)
    robust: float = Field(default=0.05, gt=0)
    iterations: int = Field(default=10, ge=1)


@dataclass(frozen=True)
class _Problem:
    """Windows x0 [B, 6], w [B, T, m], measured nu [B, T, 3], weights [B, T, 3] (0 or 1/scale); prior precision [P, P] about theta0 [P],
    pull to zero [P]."""

    x0: Tensor
    w: Tensor
    nu: Tensor
    weight: Tensor
    precision: Tensor
    start: Tensor
    pull: Tensor
    active: Tensor
    robust: float


def refit(model: HybridDynamics, samples: Samples, store: WindowStore, config: RefitConfig, scales: Tensor) -> dict[str, Any]:
    """Move the coefficients of `model.baseline` to the minimum; float64.

    Args:
        model: a baseline without a head, fitted by least squares.
        samples: the samples of that fit.
        store: training windows, float64.
        config: settings.
        scales: of the velocities, [3].

    Returns:
        Cost before and after, iterations, windows.

    Raises:
        FitError: where the first free runs are not finite or no step lowers the cost.
    """
    baseline = model.baseline
    if not isinstance(baseline, RegressorBaseline):
        raise FitError("a refit through rollouts needs a baseline of kind 'regressors', 'linear_steady', 'nomoto' or 'nomoto_sideslip'")
    problem = _problem(model, baseline, samples, store, config, scales)
    theta = baseline.theta
    cost = first = _cost(model, problem, baseline)
    if not torch.isfinite(first):
        raise FitError("the least-squares baseline diverges within the refit's horizon; shorten `horizon` or raise the baseline's ridge")
    damping, count = 1e-3, 0
    for _ in range(config.iterations):
        hessian, gradient = _normal_equations(model, problem, baseline)
        kept, improved = theta.detach().clone(), False
        for _attempt in range(8):
            step = torch.linalg.solve(hessian + damping * torch.diag(hessian.diagonal()), gradient)
            with torch.no_grad():
                flat = kept.flatten()
                flat[problem.active] -= step
                theta.copy_(flat.reshape(theta.shape))
            trial = _cost(model, problem, baseline)
            if torch.isfinite(trial) and trial < cost:
                improved = True
                break
            damping *= 10
        if not improved:
            with torch.no_grad():
                theta.copy_(kept)
            break
        gain, cost, damping = float(cost - trial), trial, max(damping / 10, 1e-8)
        count += 1
        if gain < 2e-4 * float(cost):
            break
    return {"cost_before": float(first), "cost_after": float(cost), "iterations": count, "windows": len(problem.x0), "horizon": config.horizon}


def _problem(
    model: HybridDynamics, baseline: RegressorBaseline, samples: Samples, store: WindowStore, config: RefitConfig, scales: Tensor
) -> _Problem:
    steps, every = round(config.horizon / model.dt), max(round(config.every / model.dt), 1)
    starts = store.starts(steps + 1)
    starts = starts[store.depth[starts] % every == 0]
    if starts.numel() == 0:
        raise FitError(f"no training log holds a free run of {config.horizon:g} s for the refit; shorten `horizon`")
    take = store.take
    usable = take(store.usable, starts + 1, steps).to(scales.dtype).unsqueeze(-1)
    # r comes from a gyro, which a frozen position does not disturb
    weight = torch.cat((usable, usable, torch.ones_like(usable)), dim=-1) / scales
    phi = baseline.library(samples.z)
    residual = samples.target - phi @ (baseline.theta * baseline.allowed).T
    variance = residual.square().mean(0)
    gram = phi.T @ phi / len(samples)
    active = baseline.movable()
    precision = config.prior * torch.block_diag(*[gram / variance[axis] for axis in range(3)])
    terms = baseline.library.terms
    odd = torch.tensor([[float(wrong_parity(term, axis, samples.names)) for term in terms] for axis in range(3)], dtype=scales.dtype)
    pull = config.asymmetric * odd * phi.square().mean(0) / variance[:, None]
    return _Problem(
        store.y[starts],
        take(store.w, starts, steps),
        take(store.y, starts + 1, steps)[:, :, 3:],
        weight,
        precision[active][:, active],
        baseline.theta.detach().flatten()[active].clone(),
        pull.flatten()[active],
        active,
        config.robust,
    )


def _window_cost(error: Tensor) -> Tensor:
    """Mean square error of each window [B] from weighted errors [B, T, 3]."""
    return error.square().mean((1, 2))


def _prior_cost(problem: _Problem, baseline: RegressorBaseline) -> Tensor:
    theta = baseline.theta.detach().flatten()[problem.active]
    moved = theta - problem.start
    return moved @ problem.precision @ moved + (problem.pull * theta.square()).sum()


@torch.no_grad()
def _cost(model: HybridDynamics, problem: _Problem, baseline: RegressorBaseline) -> Tensor:
    x, total = problem.x0, []
    for k in range(problem.w.shape[1]):
        x = _euler(model, x, model.signals.prepare(problem.w[:, k]))
        total.append(x[:, 3:])
    error = (torch.stack(total, dim=1) - problem.nu) * problem.weight
    return torch.sqrt(_window_cost(error) + problem.robust**2).mean() + _prior_cost(problem, baseline)


def _euler(model: HybridDynamics, x: Tensor, p: Tensor) -> Tensor:
    # the sensitivities are those of this scheme; at the steps of logs its error is far below the model's
    nu = x[:, 3:] + model.dt * model.baseline(model.signals(x, p))
    psi = x[:, 2] + 0.5 * model.dt * (nu[:, 2] + x[:, 5])
    return torch.cat((x[:, :2], psi[:, None], nu), dim=-1)


@torch.no_grad()
def _normal_equations(model: HybridDynamics, problem: _Problem, baseline: RegressorBaseline) -> tuple[Tensor, Tensor]:
    """Gauss-Newton Hessian [P, P] and half the gradient [P] of the robust cost."""
    batch, steps = problem.w.shape[:2]
    count, dt = int(problem.active.numel()), model.dt
    terms = baseline.library.count
    axis, column = problem.active // terms, problem.active % terms
    x = problem.x0
    sensitivity = torch.zeros(batch, 4, count, dtype=x.dtype)
    hessian = torch.zeros(batch, count, count, dtype=x.dtype)
    gradient = torch.zeros(batch, count, dtype=x.dtype)
    square = torch.zeros(batch, dtype=x.dtype)
    place = torch.arange(count)
    for k in range(steps):
        p = model.signals.prepare(problem.w[:, k])
        slopes = _slopes(model, x, p)
        change = dt * slopes @ sensitivity
        change[:, axis, place] += dt * baseline.library(model.signals(x, p))[:, column]
        moved = sensitivity[:, 1:] + change
        heading = sensitivity[:, :1] + 0.5 * dt * (moved[:, 2:] + sensitivity[:, 3:])
        sensitivity = torch.cat((heading, moved), dim=1)
        x = _euler(model, x, p)
        error = (x[:, 3:] - problem.nu[:, k]) * problem.weight[:, k]
        seen = moved * problem.weight[:, k].unsqueeze(-1)
        hessian += seen.transpose(1, 2) @ seen
        gradient += (seen * error.unsqueeze(-1)).sum(1)
        square += error.square().sum(1)
    weight = 0.5 / torch.sqrt(square / (3 * steps) + problem.robust**2) / (3 * steps * batch)
    theta = baseline.theta.flatten()[problem.active]
    prior = problem.precision + torch.diag(problem.pull)
    total = torch.einsum("b,bij->ij", weight, hessian) + prior
    return total, weight @ gradient + problem.precision @ (theta - problem.start) + problem.pull * theta


def _slopes(model: HybridDynamics, x: Tensor, p: Tensor) -> Tensor:
    """Derivative of nu_dot with respect to (psi, u, v, r), [B, 3, 4], by forward differentiation along the four directions at once."""
    batch = x.shape[0]
    tangent = torch.zeros(4, batch, x.shape[1], dtype=x.dtype)
    for direction in range(4):
        tangent[direction, :, 2 + direction] = 1.0
    repeated, inputs = x.repeat(4, 1), p.repeat(4, 1)
    slopes = torch.func.jvp(lambda state: model.baseline(model.signals(state, inputs)), (repeated,), (tangent.reshape(-1, x.shape[1]),))[1]
    return slopes.reshape(4, batch, 3).permute(1, 2, 0)



"""Refitting a baseline's parameters through rollouts: Gauss-Newton on free-run errors with forward sensitivities.

Least squares on derivatives weighs every instant alike and ignores how errors add up; this minimises what a free run is
judged by. The least-squares solution and its information matrix stand as the prior, so that directions which the
free runs do not see stay where the derivatives put them; a baseline that holds beliefs about its parameters adds them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from pydantic import Field
from torch import Tensor

from residnet.baselines import ParametricBaseline
from residnet.core.config import Config, Seconds
from residnet.core.errors import FitError
from residnet.core.samples import Samples
from residnet.data.windows import WindowStore
from residnet.dynamics.hybrid import HybridDynamics


class RefitConfig(Config):
    """Gauss-Newton refit of a baseline's parameters.

    Attributes:
        horizon: length of the free runs.
        every: time between their starts.
        prior: weight of the least-squares solution, as a share of its own information.
        asymmetric: shrinks terms that a mirror-symmetric vessel cannot have towards zero; 0 for no such knowledge.
        robust: windows whose error (in units of the scales) is far above this count by their error and not by its square.
        correlation: time over which errors of a free run hang together; the logs hold so many independent errors, which says how much beliefs
            weigh beside them, and how large the standard errors are.
        iterations: at most.
    """

    horizon: Seconds = Field(default=20.0, gt=0)
    every: Seconds = Field(default=10.0, gt=0)
    prior: float = Field(default=1e-2, ge=0)
    asymmetric: float = Field(default=0.0, ge=0)
    robust: float = Field(default=0.05, gt=0)
    correlation: Seconds = Field(default=10.0, gt=0)
    iterations: int = Field(default=10, ge=1)


@dataclass(frozen=True)
class Refitted:
    """What a refit hands back.

    Attributes:
        covariance: of the movable parameters, [P, P].
        notes: cost before and after, iterations, windows, horizon, independent errors.
    """

    covariance: Tensor
    notes: dict[str, Any]

    @property
    def errors(self) -> Tensor:
        """Standard errors [P]."""
        return self.covariance.diagonal().clamp(min=0.0).sqrt()


@dataclass(frozen=True)
class _Problem:
    """Windows x0 [B, 6], w [B, T, m], measured nu [B, T, 3], weights [B, T, 3] (0 or 1/scale); numbers of the movable parameters [P]; precision
    [P, P] about where least squares put them [P], pull to zero [P]; beliefs, mean and precision [P]; count of independent errors per channel."""

    x0: Tensor
    w: Tensor
    nu: Tensor
    weight: Tensor
    active: Tensor
    precision: Tensor
    start: Tensor
    pull: Tensor
    believed: Tensor
    belief: Tensor
    count: float
    robust: float

    def share(self, level: Tensor) -> Tensor:
        """Half of what one unit of minus the logarithm of a probability costs, where the cost is `level`.

        With c the mean square error of three channels of so many independent errors each, that logarithm grows by 3 N / 2c for each unit of c,
        and the cost sqrt(c + robust^2) by 1 / (2 cost).
        """
        return (level.square() - self.robust**2).clamp(min=1e-12) / (6.0 * self.count * level)


def refit(model: HybridDynamics, samples: Samples, store: WindowStore, config: RefitConfig, scales: Tensor) -> Refitted:
    """Move the parameters of `model.baseline` to the minimum; float64.

    Args:
        model: a baseline without a head, fitted by least squares.
        samples: the samples of that fit.
        store: training windows, float64.
        config: settings.
        scales: of the velocities, [3].

    Raises:
        FitError: where the first free runs are not finite.
    """
    baseline = model.baseline
    if not isinstance(baseline, ParametricBaseline):
        raise FitError("a refit through rollouts needs a baseline of kind 'regressors', 'linear_steady', 'mmg', 'nomoto' or 'nomoto_sideslip'")
    problem = _problem(model, baseline, samples, store, config, scales)
    level = first = _level(model, problem)
    if not torch.isfinite(first):
        raise FitError("the least-squares baseline diverges within the refit's horizon; shorten `horizon` or raise the baseline's ridge")
    damping, count = 1e-3, 0
    hessian, gradient = _normal_equations(model, problem, baseline, level)
    for _ in range(config.iterations):
        share = problem.share(level)
        cost = level + _prior_cost(problem, baseline, share)
        kept, improved = baseline.theta.detach().clone(), False
        for _attempt in range(8):
            step = torch.linalg.solve(hessian + damping * torch.diag(hessian.diagonal()), gradient)
            _place(baseline, kept.flatten()[problem.active] - step, problem.active)
            reached = _level(model, problem)
            trial = reached + _prior_cost(problem, baseline, share)
            if torch.isfinite(trial) and trial < cost:
                improved = True
                break
            damping *= 10
        if not improved:
            _place(baseline, kept.flatten()[problem.active], problem.active)
            break
        gain, level, damping = float(cost - trial), reached, max(damping / 10, 1e-8)
        count += 1
        hessian, gradient = _normal_equations(model, problem, baseline, level)
        if gain < 2e-4 * float(cost):
            break
    covariance = problem.share(level) * torch.linalg.pinv(hessian, hermitian=True)
    notes = {"cost_before": float(first), "cost_after": float(level), "iterations": count, "windows": len(problem.x0), "horizon": config.horizon}
    return Refitted(covariance, notes | {"independent_errors": round(problem.count, 1)})


def _place(baseline: ParametricBaseline, values: Tensor, active: Tensor) -> None:
    """Set the movable parameters."""
    with torch.no_grad():
        flat = baseline.theta.detach().clone().flatten()
        flat[active] = values
        baseline.theta.copy_(flat.reshape(baseline.theta.shape))


def _problem(
    model: HybridDynamics, baseline: ParametricBaseline, samples: Samples, store: WindowStore, config: RefitConfig, scales: Tensor
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
    active = baseline.movable()
    covered = (starts[:, None] + torch.arange(1, steps + 1)).unique().numel()
    believed, belief = baseline.belief()
    return _Problem(
        store.y[starts],
        take(store.w, starts, steps),
        take(store.y, starts + 1, steps)[:, :, 3:],
        weight,
        active,
        config.prior * baseline.information(samples),
        baseline.theta.detach().flatten()[active].clone(),
        config.asymmetric * baseline.asymmetry(samples),
        believed,
        belief,
        max(covered * model.dt / config.correlation, 1.0),
        config.robust,
    )


def _window_cost(error: Tensor) -> Tensor:
    """Mean square error of each window [B] from weighted errors [B, T, 3]."""
    return error.square().mean((1, 2))


def _prior_cost(problem: _Problem, baseline: ParametricBaseline, share: Tensor) -> Tensor:
    theta = baseline.theta.detach().flatten()[problem.active]
    moved, off = theta - problem.start, theta - problem.believed
    return moved @ problem.precision @ moved + (problem.pull * theta.square()).sum() + share * (problem.belief * off.square()).sum()


@torch.no_grad()
def _level(model: HybridDynamics, problem: _Problem) -> Tensor:
    """Mean error of the windows, in units of the scales."""
    x, total = problem.x0, []
    for k in range(problem.w.shape[1]):
        x = _ahead(model, x, model.signals.prepare(problem.w[:, k]))
        total.append(x[:, 3:])
    error = (torch.stack(total, dim=1) - problem.nu) * problem.weight
    return torch.sqrt(_window_cost(error) + problem.robust**2).mean()


def _ahead(model: HybridDynamics, x: Tensor, p: Tensor) -> Tensor:
    """State one step later; of an Euler scheme with the mean yaw rate for the heading."""
    if len(model.nodes) > 1:
        return model.integrate(x, p, torch.zeros_like(x[:, :3]))
    nu = x[:, 3:] + model.dt * model.baseline(model.signals(x, p))
    psi = x[:, 2] + 0.5 * model.dt * (nu[:, 2] + x[:, 5])
    return torch.cat((x[:, :2], psi[:, None], nu), dim=-1)


def _carried(model: HybridDynamics, baseline: ParametricBaseline, x: Tensor, p: Tensor, s: Tensor) -> Tensor:
    """Sensitivities of (psi, u, v, r) to the parameters one step later, [B, 4, P], from s [B, 4, P] at the states x: the scheme's own derivative."""
    change, total = torch.zeros_like(s), torch.zeros_like(s)
    place = x
    for node, weight in zip(model.nodes, model.weights, strict=True):
        here = s + node * model.dt * change
        if node > 0.0:
            place = x + node * model.dt * model.rate(place, p, torch.zeros_like(x[:, :3]))
        nu = _slopes(model, place, p) @ here + baseline.sensitivity(model.signals(place, p))
        change = torch.cat((here[:, 3:], nu), dim=1)
        total = total + weight * change
    after = s + model.dt * total
    if len(model.nodes) == 1:
        after = torch.cat((s[:, :1] + 0.5 * model.dt * (after[:, 3:] + s[:, 3:]), after[:, 1:]), dim=1)
    return after


@torch.no_grad()
def _normal_equations(model: HybridDynamics, problem: _Problem, baseline: ParametricBaseline, level: Tensor) -> tuple[Tensor, Tensor]:
    """Gauss-Newton Hessian [P, P] and half the gradient [P] of the robust cost."""
    batch, steps = problem.w.shape[:2]
    count = int(problem.active.numel())
    x = problem.x0
    sensitivity = torch.zeros(batch, 4, count, dtype=x.dtype)
    hessian = torch.zeros(batch, count, count, dtype=x.dtype)
    gradient = torch.zeros(batch, count, dtype=x.dtype)
    square = torch.zeros(batch, dtype=x.dtype)
    for k in range(steps):
        p = model.signals.prepare(problem.w[:, k])
        sensitivity = _carried(model, baseline, x, p, sensitivity)
        x = _ahead(model, x, p)
        error = (x[:, 3:] - problem.nu[:, k]) * problem.weight[:, k]
        seen = sensitivity[:, 1:] * problem.weight[:, k].unsqueeze(-1)
        hessian += seen.transpose(1, 2) @ seen
        gradient += (seen * error.unsqueeze(-1)).sum(1)
        square += error.square().sum(1)
    weight = 0.5 / torch.sqrt(square / (3 * steps) + problem.robust**2) / (3 * steps * batch)
    theta = baseline.theta.flatten()[problem.active]
    belief = problem.share(level) * problem.belief
    total = torch.einsum("b,bij->ij", weight, hessian) + problem.precision + torch.diag(problem.pull + belief)
    prior = problem.precision @ (theta - problem.start) + problem.pull * theta + belief * (theta - problem.believed)
    return total, weight @ gradient + prior


def _slopes(model: HybridDynamics, x: Tensor, p: Tensor) -> Tensor:
    """Derivative of nu_dot with respect to (psi, u, v, r), [B, 3, 4], by forward differentiation along the four directions at once."""
    batch = x.shape[0]
    tangent = torch.zeros(4, batch, x.shape[1], dtype=x.dtype)
    for direction in range(4):
        tangent[direction, :, 2 + direction] = 1.0
    repeated, inputs = x.repeat(4, 1), p.repeat(4, 1)
    slopes = torch.func.jvp(lambda state: model.baseline(model.signals(state, inputs)), (repeated,), (tangent.reshape(-1, x.shape[1]),))[1]
    return slopes.reshape(4, batch, 3).permute(1, 2, 0)

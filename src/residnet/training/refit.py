"""Refit of a baseline's parameters through rollouts: Gauss-Newton on free-run errors.

Sensitivities are carried forward with the rollout.

Least squares on derivatives weighs every instant alike and ignores how errors add up; this
minimises what a free run is judged by. The least-squares solution and its information matrix stand
as the prior, so that directions which the free runs do not see stay where the derivatives put them;
a baseline that holds beliefs about its parameters adds them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from residnet.baselines import ParametricBaseline
from residnet.core.errors import FitError
from residnet.core.layout import VELOCITIES, zero_acceleration
from residnet.core.samples import Samples
from residnet.data.windows import WindowStore
from residnet.dynamics.hybrid import HybridDynamics
from residnet.training.offsets import Arrow, Offsets, with_spread
from residnet.training.refit_config import RefitConfig
from residnet.training.sensitivities import OffsetBaseline, step_sensitivities


@dataclass(frozen=True)
class Refitted:
    """What a refit hands back.

    Attributes:
        covariance: of the free parameters, [P, P]; what offsets leave open is in it.
        notes: cost before and after, iterations, windows, horizon, independent errors.
        offsets: of each log in the store.
    """

    covariance: Tensor
    notes: dict[str, Any]
    offsets: Offsets

    @property
    def errors(self) -> Tensor:
        """Standard errors [P] of the free parameters."""
        return self.covariance.diagonal().clamp(min=0.0).sqrt()


@dataclass(frozen=True)
class _Problem:
    """Windows x0 [B, 6], w [B, T, m], measured nu [B, T, 3], weights [B, T, 3] (0 or 1/scale);
    numbers of the free parameters [P]; precision [P, P] about where least squares put them [P],
    pull to zero [P]; beliefs, mean and precision [P]; count of independent errors per channel; log
    of each window [B]; speed at which offsets are what they are said to be.
    """

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
    log: Tensor
    speed: float

    def share(self, level: Tensor) -> Tensor:
        """Return half of what one unit of minus the logarithm of a probability costs.

        The cost is `level`.

        With c the mean square error of three channels of so many independent errors each, that
        logarithm grows by 3 N / 2c for each unit of c, and the cost sqrt(c + robust^2) by 1 / (2
        cost).
        """
        return (level.square() - self.robust**2).clamp(min=1e-12) / (6.0 * self.count * level)


def refit(
    model: HybridDynamics, samples: Samples, store: WindowStore, config: RefitConfig, scales: Tensor
) -> Refitted:
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
        raise FitError(
            "a refit through rollouts needs a baseline of kind 'regressors', 'linear_steady',"
            " 'mmg', 'nomoto' or 'nomoto_sideslip'"
        )
    problem = _problem(model, baseline, samples, store, config, scales)
    # spreads that are to be estimated start from what moves a velocity by its scale while errors
    # hang together
    offsets = Offsets.begin(
        config.offsets, int(store.log.max()) + 1, scales / config.correlation, problem.speed
    )
    level, squares = _level(model, problem, offsets)
    first = level
    if not torch.isfinite(first):
        raise FitError(
            "the least-squares baseline diverges within the refit's horizon; shorten `horizon` or"
            " raise the baseline's ridge"
        )
    damping, count = 1e-3, 0
    arrow = _normal_equations(model, problem, baseline, level, squares, offsets)
    for _ in range(config.iterations):
        offsets = with_spread(offsets, arrow, problem.share(level))
        step = _descend(model, problem, baseline, arrow, offsets, level, damping)
        if step is None:
            break
        level, squares, offsets, damping, gain = step
        count += 1
        arrow = _normal_equations(model, problem, baseline, level, squares, offsets)
        if gain < 2e-4:
            break
    share = problem.share(level)
    believing = arrow.believing(offsets, share)
    inverse = torch.linalg.pinv(believing.reduced()[0], hermitian=True)
    notes = {
        "cost_before": float(first),
        "cost_after": float(level),
        "iterations": count,
        "windows": len(problem.x0),
        "horizon": config.horizon,
    }
    error = (share * believing.variances(inverse)).clamp(min=0.0).sqrt()
    return Refitted(
        share * inverse,
        notes | {"independent_errors": round(problem.count, 1)},
        replace(offsets, error=error),
    )


def _descend(
    model: HybridDynamics,
    problem: _Problem,
    baseline: ParametricBaseline,
    arrow: Arrow,
    offsets: Offsets,
    level: Tensor,
    damping: float,
) -> tuple[Tensor, Tensor, Offsets, float, float] | None:
    """One step of Levenberg and Marquardt: level, errors of the windows, offsets and damping after
    it, and its gain as a share of the cost; None where nothing gains.
    """
    share = problem.share(level)
    believing = arrow.believing(offsets, share)
    cost = level + _prior_cost(problem, baseline, share, offsets)
    kept = baseline.theta.detach().flatten()[problem.active].clone()
    for _attempt in range(8):
        step, offset_step = believing.damped(damping).solve()
        _place(baseline, kept - step, problem.active)
        moved = offsets.moved(offset_step)
        reached, squares = _level(model, problem, moved)
        trial = reached + _prior_cost(problem, baseline, share, moved)
        if torch.isfinite(trial) and trial < cost:
            gain = float(cost - trial) / float(cost)
            return reached, squares, moved, max(damping / 10, 1e-8), gain
        damping *= 10
    _place(baseline, kept, problem.active)
    return None


def _place(baseline: ParametricBaseline, values: Tensor, active: Tensor) -> None:
    """Set the free parameters."""
    with torch.no_grad():
        flat = baseline.theta.detach().clone().flatten()
        flat[active] = values
        baseline.theta.copy_(flat.reshape(baseline.theta.shape))


def free_run_starts(store: WindowStore, config: RefitConfig, dt: float) -> Tensor:
    """Return the rows at which the free runs of a refit start.

    Args:
        store: training windows.
        config: settings.
        dt: step in s.

    Raises:
        FitError: where no log is long enough.
    """
    steps, every = round(config.horizon / dt), max(round(config.every / dt), 1)
    starts = store.starts(steps + 1)
    starts = starts[store.depth[starts] % every == 0]
    if starts.numel() == 0:
        raise FitError(
            f"no training log holds a free run of {config.horizon:g} s for the refit; shorten"
            " `horizon`"
        )
    return starts


def _problem(
    model: HybridDynamics,
    baseline: ParametricBaseline,
    samples: Samples,
    store: WindowStore,
    config: RefitConfig,
    scales: Tensor,
) -> _Problem:
    steps = round(config.horizon / model.dt)
    starts = free_run_starts(store, config, model.dt)
    take = store.take
    nu = take(store.y, starts + 1, steps)[..., VELOCITIES]
    usable = take(store.usable, starts + 1, steps).to(scales.dtype).unsqueeze(-1)
    # r comes from a gyro, which a frozen position does not disturb
    weight = torch.cat((usable, usable, torch.ones_like(usable)), dim=-1) / scales
    active = baseline.free_indices()
    covered = (starts[:, None] + torch.arange(1, steps + 1)).unique().numel()
    believed, belief = baseline.prior()
    return _Problem(
        store.y[starts],
        take(store.w, starts, steps),
        nu,
        weight,
        active,
        config.prior * baseline.information(samples),
        baseline.theta.detach().flatten()[active].clone(),
        config.asymmetric * baseline.asymmetry(samples),
        believed,
        belief,
        max(covered * model.dt / config.correlation, 1.0),
        config.robust,
        store.log[starts],
        float(nu[:, :, :2].square().sum(2).mean().sqrt()),
    )


def _prior_cost(
    problem: _Problem, baseline: ParametricBaseline, share: Tensor, offsets: Offsets
) -> Tensor:
    theta = baseline.theta.detach().flatten()[problem.active]
    moved, off = theta - problem.start, theta - problem.believed
    believed = (problem.belief * off.square()).sum() + offsets.unlikely()
    return (
        moved @ problem.precision @ moved + (problem.pull * theta.square()).sum() + share * believed
    )


def _shifted(
    model: HybridDynamics, problem: _Problem, offsets: Offsets
) -> tuple[HybridDynamics, ParametricBaseline | OffsetBaseline]:
    """The model with the offset of its log in every window, and its baseline."""
    assert isinstance(model.baseline, ParametricBaseline)
    if not offsets.axes:
        return model, model.baseline
    baseline = OffsetBaseline(
        model.baseline, offsets.accelerations()[problem.log], offsets.axes, offsets.speed
    )
    return HybridDynamics(model.signals, baseline, model.head, model.dt, model.integrator), baseline


def _ahead(model: HybridDynamics, x: Tensor, p: Tensor) -> Tensor:
    """The step of the rollout, without a residual."""
    return model.integrate(x, p, zero_acceleration(x))


@torch.no_grad()
def _level(model: HybridDynamics, problem: _Problem, offsets: Offsets) -> tuple[Tensor, Tensor]:
    """Mean error of the windows in units of the scales, and mean square error of each [B]."""
    x, total = problem.x0, []
    shifted, _ = _shifted(model, problem, offsets)
    for k in range(problem.w.shape[1]):
        x = _ahead(shifted, x, model.signals.prepare(problem.w[:, k]))
        total.append(x[:, VELOCITIES])
    error = (torch.stack(total, dim=1) - problem.nu) * problem.weight
    squares = error.square().mean((1, 2))
    return torch.sqrt(squares + problem.robust**2).mean(), squares


@torch.no_grad()
def _normal_equations(
    model: HybridDynamics,
    problem: _Problem,
    baseline: ParametricBaseline,
    level: Tensor,
    squares: Tensor,
    offsets: Offsets,
) -> Arrow:
    """Gauss-Newton Hessian and half the gradient of the robust cost, as yet without what is
    believed of the offsets.

    The windows' weights follow from their errors `squares`, which the search for this point has
    computed; so one matrix product a step sums over all windows.
    """
    batch, steps = problem.w.shape[:2]
    shared, logs = int(problem.active.numel()), len(offsets.value)
    count = shared + len(offsets.axes)
    shifted, baseline_with_offsets = _shifted(model, problem, offsets)
    x = problem.x0
    sensitivity = torch.zeros(batch, 4, count, dtype=x.dtype)
    hessian = torch.zeros(count, count, dtype=x.dtype)
    gradient = torch.zeros(count, dtype=x.dtype)
    columns = torch.zeros(logs, count, len(offsets.axes), dtype=x.dtype)
    slopes = torch.zeros_like(offsets.value)
    window = 0.5 / torch.sqrt(squares + problem.robust**2) / (3 * steps * batch)
    root = window.sqrt()[:, None, None] * problem.weight
    for k in range(steps):
        p = model.signals.prepare(problem.w[:, k])
        sensitivity = step_sensitivities(shifted, baseline_with_offsets, x, p, sensitivity)
        x = _ahead(shifted, x, p)
        error = (x[:, VELOCITIES] - problem.nu[:, k]) * root[:, k]
        seen = sensitivity[:, 1:] * root[:, k].unsqueeze(-1)
        flat = seen.reshape(-1, count)
        hessian.addmm_(flat.T, flat)
        gradient.addmv_(flat.T, error.reshape(-1))
        if offsets.axes:
            own = seen[:, :, shared:]
            columns.index_add_(0, problem.log, seen.transpose(1, 2) @ own)
            slopes.index_add_(0, problem.log, (own * error.unsqueeze(-1)).sum(1))
    theta = baseline.theta.flatten()[problem.active]
    belief = problem.share(level) * problem.belief
    prior = (
        problem.precision @ (theta - problem.start)
        + problem.pull * theta
        + belief * (theta - problem.believed)
    )
    return Arrow(
        hessian[:shared, :shared] + problem.precision + torch.diag(problem.pull + belief),
        columns[:, :shared],
        columns[:, shared:],
        gradient[:shared] + prior,
        slopes,
    )

"""Output-error identification of a baseline: Gauss-Newton on free-run errors.

Least squares on accelerations ignores how errors accumulate in a free run. The refit minimises the
free-run error of the metrics. Its prior is the least-squares solution with its information matrix,
which determines the parameters that the free runs do not excite. The prior of the baseline about
its parameters (`belief`), if any, is added.

Source: R. V. Jategaonkar, Flight Vehicle System Identification, 2015, chapter 4, for output-error.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from residnet.baselines.base import ParametricBaseline
from residnet.core.columns import all_but_pose, pose
from residnet.core.errors import FitError
from residnet.core.samples import Samples
from residnet.dynamics.hybrid import HybridDynamics
from residnet.engine.free_runs import compile_rollout
from residnet.engine.rollout import Rollout
from residnet.preprocessing.channel_values import estimate_noise_std
from residnet.preprocessing.windows import WindowStore
from residnet.regression.least_squares import DescentResult, minimize_levenberg_marquardt

if TYPE_CHECKING:
    from residnet.training.refit_config import RefitConfig

_ROWS_PER_BATCH = 1_024
"""Maximum number of Jacobians in memory at a time."""
_REGULARISATION = 1e-8
"""Regularisation relative to the information of each parameter; it keeps the Hessian definite."""
_MIN_NOISE = 1e-9
"""Smallest noise of an initial velocity, SI, for channels without visible noise."""
_MIN_GAIN = 2e-4
"""Relative decrease of the cost below which the search stops."""
_SIGN_ROUNDS = 8
"""Maximum number of rounds in which terms of the wrong sign are fixed at zero."""
_UNIDENTIFIABLE = 0.5
"""Fraction of the information about a parameter that comes from the prior, above which the
parameter counts as not identifiable.
"""
_DIVERGED = 1e3
"""Error, in units of the scales, above which a free run gives no search direction."""
_RUNS_PER_FIT = 10
"""Typical number of simulations of a refit, which decides whether compiling the rollout pays."""


@dataclass(frozen=True)
class RefitResult:
    """Result of a refit.

    Attributes:
        covariance: covariance of the free parameters [P, P].
        notes: cost before and after, number of iterations and windows, horizon, first horizon of
            the continuation, number of independent errors, parameters fixed at zero.
        unidentifiable: whether neither accelerations nor free runs determine a free parameter [P];
            such a parameter keeps its least-squares value.
    """

    covariance: Tensor
    notes: dict[str, Any]
    unidentifiable: Tensor

    @property
    def standard_errors(self) -> Tensor:
        return self.covariance.diagonal().clamp(min=0.0).sqrt()


class InitialStates(NamedTuple):
    """Measured initial velocities of free runs.

    Attributes:
        measured: measured velocities [B, n] in SI units.
        noise: standard deviation of their noise [n] in SI units.
    """

    measured: Tensor
    noise: Tensor


@dataclass(frozen=True)
class Problem:
    """Robust cost over B windows of T steps, and prior of P free parameters.

    Attributes:
        x0: initial states [B, 3 + n].
        inputs: inputs, constant over each step [B, T, m].
        measured: measured velocities after each step [B, T, n].
        weight: 1 / scale of each velocity; 0 for invalid samples [B, T, n].
        free: indices of the free parameters in theta [P].
        precision: precision of the prior from the least-squares fit [P, P].
        prior_mean: mean of this prior [P].
        regularisation: part of `precision` that does not depend on the data [P, P].
        symmetry: precision of the prior of port-starboard symmetry [P, P].
        belief_mean: mean of the prior of the baseline, see `ParametricBaseline.prior` [P].
        belief_precision: precision of this prior [P].
        fixed: whether a parameter is fixed at zero [P].
        independent_errors: effective sample size per channel.
        robust: error above which the loss of a window is linear, in scales.
        log_index: index of each window's log [B].
        initial: prior of the initial states; None if they are the measured states.
    """

    x0: Tensor
    inputs: Tensor
    measured: Tensor
    weight: Tensor
    free: Tensor
    precision: Tensor
    prior_mean: Tensor
    regularisation: Tensor
    symmetry: Tensor
    belief_mean: Tensor
    belief_precision: Tensor
    fixed: Tensor
    independent_errors: float
    robust: float
    log_index: Tensor
    initial: InitialStates | None = None

    def with_fixed(self, parameters: Sequence[int]) -> Problem:
        """Return the problem with further parameters fixed at zero."""
        fixed = self.fixed.clone()
        fixed[list(parameters)] = True
        return replace(self, fixed=fixed)

    def truncate(self, steps: int) -> Problem:
        """Return the problem over a shorter horizon."""
        cut = {name: getattr(self, name)[:, :steps] for name in ("inputs", "measured", "weight")}
        return replace(self, **cut)

    def mean_square(self, states: Tensor) -> Tensor:
        """Return the mean square error [B] of free runs [B, T + 1, 3 + n], in scales."""
        error = (all_but_pose(states[:, 1:]) - self.measured) * self.weight
        return error.square().mean((1, 2))

    def cost_per_nat(self, cost: Tensor) -> Tensor:
        """Return half the change of the cost per unit of negative log-likelihood (nat).

        Let c be the mean square error of n channels of N independent errors each. Per unit of c,
        the negative log-likelihood increases by n N / 2c and the cost sqrt(c + robust^2) by
        1 / (2 cost). The ratio converts the prior of the baseline to the unit of the cost.
        """
        mean_square = (cost.square() - self.robust**2).clamp(min=1e-12)
        return mean_square / (2.0 * self.measured.shape[-1] * self.independent_errors * cost)

    def inverse(self, hessian: Tensor) -> Tensor:
        """Return the inverse of a Hessian [P, P], zero for fixed parameters."""
        inverse: Tensor = torch.linalg.pinv(hessian, hermitian=True)
        inverse[self.fixed] = 0.0
        inverse[:, self.fixed] = 0.0
        return inverse

    def prior_cost(self, theta: Tensor, per_nat: Tensor) -> Tensor:
        """Return the cost of the priors.

        Args:
            theta: free parameters [P].
            per_nat: change of the cost per nat, see `cost_per_nat`.
        """
        from_prior = theta - self.prior_mean
        from_belief = theta - self.belief_mean
        quadratic = from_prior @ self.precision @ from_prior + theta @ self.symmetry @ theta
        return quadratic + per_nat * (self.belief_precision * from_belief.square()).sum()


def require_parametric_baseline(model: HybridDynamics) -> ParametricBaseline:
    """Return the baseline of a model if it has free parameters.

    Raises:
        FitError: if the baseline has no free parameters.
    """
    if not isinstance(model.baseline, ParametricBaseline):
        raise FitError(
            "a refit through rollouts needs a baseline of kind 'regressors', 'linear_steady',"
            " 'mmg', 'nomoto' or 'nomoto_sideslip'"
        )
    return model.baseline


def find_free_run_starts(store: WindowStore, config: RefitConfig, dt: float) -> Tensor:
    """Return the rows of the store at which free runs start.

    Raises:
        FitError: if no log is long enough.
    """
    return torch.from_numpy(config.find_free_run_starts(store.index, dt))


def build_problem(
    model: HybridDynamics,
    samples: Samples,
    store: WindowStore,
    config: RefitConfig,
    scales: Tensor,
) -> Problem:
    """Return the refit problem after a least-squares fit to `samples`; no parameter is fixed."""
    baseline = require_parametric_baseline(model)
    steps = round(config.horizon / model.dt)
    starts = find_free_run_starts(store, config, model.dt)
    usable = store.take_windows(store.usable, starts + 1, steps).to(scales.dtype).unsqueeze(-1)
    # u and v come from positions, which can freeze; an IMU measures the other velocities
    from_imu = torch.ones_like(usable).expand(-1, -1, model.dof - 2)
    information = baseline.mean_information(samples)
    regularisation = torch.diag(_REGULARISATION * information.diagonal())
    belief_mean, belief_precision = baseline.prior()
    initial = None
    if config.starts == "estimated":
        logs = [
            all_but_pose(store.y[store.log_index == k]).numpy().T for k in store.log_index.unique()
        ]
        noise = torch.tensor([[estimate_noise_std(channel) for channel in log] for log in logs])
        noise = noise.to(store.y.dtype).median(0).values.clamp(min=_MIN_NOISE)
        initial = InitialStates(all_but_pose(store.y[starts]), noise)
    n_covered = (starts[:, None] + torch.arange(1, steps + 1)).unique().numel()
    free = baseline.free_indices()
    return Problem(
        x0=store.y[starts],
        inputs=store.take_windows(store.w, starts, steps),
        measured=all_but_pose(store.take_windows(store.y, starts + 1, steps)),
        weight=torch.cat((usable, usable, from_imu), dim=-1) / scales,
        free=free,
        precision=config.prior * information + regularisation,
        prior_mean=baseline.get_free(),
        regularisation=regularisation,
        symmetry=config.asymmetric * baseline.symmetry_precision(samples),
        belief_mean=belief_mean,
        belief_precision=belief_precision,
        fixed=torch.zeros(free.numel(), dtype=torch.bool),
        # the mean error is over all channels, of which some may be zero at all times
        independent_errors=max(n_covered * model.dt / config.correlation, 1.0)
        * float(model.active_mask.mean()),
        robust=config.robust,
        log_index=store.log_index[starts],
        initial=initial,
    )


@torch.no_grad()
def simulate(model: HybridDynamics, problem: Problem) -> tuple[Tensor, Tensor]:
    """Return the robust cost of the windows, and their free runs [B, T + 1, 3 + n]."""
    run = compile_rollout(Rollout(model), _RUNS_PER_FIT * problem.inputs.shape[1])
    states, _, _ = run(problem.x0, problem.inputs, problem.x0[:, :0])
    return torch.sqrt(problem.mean_square(states) + problem.robust**2).mean(), states


def sensitivities(
    model: HybridDynamics, x: Tensor, w: Tensor, *, to_start: bool = False
) -> Iterator[tuple[slice, Tensor]]:
    """Yield exact sensitivities of free runs for consecutive blocks of K steps.

    The recursion is s[k + 1] = A[k] s[k] + B[k].

    Args:
        model: a baseline without a head.
        x: states at the start of each step [B, T, 3 + n].
        w: inputs of the steps [B, T, m].
        to_start: whether to differentiate with respect to the initial heading and velocities
            instead of the free parameters.

    Yields:
        Slice of the steps, and sensitivities of heading and velocities [K, B, 1 + n, P], or
        [K, B, 1 + n, 1 + n] with `to_start`.
    """
    batch, total = w.shape[:2]
    # imported here because it imports CasADi, which only a refit needs
    from residnet.engine.jacobian import StepJacobian

    jacobian = StepJacobian.of_model(model)
    s = torch.zeros(batch, 1 + model.dof, len(jacobian.free_indices), dtype=x.dtype)
    if to_start:
        s = torch.eye(1 + model.dof, dtype=x.dtype).expand(batch, -1, -1)
    block_length = max(_ROWS_PER_BATCH // max(batch, 1), 1)
    for begin in range(0, total, block_length):
        steps = slice(begin, min(begin + block_length, total))
        by_state, by_parameter = (
            part.unflatten(0, (-1, batch))
            for part in jacobian(*(a[:, steps].transpose(0, 1).flatten(0, 1) for a in (x, w)))
        )
        block = []
        for a, b in zip(by_state, by_parameter, strict=True):
            s = a @ s if to_start else torch.baddbmm(b, a, s)
            block.append(s)
        yield steps, torch.stack(block)


@torch.no_grad()
def normal_equations(
    model: HybridDynamics, problem: Problem, cost: Tensor, states: Tensor
) -> tuple[Tensor, Tensor]:
    """Return half the Gauss-Newton Hessian [P, P] and half the gradient [P] of cost and prior.

    The step -hessian^-1 gradient is the same as without the factors of one half.

    Args:
        model: a baseline without a head.
        problem: windows and prior.
        cost: robust cost of the free runs.
        states: states of the free runs [B, T + 1, 3 + n].
    """
    batch, steps = problem.inputs.shape[:2]
    count = len(problem.free)
    hessian = torch.zeros(count, count, dtype=states.dtype)
    gradient = torch.zeros(count, dtype=states.dtype)
    # d sqrt(m + c^2) = dm / (2 sqrt(m + c^2)): this is the weight of each window
    rms = torch.sqrt(problem.mean_square(states) + problem.robust**2)
    root_window_weight = (0.5 / rms / (model.dof * steps * batch)).sqrt()[:, None, None]
    root_weight = (root_window_weight * problem.weight).transpose(0, 1)
    error = (all_but_pose(states[:, 1:]) - problem.measured).transpose(0, 1) * root_weight
    for part, s in sensitivities(model, states[:, :-1], problem.inputs):
        rows = (s[:, :, 1:] * root_weight[part].unsqueeze(-1)).flatten(0, 2)
        hessian.addmm_(rows.T, rows)
        gradient.addmv_(rows.T, error[part].flatten())
    theta = require_parametric_baseline(model).get_free()
    belief = problem.cost_per_nat(cost) * problem.belief_precision
    hessian = hessian + problem.precision + problem.symmetry + torch.diag(belief)
    gradient = gradient + problem.precision @ (theta - problem.prior_mean)
    gradient = gradient + problem.symmetry @ theta + belief * (theta - problem.belief_mean)
    # a fixed parameter keeps its diagonal entry, so that the Hessian is invertible; its step is 0
    free = ~problem.fixed
    return hessian * (free[:, None] & free | torch.eye(count).bool()), gradient * free


class _Iterate(NamedTuple):
    """A point of the Gauss-Newton search.

    Attributes:
        theta: free parameters [P].
        cost: cost at these parameters.
        states: states of the free runs with these parameters [B, T + 1, 3 + n].
    """

    theta: Tensor
    cost: Tensor
    states: Tensor


def _gauss_newton(
    model: HybridDynamics, problem: Problem, iterations: int
) -> DescentResult[_Iterate]:
    """Minimise over the parameters, with Levenberg-Marquardt damping."""
    baseline = require_parametric_baseline(model)

    def evaluate(theta: Tensor) -> _Iterate:
        baseline.set_free(theta)
        return _Iterate(theta, *simulate(model, problem))

    def linearise(point: _Iterate) -> tuple[float, Callable[[float], tuple[float, _Iterate]]]:
        baseline.set_free(point.theta)
        hessian, gradient = normal_equations(model, problem, point.cost, point.states)
        per_nat = problem.cost_per_nat(point.cost)

        def trial(damping: float) -> tuple[float, _Iterate]:
            damped = hessian + damping * torch.diag(hessian.diagonal())
            new = evaluate(point.theta - torch.linalg.solve(damped, gradient))
            return float(new.cost + problem.prior_cost(new.theta, per_nat)), new

        return float(point.cost + problem.prior_cost(point.theta, per_nat)), trial

    result = minimize_levenberg_marquardt(
        evaluate(baseline.get_free()), linearise, iterations, min_relative_decrease=_MIN_GAIN
    )
    baseline.set_free(result.minimizer.theta)
    return result


@torch.no_grad()
def estimate_initial_states(model: HybridDynamics, problem: Problem) -> Problem:
    """Return the problem after one Gauss-Newton step of the initial states.

    Without a prior of the initial states the problem is returned unchanged. Sensor noise is
    independent from sample to sample. The model error may be constant over the window, so that
    T samples contain no more information about it than one: its variance is multiplied by T.
    """
    if problem.initial is None:
        return problem
    states = simulate(model, problem)[1]
    error = all_but_pose(states[:, 1:]) - problem.measured
    counts = problem.weight > 0.0
    noise = problem.initial.noise.square()
    mean_square = (error.square() * counts).sum((0, 1)) / counts.sum((0, 1)).clamp(min=1)
    variance = noise + (mean_square - noise).clamp(min=0.0) * error.shape[1]
    rms = torch.sqrt(problem.mean_square(states) + problem.robust**2)
    root_weight = counts / (variance * (rms / rms.mean())[:, None]).sqrt()[:, None]
    nu0 = all_but_pose(problem.x0)
    hessian = torch.diag(1.0 / noise).repeat(len(states), 1, 1)
    gradient = (nu0 - problem.initial.measured) / noise
    for part, s in sensitivities(model, states[:, :-1], problem.inputs, to_start=True):
        weight = root_weight[:, part].transpose(0, 1)
        rows = s[:, :, 1:, 1:] * weight.unsqueeze(-1)
        hessian += torch.einsum("kbij,kbil->bjl", rows, rows)
        gradient += torch.einsum("kbij,kbi->bj", rows, error[:, part].transpose(0, 1) * weight)
    return replace(
        problem,
        x0=torch.cat((pose(problem.x0), nu0 - torch.linalg.solve(hessian, gradient)), dim=1),
    )


def _fit_growing_horizon(
    model: HybridDynamics, problem: Problem, iterations: int
) -> tuple[int, int]:
    """Fit over growing horizons until the free runs over the complete horizon are finite.

    This is a continuation method: the minimum over a short horizon is the initial value of the
    search over a longer one.

    Returns:
        Number of steps of the first horizon, and number of iterations.

    Raises:
        FitError: if the free runs diverge at the first step or after each further step.
    """

    def diverges(steps: int) -> bool:
        cost = float(simulate(model, problem.truncate(steps))[0])
        # a single step is nearly linear in the parameters: any finite cost gives a direction
        return not (cost < _DIVERGED or (steps == 1 and cost < torch.inf))

    total = problem.inputs.shape[1]
    horizon = 0
    first_horizon = 0
    n_iterations = 0
    while horizon < total:
        # double the horizon, then halve the increase until the free runs are finite
        next_horizon = min(2 * horizon, total) if horizon else total
        while next_horizon > horizon and diverges(next_horizon):
            next_horizon = horizon + (next_horizon - horizon) // 2
        if next_horizon == horizon:
            raise FitError(
                "the least-squares baseline diverges within the refit's horizon; shorten `horizon`"
                " or raise the baseline's ridge"
            )
        first_horizon = first_horizon or next_horizon
        horizon = next_horizon
        if horizon < total:
            n_iterations += _gauss_newton(model, problem.truncate(horizon), iterations).n_steps
    return first_horizon, n_iterations


def refit(
    model: HybridDynamics,
    samples: Samples,
    store: WindowStore,
    config: RefitConfig,
    scales: Tensor,
    initial_theta: Tensor | None = None,
) -> RefitResult:
    """Fit the parameters of `model.baseline` to free runs by output error (float64).

    Args:
        model: a baseline without a head, fitted by least squares; its parameters are changed.
        samples: samples of the least-squares fit.
        store: training windows, float64.
        config: settings of the refit.
        scales: scales of the velocities, SI [n].
        initial_theta: parameters at which the search begins, for example from a similar refit; None
            for the least-squares solution, which is always the prior.

    Raises:
        FitError: if the free runs diverge at the first step, or the continuation over growing
            horizons cannot extend the horizon.
    """
    baseline = require_parametric_baseline(model)
    problem = build_problem(model, samples, store, config, scales)
    if initial_theta is not None:
        with torch.no_grad():
            baseline.theta.copy_(initial_theta)
    cost, _ = simulate(model, problem)
    n_iterations = 0
    first_horizon = problem.inputs.shape[1]
    if not torch.isfinite(cost):
        first_horizon, n_iterations = _fit_growing_horizon(model, problem, config.iterations)
        cost, _ = simulate(model, problem)
    cost_before = cost
    undamped: list[int] = []
    for _ in range(_SIGN_ROUNDS):
        result = _gauss_newton(model, problem, config.iterations)
        n_iterations += result.n_steps
        # alternate with steps of the initial states while these lower the cost
        for _ in range(config.iterations if problem.initial else 0):
            candidate = estimate_initial_states(model, problem)
            if not simulate(model, candidate)[0] < (1.0 - _MIN_GAIN) * result.minimizer.cost:
                break
            problem = candidate
            result = _gauss_newton(model, problem, config.iterations)
            n_iterations += result.n_steps
        cost = result.minimizer.cost
        if destabilising := baseline.destabilising_terms():
            problem = problem.with_fixed(destabilising)
        elif new_undamped := baseline.undamped_terms(samples):
            # without these terms the destabilising ones may have the correct sign: free them again
            undamped += new_undamped
            problem = replace(problem, fixed=torch.zeros_like(problem.fixed)).with_fixed(undamped)
        else:
            break
        baseline.set_free(baseline.get_free().masked_fill(problem.fixed, 0.0))
    hessian, _ = normal_equations(model, problem, *simulate(model, problem))
    inverse = problem.inverse(hessian)
    return RefitResult(
        covariance=problem.cost_per_nat(cost) * inverse,
        notes={
            "cost_before": float(cost_before),
            "cost_after": float(cost),
            "iterations": n_iterations,
            "windows": len(problem.x0),
            "horizon": config.horizon,
            "begun_over": first_horizon * model.dt,
            "independent_errors": round(problem.independent_errors, 1),
            "at_rest": torch.nonzero(problem.fixed).squeeze(1).tolist(),
        },
        unidentifiable=(inverse @ problem.regularisation).diagonal() > _UNIDENTIFIABLE,
    )

"""Refit of a baseline's parameters through rollouts: Gauss-Newton on free-run errors.

Sensitivities are carried forward with the rollout.

Least squares on derivatives weighs every instant alike and ignores how errors add up; this
minimises what a free run is judged by. The least-squares solution and its information matrix stand
as the prior, so that directions which the free runs do not see stay where the derivatives put them;
a baseline that holds beliefs about its parameters adds them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, final

import torch
from pydantic import Field
from torch import Tensor

from residnet.baselines.base import Baseline, ParametricBaseline
from residnet.core.config import Config, Seconds
from residnet.core.errors import FitError
from residnet.core.layout import HEADING, PLANAR, VELOCITIES, YAW_RATE, zero_acceleration
from residnet.core.samples import Samples
from residnet.data.windows import WindowStore
from residnet.dynamics.hybrid import HybridDynamics
from residnet.training.offsets import Arrow, Offsets, OffsetsConfig, with_spread

# sensitivities have a row for the heading and one for each velocity
_HEADING_ROW = slice(0, 1)
_YAW_RATE_ROW = slice(YAW_RATE - HEADING, len(PLANAR.names) - HEADING)


@final
class OffsetBaseline(Baseline):
    """A baseline with an acceleration of its own for every row of a batch.

    The accelerations grow with the square of the speed, as hull forces do.

    Args:
        baseline: as it is without.
        value: accelerations [B, 3] at `speed`; a batch of several times B rows repeats them.
        axes: a of surge, sway and yaw (0, 1, 2), in which the values may move.
        speed: in m/s.
    """

    def __init__(
        self, baseline: ParametricBaseline, value: Tensor, axes: Sequence[int], speed: float
    ) -> None:
        super().__init__()
        self.baseline = baseline
        self.value = value
        self.unit = torch.eye(3, dtype=value.dtype)[:, list(axes)]
        self.speed = speed

    def forward(self, z: Tensor) -> Tensor:
        offsets = self.value.repeat(z.shape[0] // self.value.shape[0], 1)
        nu_dot: Tensor = self.baseline(z) + self.growth(z) * offsets
        return nu_dot

    def growth(self, z: Tensor) -> Tensor:
        """Return the square of the speed over that at which the values hold, [B, 1]."""
        return z[:, :2].square().sum(1, keepdim=True) / self.speed**2

    def along(self, z: Tensor, ahead: Tensor) -> Tensor:
        """Return the derivatives of nu_dot [D, B, 3] at z [B, nz] along directions [D, B, nz]."""
        offsets = self.value.repeat(z.shape[0] // self.value.shape[0], 1)
        growth = 2.0 * (z[:, :2] * ahead[..., :2]).sum(-1, keepdim=True) / self.speed**2
        return self.baseline.along(z, ahead) + growth * offsets

    def parameter_count(self) -> list[float]:
        """Return the parameters of each axis; the offsets are no part of the model."""
        return self.baseline.parameter_count()

    def sensitivity(self, z: Tensor) -> Tensor:
        """Return the derivative of nu_dot by free parameters and offsets, [B, 3, P + a].

        The parameters are those that the baseline may move; the offsets are the row's own.
        """
        return torch.cat(
            (self.baseline.sensitivity(z), self.growth(z).unsqueeze(-1) * self.unit), dim=2
        )


def step_sensitivities(
    model: HybridDynamics,
    baseline: ParametricBaseline | OffsetBaseline,
    x: Tensor,
    p: Tensor,
    s: Tensor,
) -> Tensor:
    """Return the sensitivities of (psi, u, v, r) one step later, [B, 4, P].

    They are the exact derivative of `Dynamics.integrate` with the residual at zero, whatever the
    integrator.

    Args:
        model: that steps.
        baseline: its baseline.
        x: states at the step's start [B, 6].
        p: prepared inputs, held over the step [B, k].
        s: sensitivities at the step's start [B, 4, P].
    """
    stage_x, stage_s = x, s
    after, stage_rate = s, s
    for node, weight in zip(model.nodes, model.weights, strict=True):
        if node > 0.0:
            stage_s = torch.add(s, stage_rate, alpha=node * model.dt)
            residual = zero_acceleration(x)
            stage_x = x + node * model.dt * model.rate(stage_x, p, residual)
        z = model.signals(stage_x, p)
        slopes = baseline.along(z, model.signals.slopes(stage_x, p)).permute(1, 2, 0)
        nu_dot = torch.baddbmm(baseline.sensitivity(z), slopes, stage_s)
        stage_rate = torch.cat((stage_s[:, _YAW_RATE_ROW], nu_dot), dim=1)
        after = torch.add(after, stage_rate, alpha=weight * model.dt)
    if model.semi_implicit:
        # the heading moves with the new yaw rate
        turned = s[:, _HEADING_ROW] + model.dt * after[:, _YAW_RATE_ROW]
        after = torch.cat((turned, after[:, _HEADING_ROW.stop :]), dim=1)
    return after


_OWN = 1e-8
"""Weight of a parameter's own start, as a share of the information that the samples would hold if
all others were known; it says where a parameter stays that the data leave open.
"""


@dataclass(frozen=True)
class Problem:
    """Windows x0 [B, 6], w [B, T, m], measured nu [B, T, 3], weights [B, T, 3] (0 or 1/scale);
    numbers of the free parameters [P]; precision [P, P] about where least squares put them, the
    part of it that each parameter has for itself, whatever the data say, and that point [P];
    pull to the mirror symmetry [P, P]; beliefs, mean and precision [P]; which parameters stay at
    zero [P]; count of independent errors per channel; log of each window [B]; speed at which
    offsets are what they are said to be.
    """

    x0: Tensor
    w: Tensor
    nu: Tensor
    weight: Tensor
    active: Tensor
    precision: Tensor
    own: Tensor
    start: Tensor
    pull: Tensor
    believed: Tensor
    belief: Tensor
    still: Tensor
    count: float
    robust: float
    log: Tensor
    speed: float

    def at_rest(self, numbers: Sequence[int]) -> Problem:
        """Return the problem with further free parameters, by their numbers, that stay at zero."""
        still = self.still.clone()
        still[list(numbers)] = True
        return replace(self, still=still)

    def with_only(self, numbers: Sequence[int]) -> Problem:
        """Return the problem in which these free parameters stay at zero, and no others."""
        return replace(self, still=torch.zeros_like(self.still)).at_rest(numbers)

    def over(self, steps: int) -> Problem:
        """Return the problem whose free runs are so many steps long."""
        return replace(
            self, w=self.w[:, :steps], nu=self.nu[:, :steps], weight=self.weight[:, :steps]
        )

    def share(self, level: Tensor) -> Tensor:
        """Return half of what one unit of minus the logarithm of a probability costs.

        The cost is `level`.

        With c the mean square error of three channels of so many independent errors each, that
        logarithm grows by 3 N / 2c for each unit of c, and the cost sqrt(c + robust^2) by 1 / (2
        cost).
        """
        return (level.square() - self.robust**2).clamp(min=1e-12) / (6.0 * self.count * level)


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


def problem_of(
    model: HybridDynamics,
    baseline: ParametricBaseline,
    samples: Samples,
    store: WindowStore,
    config: RefitConfig,
    scales: Tensor,
) -> Problem:
    """Return the problem that least squares leave to a refit; nothing stays at zero as yet."""
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
    information = baseline.information(samples)
    own = torch.diag(_OWN * information.diagonal())
    return Problem(
        store.y[starts],
        take(store.w, starts, steps),
        nu,
        weight,
        active,
        config.prior * information + own,
        own,
        baseline.theta.detach().flatten()[active].clone(),
        config.asymmetric * baseline.asymmetry(samples),
        believed,
        belief,
        torch.zeros(active.numel(), dtype=torch.bool),
        max(covered * model.dt / config.correlation, 1.0),
        config.robust,
        store.log[starts],
        float(nu[:, :, :2].square().sum(2).mean().sqrt()),
    )


class RefitConfig(Config):
    """Settings of the Gauss-Newton refit of a baseline's parameters.

    Attributes:
        horizon: length of the free runs in s.
        every: time between their starts in s.
        prior: weight of the least-squares solution, as a share of its own information.
        asymmetric: shrinks terms that a mirror-symmetric vessel cannot have towards zero; 0 for no
            such knowledge.
        robust: windows whose error (in units of the scales) is far above this count by their error
            and not by its square.
        correlation: time over which errors of a free run hang together; the logs hold so many
            independent errors, which says how much beliefs weigh beside them, and how large the
            standard errors are.
        offsets: accelerations that each log has for itself (trim, rudder zero, carriage), estimated
            with the parameters and left out of the model; null where all logs are of exactly the
            same vessel. The least-squares prior does not know them: give it little weight.
        iterations: at most.
    """

    horizon: Seconds = Field(default=20.0, gt=0)
    every: Seconds = Field(default=10.0, gt=0)
    prior: float = Field(default=1e-2, ge=0)
    asymmetric: float = Field(default=0.0, ge=0)
    robust: float = Field(default=0.05, gt=0)
    correlation: Seconds = Field(default=10.0, gt=0)
    offsets: OffsetsConfig | None = None
    iterations: int = Field(default=10, ge=1, le=10_000)

    def with_prior(self, prior: float) -> RefitConfig:
        """Return the same settings with one strength of the prior."""
        return self.model_copy(update={"prior": prior})


__all__ = ["Refitted", "free_run_starts", "refit"]

_ROUNDS = 8
"""Times that terms which feed energy are looked for."""
_OPEN = 0.5
"""Share of a parameter's information that is the prior's, from which on the data leave it open."""
_ASTRAY = 1e3
"""Error in scales beyond which free runs do not tell which way to go."""


@dataclass(frozen=True)
class Refitted:
    """What a refit hands back.

    Attributes:
        covariance: of the free parameters, [P, P]; what offsets leave open is in it.
        notes: cost before and after, iterations, windows, horizon, the part of it in s that the
            search began with (all unless free runs diverged), independent errors; terms that
            were left out, since their sign would feed energy.
        open: which free parameters neither accelerations nor free runs determine [P]; they stay
            where least squares put them, which is near zero where these have a ridge.
        offsets: of each log in the store.
    """

    covariance: Tensor
    notes: dict[str, Any]
    offsets: Offsets
    open: Tensor

    @property
    def errors(self) -> Tensor:
        """Standard errors [P] of the free parameters."""
        return self.covariance.diagonal().clamp(min=0.0).sqrt()


def refit(
    model: HybridDynamics,
    samples: Samples,
    store: WindowStore,
    config: RefitConfig,
    scales: Tensor,
    begin: Tensor | None = None,
) -> Refitted:
    """Move the parameters of `model.baseline` to the minimum; float64.

    Args:
        model: a baseline without a head, fitted by least squares.
        samples: the samples of that fit.
        store: training windows, float64.
        config: settings.
        scales: of the velocities, [3].
        begin: theta that the search begins at, where another refit has been near the minimum;
            None for the least-squares solution, which stays the prior in any case.

    Raises:
        FitError: where free runs diverge from the first step on, or from a later one whatever the
            minimum of those before it is.
    """
    baseline = model.baseline
    if not isinstance(baseline, ParametricBaseline):
        raise FitError(
            "a refit through rollouts needs a baseline of kind 'regressors', 'linear_steady',"
            " 'mmg', 'nomoto' or 'nomoto_sideslip'"
        )
    problem = problem_of(model, baseline, samples, store, config, scales)
    if begin is not None:
        with torch.no_grad():
            baseline.theta.copy_(begin)
    # spreads that are to be estimated start from what moves a velocity by its scale while errors
    # hang together
    offsets = Offsets.begin(
        config.offsets, int(store.log.max()) + 1, scales / config.correlation, problem.speed
    )
    level, _ = level_of(model, problem, offsets)
    count, begun = 0, problem.w.shape[1]
    turning: list[int] = []
    if not torch.isfinite(level):
        offsets, begun, count = _brought_near(model, problem, baseline, offsets, config.iterations)
        level, _ = level_of(model, problem, offsets)
    first = level
    for _round in range(_ROUNDS):
        level, offsets, steps = _minimised(model, problem, baseline, offsets, config.iterations)
        count += steps
        if feeding := baseline.feeding():
            problem = problem.at_rest(feeding)
        elif turned := baseline.undamped(samples):
            # what fed energy beside these may not without them
            turning += turned
            problem = problem.with_only(turning)
        else:
            break
        place(baseline, _values(baseline, problem), problem.active)
    arrow = normal_equations(model, problem, baseline, *level_of(model, problem, offsets), offsets)
    share = problem.share(level)
    believing = arrow.believing(offsets, share)
    inverse = torch.linalg.pinv(believing.reduced()[0], hermitian=True)
    inverse[problem.still] = 0.0
    inverse[:, problem.still] = 0.0
    error = (share * believing.variances(inverse)).clamp(min=0.0).sqrt()
    notes = {
        "cost_before": float(first),
        "cost_after": float(level),
        "iterations": count,
        "windows": len(problem.x0),
        "horizon": config.horizon,
        "begun_over": begun * model.dt,
        "independent_errors": round(problem.count, 1),
        "at_rest": torch.nonzero(problem.still).squeeze(1).tolist(),
    }
    left_open = (inverse @ problem.own).diagonal() > _OPEN
    return Refitted(share * inverse, notes, replace(offsets, error=error), left_open)


def _brought_near(
    model: HybridDynamics,
    problem: Problem,
    baseline: ParametricBaseline,
    offsets: Offsets,
    iterations: int,
) -> tuple[Offsets, int, int]:
    """Move the parameters to where free runs are finite over the whole horizon.

    The minimum over a part of the horizon that no free run leaves carries over a longer part.

    Returns:
        The offsets, the steps of the first part, and the steps of the search.
    """

    def diverges(part: int) -> bool:
        level = float(level_of(model, problem.over(part), offsets)[0])
        # a single step is nearly linear, and tells the way from anywhere
        return not (level < _ASTRAY or (part == 1 and level < torch.inf))

    whole = problem.w.shape[1]
    known, begun, count = 0, 0, 0
    while known < whole:
        part = min(2 * known, whole) if known else whole
        while part > known and diverges(part):
            part = known + (part - known) // 2
        if part == known:
            raise FitError(
                "the least-squares baseline diverges within the refit's horizon; shorten `horizon`"
                " or raise the baseline's ridge"
            )
        known, begun = part, begun or part
        if known < whole:
            shorter = problem.over(known)
            _, offsets, steps = _minimised(model, shorter, baseline, offsets, iterations)
            count += steps
    return offsets, begun, count


def _values(baseline: ParametricBaseline, problem: Problem) -> Tensor:
    """Return the free parameters as they are, those that are to rest at zero."""
    values = baseline.theta.detach().flatten()[problem.active].clone()
    values[problem.still] = 0.0
    return values


def _minimised(
    model: HybridDynamics,
    problem: Problem,
    baseline: ParametricBaseline,
    offsets: Offsets,
    iterations: int,
) -> tuple[Tensor, Offsets, int]:
    """Move parameters and offsets to the minimum; returns its level and the number of steps."""
    level, squares = level_of(model, problem, offsets)
    damping, count = 1e-3, 0
    arrow = normal_equations(model, problem, baseline, level, squares, offsets)
    for _ in range(iterations):
        offsets = with_spread(offsets, arrow, problem.share(level))
        step = _descend(model, problem, baseline, arrow, offsets, level, damping)
        if step is None:
            break
        level, squares, offsets, damping, gain = step
        count += 1
        arrow = normal_equations(model, problem, baseline, level, squares, offsets)
        if gain < 2e-4:
            break
    return level, offsets, count


def _descend(
    model: HybridDynamics,
    problem: Problem,
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
        place(baseline, kept - step, problem.active)
        moved = offsets.moved(offset_step)
        reached, squares = level_of(model, problem, moved)
        trial = reached + _prior_cost(problem, baseline, share, moved)
        if torch.isfinite(trial) and trial < cost:
            gain = float(cost - trial) / float(cost)
            return reached, squares, moved, max(damping / 10, 1e-8), gain
        damping *= 10
    place(baseline, kept, problem.active)
    return None


def place(baseline: ParametricBaseline, values: Tensor, active: Tensor) -> None:
    """Set the free parameters to values [P]; their places in theta are `active` [P]."""
    with torch.no_grad():
        flat = baseline.theta.detach().clone().flatten()
        flat[active] = values
        baseline.theta.copy_(flat.reshape(baseline.theta.shape))


def _prior_cost(
    problem: Problem, baseline: ParametricBaseline, share: Tensor, offsets: Offsets
) -> Tensor:
    theta = baseline.theta.detach().flatten()[problem.active]
    moved, off = theta - problem.start, theta - problem.believed
    believed = (problem.belief * off.square()).sum() + offsets.unlikely()
    return moved @ problem.precision @ moved + theta @ problem.pull @ theta + share * believed


def _shifted(
    model: HybridDynamics, problem: Problem, offsets: Offsets
) -> tuple[HybridDynamics, ParametricBaseline | OffsetBaseline]:
    """The model with the offset of its log in every window, and its baseline."""
    assert isinstance(model.baseline, ParametricBaseline)
    baseline: ParametricBaseline | OffsetBaseline = model.baseline
    if offsets.axes:
        baseline = OffsetBaseline(
            model.baseline, offsets.accelerations()[problem.log], offsets.axes, offsets.speed
        )
    shifted = HybridDynamics(model.signals, baseline, model.head, model.dt, model.integrator)
    # the cost is that of velocities
    shifted.positions = False
    return shifted, baseline


def _ahead(model: HybridDynamics, x: Tensor, p: Tensor) -> Tensor:
    """The step of the rollout, without a residual."""
    return model.advanced(x, model.signals(x, p), p, zero_acceleration(x))


@torch.no_grad()
def level_of(model: HybridDynamics, problem: Problem, offsets: Offsets) -> tuple[Tensor, Tensor]:
    """Return the mean error of the windows in scales, and the mean square error of each [B]."""
    x, total = problem.x0, []
    shifted, _ = _shifted(model, problem, offsets)
    for k in range(problem.w.shape[1]):
        x = _ahead(shifted, x, model.signals.prepare(problem.w[:, k]))
        total.append(x[:, VELOCITIES])
    error = (torch.stack(total, dim=1) - problem.nu) * problem.weight
    squares = error.square().mean((1, 2))
    return torch.sqrt(squares + problem.robust**2).mean(), squares


@torch.no_grad()
def normal_equations(
    model: HybridDynamics,
    problem: Problem,
    baseline: ParametricBaseline,
    level: Tensor,
    squares: Tensor,
    offsets: Offsets,
) -> Arrow:
    """Return the Gauss-Newton Hessian and half the gradient of the robust cost.

    What is believed of the offsets is not in it yet. The windows' weights follow from their errors
    `squares` [B], which the search for this point has computed; so one matrix product a step sums
    over all windows.
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
        + problem.pull @ theta
        + belief * (theta - problem.believed)
    )
    whole = hessian[:shared, :shared] + problem.precision + problem.pull + torch.diag(belief)
    moving = ~problem.still
    # what rests at zero has a row of its own, and takes no step
    alone = torch.diag(torch.where(moving, torch.zeros_like(theta), whole.diagonal()))
    return Arrow(
        torch.where(moving[:, None] & moving, whole, alone),
        columns[:, :shared] * moving[:, None],
        columns[:, shared:],
        (gradient[:shared] + prior) * moving,
        slopes,
    )

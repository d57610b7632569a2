"""Refit of a baseline's parameters through rollouts: Gauss-Newton on free-run errors.

Sensitivities are carried forward with the rollout.

Least squares on derivatives weighs every instant alike and ignores how errors add up; this
minimises what a free run is judged by. The least-squares solution and its information matrix stand
as the prior, so that directions which the free runs do not see stay where the derivatives put them;
a baseline that holds beliefs about its parameters adds them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from residnet.baselines.base import ParametricBaseline
from residnet.core.columns import (
    pose,
    roll_angle,
    velocities_on,
    yaw_rate,
    zero_acceleration,
)
from residnet.core.config import Config, Seconds
from residnet.core.errors import FitError
from residnet.core.frames import cross
from residnet.core.layout import ATTITUDE, HEADING, SIX, YAW_RATE
from residnet.core.samples import Samples
from residnet.data.channels import noise_of
from residnet.data.windows import WindowStore
from residnet.dynamics.free_runs import compiled
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.rollout import Rollout
from residnet.regression.least_squares import Descent, descend

# sensitivities have a row for the heading and one for each of what moves
_HEADING_ROW = slice(0, 1)
_YAW_RATE_ROW = slice(YAW_RATE - HEADING, YAW_RATE - HEADING + 1)


def parametric(model: HybridDynamics) -> ParametricBaseline:
    """Return the baseline of a model whose parameters can move.

    Raises:
        FitError: where they cannot.
    """
    if not isinstance(model.baseline, ParametricBaseline):
        raise FitError(
            "a refit through rollouts needs a baseline of kind 'regressors', 'linear_steady',"
            " 'mmg', 'nomoto' or 'nomoto_sideslip'"
        )
    return model.baseline


def step_sensitivities(model: HybridDynamics, x: Tensor, p: Tensor, s: Tensor) -> Tensor:
    """Return the sensitivities of heading and what moves one step later, [B, 1 + n, Q].

    They are the exact derivative of `Dynamics.integrate` with the residual at zero, whatever the
    integrator.

    Args:
        model: that steps.
        x: states at the step's start [B, 3 + n].
        p: prepared inputs, held over the step [B, k].
        s: sensitivities at the step's start [B, 1 + n, Q], those to the P free parameters last;
            those before them are to what the step itself does not depend on.
    """
    baseline = parametric(model)
    if model.spatial:
        return _spatial_sensitivities(model, baseline, x, p, s)
    stage_x, stage_s = x, s
    after, stage_rate = s, s
    for node, weight in zip(model.nodes, model.weights, strict=True):
        if node > 0.0:
            stage_s = torch.add(s, stage_rate, alpha=node * model.dt)
            residual = zero_acceleration(x, model.dof)
            stage_x = x + node * model.dt * model.rate(stage_x, p, residual)
        nu_dot = _accelerations(model, baseline, stage_x, p, stage_s)
        if model.rolls:
            nu_dot = nu_dot * model.live[:, None] + model.known_rates.T @ stage_s[:, 1:]
        stage_rate = torch.cat((_turned(model, stage_x, stage_s), nu_dot), dim=1)
        after = torch.add(after, stage_rate, alpha=weight * model.dt)
    if model.semi_implicit:
        # angles move with the new velocities
        new = x
        if model.rolls:
            angles = s[:, 1:] + model.dt * (model.known_rates.T @ after[:, 1:])
            after = torch.cat(
                (after[:, :1], torch.where(model.live[:, None] > 0.0, after[:, 1:], angles)), dim=1
            )
            new = _ahead(model, x, p)
        turned = s[:, _HEADING_ROW] + model.dt * _turned(model, new, after)
        after = torch.cat((turned, after[:, _HEADING_ROW.stop :]), dim=1)
    return after


def _accelerations(
    model: HybridDynamics, baseline: ParametricBaseline, x: Tensor, p: Tensor, s: Tensor
) -> Tensor:
    """Return the sensitivities [B, n, Q] of what the baseline accelerates at states x."""
    z = model.signals(x, p)
    nu_dot = baseline.along(z, model.signals.slopes(x, p)).permute(1, 2, 0) @ s
    own = baseline.sensitivity(z)
    nu_dot[..., -own.shape[-1] :] += own
    return nu_dot


_AT_ONCE = 1_024
"""Rows whose steps are differentiated at once: enough for torch, and few enough for a cache."""


def sensitivities(
    model: HybridDynamics, x: Tensor, w: Tensor, *, to_start: bool = False
) -> Iterator[tuple[slice, Tensor]]:
    """Yield sensitivities of free runs after some steps, and which: [K, B, 1 + n, P].

    What a step does to them does not depend on them, and is found for many steps at once. Those
    `to_start` are to heading and what moves at the start, [K, B, 1 + n, 1 + n].

    Args:
        model: that ran.
        x: states at the start of each step [B, T, 3 + n].
        w: inputs of the steps [B, T, m].
    """
    batch, total = w.shape[:2]
    count, own = len(parametric(model).free_indices()), 1 + model.dof
    start = torch.eye(own, own + count, dtype=x.dtype)
    s = start[:, :own].expand(batch, -1, -1) if to_start else x.new_zeros(batch, own, count)
    length = max(_AT_ONCE // max(batch, 1), 1)
    for begin in range(0, total, length):
        steps, found = slice(begin, min(begin + length, total)), []
        rows = [part[:, steps].transpose(0, 1).flatten(0, 1) for part in (x, w)]
        p = model.signals.prepare(rows[1])
        each = step_sensitivities(model, rows[0], p, start.expand(len(p), -1, -1))
        for one in each.unflatten(0, (-1, batch)):
            ahead, more = one[..., :own], one[..., own:]
            s = ahead @ s if to_start else torch.baddbmm(more, ahead, s)
            found.append(s)
        yield steps, torch.stack(found)


# of the rows of sensitivities in six degrees of freedom: those of an attitude, and what turns it
_ANGLES = [column - HEADING for column in ATTITUDE]
_U, _V, _R, _W, _P, _Q, _Z = (SIX.names.index(name) - HEADING for name in "uvrwpqz")


def _spatial_sensitivities(
    model: HybridDynamics, baseline: ParametricBaseline, x: Tensor, p: Tensor, s: Tensor
) -> Tensor:
    """Return `step_sensitivities` where rotations are composed: those of the angles themselves."""
    residual = zero_acceleration(x, model.dof)
    stage_x, stage_s, rate, slope = x, s, x, s
    change, moved = torch.zeros_like(x), torch.zeros_like(s)
    total, sensed = torch.zeros_like(x), torch.zeros_like(s)
    for node, weight in zip(model.nodes, model.weights, strict=True):
        if node > 0.0:
            change, moved = node * model.dt * rate, node * model.dt * slope
            stage_x = model.moved_on(x, change)
            stage_s = _composed(x, change, stage_x, s, moved)
        nu_dot = _accelerations(model, baseline, stage_x, p, stage_s)
        nu_dot = nu_dot * model.live[:, None]
        slope = _known_slopes(stage_x, stage_s, torch.cat((torch.zeros_like(s[:, :1]), nu_dot), 1))
        rate = model.rate(stage_x, p, residual)
        if node > 0.0:
            # the derivative of `Dynamics.from_start`
            turn, own = (part[:, ATTITUDE].unsqueeze(-1) for part in (change, rate))
            d_turn, d_own = moved[:, _ANGLES], slope[:, _ANGLES]
            bent = _crossed(turn, own)
            d_bent = _crossed(d_turn, own) + _crossed(turn, d_own)
            twice = (_crossed(d_turn, bent) + _crossed(turn, d_bent)) / 12.0
            slope[:, _ANGLES] = d_own + 0.5 * d_bent + twice
            rate = model.from_start(change, rate)
        total, sensed = total + weight * rate, sensed + weight * slope
    change, moved = model.dt * total, model.dt * sensed
    if model.semi_implicit:
        velocities = slice(_U, _Z)
        s = torch.cat((s[:, :_U], (s + moved)[:, velocities], s[:, _Z:]), dim=1)
        x = torch.cat((pose(x), velocities_on(x + change)[:, : _Z - _U], x[:, _Z + HEADING :]), 1)
        moved = model.dt * _known_slopes(x, s, torch.zeros_like(s))
        rate = torch.zeros_like(x)
        rate[:, ATTITUDE] = x[:, [HEADING + _P, HEADING + _Q, HEADING + _R]]
        change = model.dt * rate
    return _composed(x, change, model.moved_on(x, change), s, moved)


def _known_slopes(x: Tensor, s: Tensor, rates: Tensor) -> Tensor:
    """Return sensitivities [B, 10, P] of rates with those of depth and angles at states x."""
    phi, theta = (x[:, column, None] for column in ATTITUDE[:2])
    u, v, w = (x[:, HEADING + row, None] for row in (_U, _V, _W))
    (cf, sf), (ct, st) = ((torch.cos(one), torch.sin(one)) for one in (phi, theta))
    down = -st * s[:, _U] + ct * (sf * s[:, _V] + cf * s[:, _W])
    down = down + ct * (cf * v - sf * w) * s[:, _ANGLES[0]]
    rates[:, _Z] = down - (ct * u + st * (sf * v + cf * w)) * s[:, _ANGLES[1]]
    rates[:, _ANGLES] = s[:, [_P, _Q, _R]]
    return rates


def _composed(x: Tensor, change: Tensor, after: Tensor, s: Tensor, moved: Tensor) -> Tensor:
    """Return the sensitivities [B, 10, P] of states x after a change, from those of both.

    A change of angles turns the vessel by E of it, which the rotation that follows sees from where
    it leads; that rotation has the right Jacobian (Sola et al. 2018, A micro Lie theory, eqs. (143)
    and (145)).
    """
    turn = change[:, ATTITUDE]
    size = torch.sqrt(turn.square().sum(-1) + 1e-16)[:, None, None]
    unit = torch.eye(3, dtype=x.dtype, device=x.device)
    skew = torch.linalg.cross(unit.expand(len(x), 3, 3), turn[:, None].expand(-1, 3, -1), dim=-1)
    square, even = skew @ skew, (1.0 - torch.cos(size)) / size.square()
    back = unit - torch.sin(size) / size * skew + even * square
    right = unit - even * skew + (size - torch.sin(size)) / size**3 * square
    turned = back @ _axes(x) @ s[:, _ANGLES] + right @ moved[:, _ANGLES]
    out = s + moved
    out[:, _ANGLES] = torch.linalg.solve(_axes(after), turned)
    return out


def _axes(x: Tensor) -> Tensor:
    """Return E [B, 3, 3], the rotation about body axes by changes of roll, pitch and heading.

    Source: Fossen 2021, eq. (2.41), inverted.
    """
    phi, theta = (x[:, column] for column in ATTITUDE[:2])
    (cf, sf), (ct, st) = ((torch.cos(one), torch.sin(one)) for one in (phi, theta))
    zero, one = torch.zeros_like(cf), torch.ones_like(cf)
    rows = ((one, zero, -st), (zero, cf, ct * sf), (zero, -sf, ct * cf))
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=1)


def _crossed(a: Tensor, b: Tensor) -> Tensor:
    """Return the vector products [B, 3, P] along the second axis."""
    return cross(a.transpose(1, 2), b.transpose(1, 2)).transpose(1, 2)


def _turned(model: HybridDynamics, x: Tensor, s: Tensor) -> Tensor:
    """Return the sensitivities of the heading's rate [B, 1, P] at states x, from those s."""
    rate = s[:, _YAW_RATE_ROW]
    if not model.rolls:
        return rate
    phi, r = roll_angle(x)[:, None, None], yaw_rate(x)[:, None, None]
    # the roll angle stands last
    return torch.cos(phi) * rate - r * torch.sin(phi) * s[:, -1:]


_OWN = 1e-8
"""Weight of a parameter's own start, as a share of the information that the samples would hold if
all others were known; it says where a parameter stays that the data leave open.
"""


class Begins(NamedTuple):
    """What moves at the starts of free runs as it was measured [B, n], and its noise [n], SI."""

    measured: Tensor
    noise: Tensor


@dataclass(frozen=True)
class Problem:
    """Windows x0 [B, 3 + n], w [B, T, m], measured nu [B, T, n], weights [B, T, n] (0 or 1/scale);
    numbers of the free parameters [P]; precision [P, P] about where least squares put them, the
    part of it that each parameter has for itself, whatever the data say, and that point [P];
    pull to the mirror symmetry [P, P]; beliefs, mean and precision [P]; which parameters stay at
    zero [P]; count of independent errors per channel; log of each window [B]; what is known of
    the starts, where they are estimated, too.
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
    begins: Begins | None = None

    def at_rest(self, numbers: Sequence[int]) -> Problem:
        """Return the problem with further free parameters, by their numbers, that stay at zero."""
        still = self.still.clone()
        still[list(numbers)] = True
        return replace(self, still=still)

    def over(self, steps: int) -> Problem:
        """Return the problem whose free runs are so many steps long."""
        return replace(
            self, w=self.w[:, :steps], nu=self.nu[:, :steps], weight=self.weight[:, :steps]
        )

    def squares(self, states: Tensor) -> Tensor:
        """Return the mean square error in scales [B] of free runs of some steps [B, T+1, 3+n]."""
        error = (velocities_on(states[:, 1:]) - self.nu) * self.weight
        return error.square().mean((1, 2))

    def share(self, level: Tensor) -> Tensor:
        """Return half of what one unit of minus the logarithm of a probability costs.

        The cost is `level`.

        With c the mean square error of n channels of so many independent errors each, that
        logarithm grows by n N / 2c for each unit of c, and the cost sqrt(c + robust^2) by 1 / (2
        cost).
        """
        return (level.square() - self.robust**2).clamp(min=1e-12) / (
            2.0 * self.nu.shape[-1] * self.count * level
        )

    def inverse(self, hessian: Tensor) -> Tensor:
        """Return the inverse of a Hessian [P, P], zero for what rests at zero."""
        inverse: Tensor = torch.linalg.pinv(hessian, hermitian=True)
        inverse[self.still] = 0.0
        inverse[:, self.still] = 0.0
        return inverse

    def prior_cost(self, values: Tensor, share: Tensor) -> Tensor:
        """Return what is known of the free parameters [P] without free runs, at a `share`."""
        moved, off = values - self.start, values - self.believed
        known = moved @ self.precision @ moved + values @ self.pull @ values
        return known + share * (self.belief * off.square()).sum()


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
    samples: Samples,
    store: WindowStore,
    config: RefitConfig,
    scales: Tensor,
) -> Problem:
    """Return the problem that least squares leave to a refit; nothing stays at zero as yet."""
    baseline, steps = parametric(model), round(config.horizon / model.dt)
    starts = free_run_starts(store, config, model.dt)
    take = store.take
    nu = velocities_on(take(store.y, starts + 1, steps))
    usable = take(store.usable, starts + 1, steps).to(scales.dtype).unsqueeze(-1)
    # r comes from a gyro, which a frozen position does not disturb
    turning = torch.ones_like(usable).expand(-1, -1, model.dof - 2)
    weight = torch.cat((usable, usable, turning), dim=-1) / scales
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
        baseline.free(),
        config.asymmetric * baseline.asymmetry(samples),
        believed,
        belief,
        torch.zeros(active.numel(), dtype=torch.bool),
        # errors are means over all channels, of which some may be zero at all times
        max(covered * model.dt / config.correlation, 1.0) * float(model.living.mean()),
        config.robust,
        store.log[starts],
        None
        if config.starts == "measured"
        else Begins(velocities_on(store.y[starts]), _noise(store)),
    )


_LEAST = 1e-9
"""Noise, in SI, of what shows none."""


def _noise(store: WindowStore) -> Tensor:
    """Return the noise [n] of what moves, the median over the logs."""
    logs = [velocities_on(store.y[store.log == k]).numpy().T for k in store.log.unique()]
    each = torch.tensor([[noise_of(values) for values in log] for log in logs])
    return each.to(store.y.dtype).median(0).values.clamp(min=_LEAST)


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
        iterations: at most, for each estimate of the starts.
        starts: of free runs. `measured`: as measured, and as free runs are judged from. Their noise
            lasts in a vessel that is damped little, so that the minimum is one damped more.
            `estimated`: as the course after them and the measurement tell, each as far as its noise
            lets it, for coefficients that are to be those of the vessel.
    """

    horizon: Seconds = Field(default=20.0, gt=0)
    every: Seconds = Field(default=10.0, gt=0)
    prior: float = Field(default=1e-2, ge=0)
    asymmetric: float = Field(default=0.0, ge=0)
    robust: float = Field(default=0.05, gt=0)
    correlation: Seconds = Field(default=10.0, gt=0)
    iterations: int = Field(default=10, ge=1, le=10_000)
    starts: Literal["measured", "estimated"] = "measured"

    def with_prior(self, prior: float) -> RefitConfig:
        """Return the same settings with one strength of the prior."""
        return self.model_copy(update={"prior": prior})


__all__ = ["Refitted", "free_run_starts", "refit"]

_ROUNDS = 8
"""Times that terms which feed energy are looked for."""
_OPEN = 0.5
"""Share of a parameter's information that is the prior's, from which on the data leave it open."""
_GAIN = 2e-4
"""Share of the cost that a step must gain for another to be made."""
_ASTRAY = 1e3
"""Error in scales beyond which free runs do not tell which way to go."""


@dataclass(frozen=True)
class Refitted:
    """What a refit hands back.

    Attributes:
        covariance: of the free parameters, [P, P].
        notes: cost before and after, iterations, windows, horizon, the part of it in s that the
            search began with (all unless free runs diverged), independent errors; terms that
            were left out, since their sign would feed energy.
        open: which free parameters neither accelerations nor free runs determine [P]; they stay
            where least squares put them, which is near zero where these have a ridge.
    """

    covariance: Tensor
    notes: dict[str, Any]
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
        scales: of what moves, [n].
        begin: theta that the search begins at, where another refit has been near the minimum;
            None for the least-squares solution, which stays the prior in any case.

    Raises:
        FitError: where free runs diverge from the first step on, or from a later one whatever the
            minimum of those before it is.
    """
    baseline = parametric(model)
    problem = problem_of(model, samples, store, config, scales)
    if begin is not None:
        with torch.no_grad():
            baseline.theta.copy_(begin)
    level, _ = level_of(model, problem)
    count, begun = 0, problem.w.shape[1]
    turning: list[int] = []
    if not torch.isfinite(level):
        begun, count = _brought_near(model, problem, config.iterations)
        level, _ = level_of(model, problem)
    first = level
    for _round in range(_ROUNDS):
        problem, found = _with_starts(model, problem, config.iterations)
        level, count = found.point.level, count + found.steps
        if feeding := baseline.feeding():
            problem = problem.at_rest(feeding)
        elif turned := baseline.undamped(samples):
            # what fed energy beside these may not without them
            turning += turned
            problem = replace(problem, still=torch.zeros_like(problem.still)).at_rest(turning)
        else:
            break
        # those that are to rest at zero
        baseline.place(baseline.free().masked_fill(problem.still, 0.0))
    hessian, _ = normal_equations(model, problem, *level_of(model, problem))
    share, inverse = problem.share(level), problem.inverse(hessian)
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
    return Refitted(share * inverse, notes, left_open)


def _brought_near(model: HybridDynamics, problem: Problem, iterations: int) -> tuple[int, int]:
    """Move the parameters to where free runs are finite over the whole horizon.

    The minimum over a part of the horizon that no free run leaves carries over a longer part.

    Returns:
        The steps of the first part, and the steps of the search.
    """

    def diverges(part: int) -> bool:
        level = float(level_of(model, problem.over(part))[0])
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
            count += _minimised(model, problem.over(known), iterations).steps
    return begun, count


class _Reached(NamedTuple):
    """Free parameters [P], and level and states [B, T + 1, 3 + n] of free runs with them."""

    values: Tensor
    level: Tensor
    states: Tensor


def _minimised(model: HybridDynamics, problem: Problem, iterations: int) -> Descent[_Reached]:
    """Move the parameters to the minimum."""
    baseline = parametric(model)

    def reached(values: Tensor) -> _Reached:
        baseline.place(values)
        return _Reached(values, *level_of(model, problem))

    def near(point: _Reached) -> tuple[float, Callable[[float], tuple[float, _Reached]]]:
        baseline.place(point.values)
        hessian, gradient = normal_equations(model, problem, *point[1:])
        share = problem.share(point.level)

        def trial(damping: float) -> tuple[float, _Reached]:
            damped = hessian + damping * torch.diag(hessian.diagonal())
            moved = reached(point.values - torch.linalg.solve(damped, gradient))
            return float(moved.level + problem.prior_cost(moved.values, share)), moved

        return float(point.level + problem.prior_cost(point.values, share)), trial

    found = descend(reached(baseline.free()), near, iterations, gain=_GAIN)
    baseline.place(found.point.values)
    return found


def _with_starts(
    model: HybridDynamics, problem: Problem, iterations: int
) -> tuple[Problem, Descent[_Reached]]:
    """Move the parameters to the minimum, by turns with the starts until these gain no more."""
    found = _minimised(model, problem, iterations)
    steps = found.steps
    for _ in range(iterations if problem.begins else 0):
        moved = started(model, problem)
        if not level_of(model, moved)[0] < (1.0 - _GAIN) * found.point.level:
            break
        problem, found = moved, _minimised(model, moved, iterations)
        steps += found.steps
    return problem, replace(found, steps=steps)


@torch.no_grad()
def started(model: HybridDynamics, problem: Problem) -> Problem:
    """Return the problem with the starts that measurement and course tell, where they are wanted.

    It is one step of Gauss-Newton. Of the error of a free run, what the sensor's noise explains is
    another at each sample; the rest may last from start to end, so that all samples together tell
    no more of it than one does.
    """
    if problem.begins is None:
        return problem
    states = level_of(model, problem)[1]
    error, seen = velocities_on(states[:, 1:]) - problem.nu, problem.weight > 0.0
    noise = problem.begins.noise.square()
    square = (error.square() * seen).sum((0, 1)) / seen.sum((0, 1)).clamp(min=1)
    # windows count as they do in the cost
    size = torch.sqrt(problem.squares(states) + problem.robust**2)
    variance = noise + (square - noise).clamp(min=0.0) * error.shape[1]
    root = seen / (variance * (size / size.mean())[:, None]).sqrt()[:, None]
    moving = velocities_on(problem.x0)
    hessian = torch.diag(1.0 / noise).repeat(len(states), 1, 1)
    gradient = (moving - problem.begins.measured) / noise
    for part, found in sensitivities(model, states[:, :-1], problem.w, to_start=True):
        weight = root[:, part].transpose(0, 1)
        slopes = found[:, :, 1:, 1:] * weight.unsqueeze(-1)
        off = error[:, part].transpose(0, 1) * weight
        hessian += torch.einsum("kbij,kbil->bjl", slopes, slopes)
        gradient += torch.einsum("kbij,kbi->bj", slopes, off)
    x0 = torch.cat((pose(problem.x0), moving - torch.linalg.solve(hessian, gradient)), dim=1)
    return replace(problem, x0=x0)


def _ahead(model: HybridDynamics, x: Tensor, p: Tensor) -> Tensor:
    """The step of the rollout, without a residual."""
    return model.advanced(x, model.signals(x, p), p, zero_acceleration(x, model.dof))


_SEARCHED = 10
"""Times that the free runs of a problem are flown, about."""


@torch.no_grad()
def level_of(model: HybridDynamics, problem: Problem) -> tuple[Tensor, Tensor]:
    """Return the mean error of the windows in scales, and their free runs [B, T + 1, 3 + n]."""
    # the cost is that of velocities
    moving = HybridDynamics(model.signals, model.baseline, model.head, model.dt, model.integrator)
    moving.positions = False
    run = compiled(Rollout(moving), _SEARCHED * problem.w.shape[1])
    states, _, _ = run(problem.x0, problem.w, problem.x0[:, :0])
    return torch.sqrt(problem.squares(states) + problem.robust**2).mean(), states


@torch.no_grad()
def normal_equations(
    model: HybridDynamics, problem: Problem, level: Tensor, states: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the Gauss-Newton Hessian [P, P] and half the gradient [P] of the robust cost.

    The windows' weights follow from their errors in the free runs `states` [B, T + 1, 3 + n], which
    the search for this point has flown; so one matrix product sums over all windows and some steps.
    """
    batch, steps = problem.w.shape[:2]
    count = int(problem.active.numel())
    hessian = torch.zeros(count, count, dtype=states.dtype)
    gradient = torch.zeros(count, dtype=states.dtype)
    size = torch.sqrt(problem.squares(states) + problem.robust**2)
    window = 0.5 / size / (model.dof * steps * batch)
    root = (window.sqrt()[:, None, None] * problem.weight).transpose(0, 1)
    error = (velocities_on(states[:, 1:]) - problem.nu).transpose(0, 1) * root
    for part, found in sensitivities(model, states[:, :-1], problem.w):
        flat = (found[:, :, 1:] * root[part].unsqueeze(-1)).flatten(0, 2)
        hessian.addmm_(flat.T, flat)
        gradient.addmv_(flat.T, error[part].flatten())
    theta = parametric(model).free()
    belief = problem.share(level) * problem.belief
    prior = (
        problem.precision @ (theta - problem.start)
        + problem.pull @ theta
        + belief * (theta - problem.believed)
    )
    whole = hessian + problem.precision + problem.pull + torch.diag(belief)
    free = ~problem.still
    # what rests at zero has a row of its own, and takes no step
    alone = torch.diag(torch.where(free, torch.zeros_like(theta), whole.diagonal()))
    return torch.where(free[:, None] & free, whole, alone), (gradient + prior) * free

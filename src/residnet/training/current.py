"""Ambient currents of logs, estimated together with a baseline, and motion through water.

A log measures velocities over ground, a hull feels those through the water: nu_r = nu - R(psi)'
[c_north, c_east, 0]. Without the current, least squares takes what it does for properties of the
hull. Here every log has a constant current of its own, which turns in body axes as the vessel does;
Gauss-Newton finds all of them, the coefficients eliminated (variable projection).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from residnet.baselines.regressors import RegressorBaseline
from residnet.core.config import Config, MetresPerSecond
from residnet.core.errors import FitError
from residnet.core.layout import HEADING, POSITION, VELOCITIES, YAW_RATE
from residnet.physics.signals import Signals
from residnet.preprocessing.prepare import PreparedLog, make_samples

_ROUNDS = 4
"""Most rounds of search and descent; one that gains nothing ends them."""
_THIN = 10
"""The search looks at every so many samples."""


class CurrentConfig(Config):
    """Settings for logs that each ran in a constant current which nobody measured.

    The currents are estimated first; what follows fits and chooses models on these logs as motion
    through the water, without current. Logs that are kept for tests are moved too: each by the
    current that the coefficients of the fitted logs see in it, so that nothing of them is fitted.

    Attributes:
        baseline: name of the baseline whose regressors explain the accelerations while the currents
            are estimated.
        spread: standard deviation that each component of a current is expected to have; keeps logs
            that say little near zero.
        iterations: at most.
    """

    baseline: str = "baseline"
    spread: MetresPerSecond = Field(default=0.5, gt=0)
    iterations: int = Field(default=40, ge=1, le=10_000)


def estimate_currents(
    baseline: RegressorBaseline,
    signals: Signals,
    logs: Sequence[PreparedLog],
    config: CurrentConfig,
    others: Sequence[PreparedLog] = (),
) -> tuple[np.ndarray, list[dict[str, Any]]]:
    """Return currents to north and east [L + K, 2] in m/s of logs over ground, and their table.

    The baseline gives the regressors and keeps its own coefficients. Standard errors from least
    squares hold where the regressors are the true ones and the errors of neighbouring samples
    independent, which they never are. So the two halves of each log are estimated apart, and the
    errors of all are widened by as much as the halves differ more than they say (Birge 1932, Phys.
    Rev. 40, 207-227).

    Args:
        baseline: whose regressors explain the accelerations.
        signals: of the logs.
        logs: L logs that are fitted.
        config: what is expected of currents.
        others: K logs that the coefficients are not fitted on.

    Raises:
        FitError: where a log has no sample to learn from, or the logs do not determine their
            currents.
    """
    for p in (*logs, *others):
        if not p.trainable.any():
            raise FitError(
                f"log {p.log.name}: has no sample to estimate its current from; leave it out"
            )
    precision = config.spread**-2
    problem = _Problem(baseline, signals, logs, precision)
    current, error, theta = _found(problem, config)
    halves = []
    for p in logs:
        late = np.arange(len(p)) >= np.flatnonzero(p.trainable)[p.trainable.sum() // 2]
        halves += [replace(p, trainable=p.trainable & half) for half in (~late, late)]
    apart, alone, _ = _found(replace(problem, logs=halves), config)
    first, second = apart.reshape(-1, 2, 2).unbind(1)
    scatter = (first - second).square() / alone.reshape(-1, 2, 2).square().sum(1)
    widened = max(float(scatter.mean().sqrt()), 1.0)
    if others:
        known = _found(replace(problem, logs=others, theta=theta), config)
        current, error = torch.cat((current, known[0])), torch.cat((error, known[1]))
    rows = [
        {
            "log": p.log.name,
            "fitted": i < len(logs),
            "current_north": float(c[0]),
            "current_east": float(c[1]),
            "standard_error": (widened * e).tolist(),
        }
        for i, (p, c, e) in enumerate(zip((*logs, *others), current, error, strict=True))
    ]
    return current.numpy(), rows


def _found(problem: _Problem, config: CurrentConfig) -> tuple[Tensor, Tensor, Tensor]:
    """Return currents [L, 2], the standard errors of least squares [L, 2], and coefficients."""
    current = torch.zeros(len(problem.logs), 2, dtype=torch.float64)
    best = _descend(problem, current, config)
    for _round in range(_ROUNDS):
        again = _descend(problem, problem.search(best[1], best[2], config.spread), config)
        if again[0] > best[0] - 0.1:
            break
        best = again
    _cost, current, state = best
    error = problem.step(current, state)[1].diagonal().sqrt().reshape(-1, 2)
    return current, error, state.theta


def _descend(
    problem: _Problem, current: Tensor, config: CurrentConfig
) -> tuple[float, Tensor, _State]:
    """Gauss-Newton from some currents [L, 2] on; the best on the way, with its cost."""
    cost, state = problem.solve(current)
    best = (cost, current, state)
    for _ in range(config.iterations):
        step, _covariance = problem.step(current, state)
        # magnitudes make the cost rugged far from the true current: full steps cross what a search
        # along the line would stop at
        step = step * (config.spread / step.norm(dim=1, keepdim=True)).clamp(max=1.0)
        current = current + step
        cost, state = problem.solve(current)
        if cost < best[0]:
            best = (cost, current, state)
        if float(step.abs().max()) < 1e-4:
            break
    return best


def through_water(log: PreparedLog, current: np.ndarray, signals: Signals) -> PreparedLog:
    """Return a log as seen from a frame that drifts with the current [2].

    Positions, velocities, accelerations and the wind change.
    """
    psi, drifted = log.y[:, HEADING], (log.log.t - log.log.t[0])[:, None] * current
    along = np.cos(psi) * current[0] + np.sin(psi) * current[1]
    across = np.cos(psi) * current[1] - np.sin(psi) * current[0]
    drift = np.stack((along, across, np.zeros_like(along)), axis=1)
    # the current is constant in earth axes, so it turns in body axes
    turning = log.smoothed[:, YAW_RATE, None] * np.stack(
        (across, -along, np.zeros_like(along)), axis=1
    )

    def less(x: np.ndarray) -> np.ndarray:
        return np.concatenate(
            (x[:, POSITION] - drifted, x[:, HEADING, None], x[:, VELOCITIES] - drift), axis=1
        )

    return replace(
        log,
        y=less(log.y),
        smoothed=less(log.smoothed),
        nu_dot=log.nu_dot - turning,
        w=_felt(log.w, current, signals),
        rate_inputs=_felt(log.rate_inputs, current, signals),
    )


def _felt(w: np.ndarray, current: np.ndarray, signals: Signals) -> np.ndarray:
    """Inputs [T, m] with the true wind as one that drifts with the current sees it."""
    if not signals.has_wind:
        return w
    speed, direction = w[:, signals.speed_column], w[:, signals.direction_column]
    north, east = -speed * np.cos(direction) - current[0], -speed * np.sin(direction) - current[1]
    out = w.copy()
    out[:, signals.speed_column] = np.hypot(north, east)
    out[:, signals.direction_column] = np.arctan2(-east, -north)
    return out


@dataclass(frozen=True)
class _State:
    """Coefficients [3, J] at given currents, and what is left: errors [N, 3], their variances [3],
    regressors [N, J], log of each sample [N].
    """

    theta: Tensor
    error: Tensor
    variance: Tensor
    phi: Tensor
    group: Tensor


@dataclass(frozen=True)
class _Problem:
    baseline: RegressorBaseline
    signals: Signals
    logs: Sequence[PreparedLog]
    precision: float
    theta: Tensor | None = None
    """Coefficients [3, J] that are known and stay; else they are eliminated."""

    def regression(self, current: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return regressors [N, J], accelerations [N, 3] and log [N] of all samples.

        They are of the motion through the water.
        """
        moved = make_samples(
            [
                through_water(p, c, self.signals)
                for p, c in zip(self.logs, current.numpy(), strict=True)
            ],
            self.signals,
        )
        return self.baseline.library(moved.z), moved.target, moved.group

    def solve(self, current: Tensor) -> tuple[float, _State]:
        """Return the negative log-likelihood and least-squares fit at currents [L, 2].

        The likelihood holds the prior of the currents.
        """
        phi, target, group = self.regression(current)
        theta = torch.zeros_like(self.baseline.theta) if self.theta is None else self.theta
        for axis in range(3) if self.theta is None else ():
            columns = self.baseline.term_columns(axis)
            theta[axis, columns] = torch.linalg.solve(
                _gram(phi[:, columns]), phi[:, columns].T @ target[:, axis]
            )
        error = target - phi @ theta.T
        variance = error.square().mean(0).clamp(min=1e-300)
        cost = 0.5 * len(phi) * float(variance.log().sum()) + 0.5 * self.precision * float(
            current.square().sum()
        )
        return cost, _State(theta, error, variance, phi, group)

    def step(self, current: Tensor, state: _State) -> tuple[Tensor, Tensor]:
        """Return the Gauss-Newton step [L, 2] and covariance [2L, 2L] of the currents."""
        count = len(self.logs)
        slopes = torch.stack(
            [self._slope(current, direction, state) for direction in range(2)], dim=2
        )
        hessian = self.precision * torch.eye(2 * count, dtype=torch.float64)
        gradient = self.precision * current
        for axis in range(3):
            slope, columns = slopes[:, axis], self.baseline.term_columns(axis)
            phi, weight = state.phi[:, columns], 1.0 / state.variance[axis]
            blocks = torch.zeros(count, 2, 2, dtype=torch.float64).index_add_(
                0, state.group, slope[:, :, None] * slope[:, None, :]
            )
            hessian += weight * torch.block_diag(*blocks)
            if self.theta is None:
                mixed = torch.zeros(count, len(columns), 2, dtype=torch.float64).index_add_(
                    0, state.group, phi[:, :, None] * slope[:, None, :]
                )
                mixed = mixed.permute(1, 0, 2).reshape(len(columns), 2 * count)
                hessian -= weight * (mixed.T @ torch.linalg.solve(_gram(phi), mixed))
            gradient = gradient + weight * torch.zeros_like(current).index_add_(
                0, state.group, slope * state.error[:, axis : axis + 1]
            )
        covariance = torch.linalg.inv(hessian)
        return -(covariance @ gradient.flatten()).reshape(-1, 2), covariance

    def search(self, current: Tensor, state: _State, spread: float) -> Tensor:
        """Return currents [L, 2] with a lower cost than `current` at the same coefficients.

        Searched log by log on a grid over what is likely; else as they are.
        """
        thin = replace(
            self,
            logs=[
                replace(p, trainable=p.trainable & (np.arange(len(p)) % _THIN == 0))
                for p in self.logs
            ],
        )
        count = len(self.logs)

        def cost(trial: Tensor) -> Tensor:
            phi, target, group = thin.regression(trial)
            square = ((target - phi @ state.theta.T).square() / state.variance).sum(1)
            return _THIN * torch.zeros(count, dtype=torch.float64).index_add_(
                0, group, square
            ) + self.precision * trial.square().sum(1)

        best, found = cost(current), current.clone()
        radius, spacing = 1.25 * spread, spread / 6
        line = torch.arange(-radius, radius + spacing / 2, spacing, dtype=torch.float64)
        points = torch.cartesian_prod(line, line)
        for point in points[points.norm(dim=1) <= radius]:
            trial = point.expand(count, 2)
            trial_cost = cost(trial)
            found = torch.where((trial_cost < best)[:, None], trial, found)
            best = torch.minimum(best, trial_cost)
        return found

    def _slope(self, current: Tensor, direction: int, state: _State) -> Tensor:
        """Derivative of the errors [N, 3] with respect to one component of each sample's own
        current, the coefficients held.
        """
        little = torch.zeros_like(current)
        little[:, direction] = 1e-4
        ends = []
        for moved in (current + little, current - little):
            phi, target, _ = self.regression(moved)
            ends.append(target - phi @ state.theta.T)
        return (ends[0] - ends[1]) / 2e-4


def _gram(phi: Tensor) -> Tensor:
    """phi' phi [J, J] with a trace of its diagonal, so that regressors which the data cannot tell
    apart share what they explain.
    """
    gram = phi.T @ phi
    return gram + 1e-12 * torch.diag(gram.diagonal().clamp(min=1e-300))

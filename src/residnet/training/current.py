"""Estimate the ambient current of each log together with a baseline.

Logs contain velocities over ground, but hydrodynamic forces depend on velocities through the water:
nu_r = nu - R(psi)' [c_north, c_east, 0]. Without the current, least squares attributes its effect
to the hull. Each log has a constant current here, which rotates in body axes with the heading;
Gauss-Newton estimates all currents, with the coefficients eliminated (variable projection).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from scipy.special import fdtrc
from torch import Tensor

from residnet.baselines.regressors import RegressorBaseline
from residnet.core.errors import FitError
from residnet.core.layout import HEADING, POSITION, VELOCITIES, YAW_RATE
from residnet.physics.signals import Signals
from residnet.preprocessing.prepare import PreparedLog
from residnet.training.records import CurrentRow

if TYPE_CHECKING:
    from residnet.training.current_config import CurrentConfig

_MAX_ROUNDS = 4
"""Largest number of rounds of grid search and Gauss-Newton; it ends earlier without a gain."""
_SEARCH_STRIDE = 10
"""Stride of the samples in the grid search."""
_MIN_ROUND_GAIN = 0.1
"""Decrease of the negative log-posterior below which a round is the last one."""
_CONVERGED_STEP = 1e-4
"""Largest change of a current in m/s at which Gauss-Newton has converged."""
_MAX_P_VALUE = 0.01
"""Largest p-value of a significant current, for all logs together (Bonferroni)."""
_MAX_BODY_SPEED_RATIO = 2.0
"""Largest ratio of a velocity in body axes to the currents that it explains: the ratio for logs
whose headings have a mean resultant length of 0.5.
"""
_MIN_SPEED_SHARE = 0.02
"""Smallest speed of a significant current, as a share of the speed of the vessel."""


def estimate_currents(
    baseline: RegressorBaseline,
    signals: Signals,
    logs: Sequence[PreparedLog],
    config: CurrentConfig,
    others: Sequence[PreparedLog] = (),
) -> tuple[np.ndarray, list[CurrentRow]]:
    """Return currents to north and east [L + K, 2] in m/s of logs over ground, and their table.

    The baseline provides the regressors; its own coefficients are not changed. Standard errors of
    least squares assume true regressors and independent errors of neighbouring samples, which is
    never the case. Therefore the two halves of each log are also estimated separately, and all
    standard errors are multiplied by the ratio of the observed to the expected difference of the
    halves (Birge 1932, Phys. Rev. 40, 207-227).

    Args:
        baseline: baseline whose regressors explain the accelerations.
        signals: signals of the logs.
        logs: L logs that are fitted.
        config: settings of the prior of currents.
        others: K logs whose currents are estimated with the coefficients of the other logs.

    Raises:
        FitError: if a log has no trainable sample, or the logs do not determine their currents.
    """
    for log in (*logs, *others):
        if not log.trainable.any():
            raise FitError(
                f"log {log.log.name}: no trainable sample to estimate its current from; remove it"
            )
    precision = config.spread**-2
    # the currents are estimated from all samples
    problem = _CurrentProblem(baseline, signals, logs, precision)
    current, error, theta = _estimate(problem, config)
    # the halves of each log give the Birge ratio, the factor by which standard errors are too small
    halves = []
    for log in logs:
        middle = np.flatnonzero(log.trainable)[log.trainable.sum() // 2]
        is_late = np.arange(len(log)) >= middle
        halves += [replace(log, trainable=log.trainable & half) for half in (~is_late, is_late)]
    half_current, half_error, _ = _estimate(replace(problem, logs=halves), config)
    first, second = half_current.reshape(-1, 2, 2).unbind(1)
    variance_ratio = (first - second).square() / half_error.reshape(-1, 2, 2).square().sum(1)
    birge_ratio = max(float(variance_ratio.mean().sqrt()), 1.0)
    if others:
        # currents of the logs that are not fitted, with the coefficients of the fitted logs
        other_problem = replace(problem, logs=others, theta=theta)
        other_current, other_error, _ = _estimate(other_problem, config)
        current = torch.cat((current, other_current))
        error = torch.cat((error, other_error))
    rows = [
        CurrentRow(
            log=p.log.name,
            fitted=i < len(logs),
            current_north=float(c[0]),
            current_east=float(c[1]),
            standard_error=(birge_ratio * e).tolist(),
            # the variance ratio has two degrees of freedom per fitted log
            p_value=float(
                fdtrc(2.0, 2.0 * len(logs), 0.5 * float((c / (birge_ratio * e)).square().sum()))
            ),
        )
        for i, (p, c, e) in enumerate(zip((*logs, *others), current, error, strict=True))
    ]
    return current.numpy(), rows


def select_significant_currents(
    rows: Sequence[CurrentRow], speeds: Sequence[float]
) -> list[CurrentRow]:
    """Return the significant currents, with Bonferroni's correction for the number of logs.

    Args:
        rows: currents of logs with their p-values.
        speeds: speed of each vessel in m/s; a current below a fiftieth of it does not matter.
    """
    return [
        row
        for row, speed in zip(rows, speeds, strict=True)
        if row.p_value is not None
        and row.p_value * len(rows) < _MAX_P_VALUE
        and row.speed > _MIN_SPEED_SHARE * speed
    ]


def is_explained_by_body_velocity(
    rows: Sequence[CurrentRow], headings: Sequence[np.ndarray]
) -> bool:
    """Return whether one velocity in body axes explains the currents of all logs.

    A term that the model lacks looks like a current that turns with the vessel. Where all logs have
    about the same mean heading, it cannot be distinguished from a current in earth axes. The
    velocity is estimated by weighted least squares; an F test of the remaining differences, with
    the degrees of freedom of the standard errors, decides.

    Args:
        rows: currents of L logs with their standard errors.
        headings: headings of each log [T] in rad.
    """
    estimates = np.array([[row.current_north, row.current_east] for row in rows])
    standard_errors = np.array([row.standard_error for row in rows])
    # a velocity that is constant in body axes, averaged over a log in earth axes
    cosines = np.array([np.cos(heading).mean() for heading in headings])
    sines = np.array([np.sin(heading).mean() for heading in headings])
    rotations = np.stack(
        (np.stack((cosines, -sines), axis=1), np.stack((sines, cosines), axis=1)), axis=1
    )
    weighted_rotations = (rotations / standard_errors[:, :, None]).reshape(-1, 2)
    weighted_estimates = (estimates / standard_errors).ravel()
    body_velocity = np.linalg.lstsq(weighted_rotations, weighted_estimates, rcond=None)[0]
    residuals = weighted_estimates - weighted_rotations @ body_velocity
    n_residuals = max(2.0 * len(rows) - 2.0, 1.0)
    p_value = fdtrc(n_residuals, 2.0 * len(rows), float(np.square(residuals).sum()) / n_residuals)
    # over logs that turn through all headings a body velocity averages out: it would have to be
    # much larger than the currents that it explains
    is_plausible = np.hypot(*body_velocity) <= _MAX_BODY_SPEED_RATIO * max(
        row.speed for row in rows
    )
    return bool(is_plausible and p_value >= _MAX_P_VALUE)


def _estimate(problem: _CurrentProblem, config: CurrentConfig) -> tuple[Tensor, Tensor, Tensor]:
    """Return currents [L, 2], their least-squares standard errors [L, 2], and coefficients."""
    best = _minimise(problem, torch.zeros(len(problem.logs), 2, dtype=torch.float64), config)
    for _ in range(_MAX_ROUNDS):
        grid_currents = problem.search_grid(best.current, best.fit, config.spread)
        candidate = _minimise(problem, grid_currents, config)
        if candidate.cost > best.cost - _MIN_ROUND_GAIN:
            break
        best = candidate
    covariance = problem.gauss_newton_step(best.current, best.fit)[1]
    return best.current, covariance.diagonal().sqrt().reshape(-1, 2), best.fit.theta


class _SearchPoint(NamedTuple):
    """A point of the search.

    Attributes:
        cost: negative log-posterior.
        current: currents to north and east [L, 2] in m/s.
        fit: regression at these currents.
    """

    cost: float
    current: Tensor
    fit: _RegressionFit


def _minimise(problem: _CurrentProblem, current: Tensor, config: CurrentConfig) -> _SearchPoint:
    """Return the best point of a Gauss-Newton search from currents [L, 2]."""
    cost, fit = problem.solve(current)
    best = _SearchPoint(cost, current, fit)
    for _ in range(config.iterations):
        step, _ = problem.gauss_newton_step(current, fit)
        # regressors with magnitudes make the cost rugged far from the true current: full steps
        # cross local minima at which a line search would stop
        step = step * (config.spread / step.norm(dim=1, keepdim=True)).clamp(max=1.0)
        current = current + step
        cost, fit = problem.solve(current)
        if cost < best.cost:
            best = _SearchPoint(cost, current, fit)
        if float(step.abs().max()) < _CONVERGED_STEP:
            break
    return best


def through_water(log: PreparedLog, current: np.ndarray, signals: Signals) -> PreparedLog:
    """Return a log in a frame that drifts with the current.

    Positions, velocities, accelerations and the true wind are transformed.

    Args:
        log: log over ground.
        current: components of the current to the north and to the east [2], m/s.
        signals: signals of the model.
    """
    psi = log.y[:, HEADING]
    drift = (log.log.t - log.log.t[0])[:, None] * current
    surge = np.cos(psi) * current[0] + np.sin(psi) * current[1]
    sway = np.cos(psi) * current[1] - np.sin(psi) * current[0]
    zero = np.zeros_like(surge)
    body_current = np.stack((surge, sway, zero), axis=1)
    # the current is constant in earth axes and therefore rotates in body axes
    yaw_rate = log.smoothed[:, YAW_RATE, None]
    current_acceleration = yaw_rate * np.stack((sway, -surge, zero), axis=1)

    def transform(x: np.ndarray) -> np.ndarray:
        position = x[:, POSITION] - drift
        return np.concatenate(
            (position, x[:, HEADING, None], x[:, VELOCITIES] - body_current), axis=1
        )

    return replace(
        log,
        y=transform(log.y),
        smoothed=transform(log.smoothed),
        nu_dot=log.nu_dot - current_acceleration,
        w=_transform_wind(log.w, current, signals),
        regression_inputs=_transform_wind(log.regression_inputs, current, signals),
    )


def _transform_wind(w: np.ndarray, current: np.ndarray, signals: Signals) -> np.ndarray:
    """Return inputs [T, m] with the true wind relative to the frame of the current."""
    if not signals.has_wind:
        return w
    speed = w[:, signals.speed_column]
    direction = w[:, signals.direction_column]
    north = -speed * np.cos(direction) - current[0]
    east = -speed * np.sin(direction) - current[1]
    transformed = w.copy()
    transformed[:, signals.speed_column] = np.hypot(north, east)
    transformed[:, signals.direction_column] = np.arctan2(-east, -north)
    return transformed


@dataclass(frozen=True)
class _RegressionFit:
    """The regression at given currents.

    Attributes:
        theta: coefficients [3, J].
        error: residuals [N, 3].
        variance: variances of the residuals [3].
        phi: regressors [N, J].
        group: index of the log of each sample [N].
        grams: regularised Gram matrices of the regressors of each axis; empty if the coefficients
            are known.
    """

    theta: Tensor
    error: Tensor
    variance: Tensor
    phi: Tensor
    group: Tensor
    grams: tuple[Tensor, ...]


class _SampleColumns(NamedTuple):
    """Trainable samples of all logs.

    Attributes:
        psi: headings [N] in rad.
        states: smoothed states [N, nx].
        inputs: prepared inputs [N, k].
        nu_dot: accelerations [N, 3].
        log_index: index of the log of each sample [N].
    """

    psi: Tensor
    states: Tensor
    inputs: Tensor
    nu_dot: Tensor
    log_index: Tensor


@dataclass(frozen=True)
class _CurrentProblem:
    """The regression of accelerations on the motion through the water.

    Attributes:
        baseline: baseline whose term library computes the regressors.
        signals: signals of the logs.
        logs: L logs over ground.
        precision: prior precision of each component of a current.
        theta: known coefficients [3, J]; None if they are eliminated.
    """

    baseline: RegressorBaseline
    signals: Signals
    logs: Sequence[PreparedLog]
    precision: float
    theta: Tensor | None = None

    @cached_property
    def _samples(self) -> _SampleColumns:
        """Trainable samples of all logs."""
        parts: list[list[np.ndarray]] = [[], [], [], [], []]
        for number, log in enumerate(self.logs):
            rows = log.trainable
            columns = (log.y[:, HEADING], log.smoothed, log.regression_inputs, log.nu_dot)
            for part, values in zip(parts, columns, strict=False):
                part.append(values[rows])
            parts[4].append(np.full(int(rows.sum()), number))
        psi, x, w, nu_dot, group = (torch.from_numpy(np.concatenate(part)) for part in parts)
        return _SampleColumns(psi, x, self.signals.prepare(w), nu_dot, group)

    def regression(self, current: Tensor) -> tuple[Tensor, Tensor]:
        """Return regressors [N, J] and accelerations [N, 3] through the water.

        Args:
            current: current of each sample [N, 2].
        """
        psi, x, p, nu_dot, _ = self._samples
        surge = torch.cos(psi) * current[:, 0] + torch.sin(psi) * current[:, 1]
        sway = torch.cos(psi) * current[:, 1] - torch.sin(psi) * current[:, 0]
        zero = torch.zeros_like(surge)
        body_current = torch.stack((surge, sway, zero), dim=1)
        current_acceleration = x[:, YAW_RATE, None] * torch.stack((sway, -surge, zero), dim=1)
        state = torch.cat((x[:, : VELOCITIES.start], x[:, VELOCITIES] - body_current), dim=1)
        if self.signals.has_wind:
            # the last two prepared inputs are the velocity of the air over ground
            p = torch.cat((p[:, :-2], p[:, -2:] - current), dim=1)
        return self.baseline.library(self.signals(state, p)), nu_dot - current_acceleration

    def residuals(self, current: Tensor, theta: Tensor) -> Tensor:
        """Return the errors [N, 3] at the current of each sample [N, 2]."""
        phi, target = self.regression(current)
        return target - phi @ theta.T

    def solve(self, current: Tensor) -> tuple[float, _RegressionFit]:
        """Return the negative log-posterior and the least-squares fit at currents [L, 2]."""
        group = self._samples.log_index
        phi, target = self.regression(current[group])
        theta = torch.zeros_like(self.baseline.theta) if self.theta is None else self.theta
        grams = []
        for axis in range(3) if self.theta is None else ():
            columns = self.baseline.term_columns(axis)
            axis_phi = phi[:, columns]
            grams.append(_regularised_gram(axis_phi))
            theta[axis, columns] = torch.linalg.solve(grams[-1], axis_phi.T @ target[:, axis])
        error = target - phi @ theta.T
        variance = error.square().mean(0).clamp(min=1e-300)
        log_likelihood = -0.5 * len(phi) * float(variance.log().sum())
        log_prior = -0.5 * self.precision * float(current.square().sum())
        fit = _RegressionFit(theta, error, variance, phi, group, tuple(grams))
        return -log_likelihood - log_prior, fit

    def gauss_newton_step(self, current: Tensor, fit: _RegressionFit) -> tuple[Tensor, Tensor]:
        """Return the Gauss-Newton step [L, 2] and covariance [2L, 2L] of the currents.

        The coefficients are eliminated (variable projection, Kaufman's approximation).
        """
        n_logs = len(self.logs)
        # exact derivatives of the errors by the current of each sample [N, 3, 2]: samples do not
        # depend on each other, so that the gradient of a sum has the derivative of each. Three
        # gradients take a fifth of the time of two forward derivatives, which PyTorch decomposes
        current_of_sample = current[fit.group].requires_grad_()
        with torch.enable_grad():
            errors = self.residuals(current_of_sample, fit.theta)
            gradients = [
                torch.autograd.grad(errors[:, axis].sum(), current_of_sample, retain_graph=True)[0]
                for axis in range(3)
            ]
        jacobian = torch.stack(gradients, dim=1)
        hessian = self.precision * torch.eye(2 * n_logs, dtype=torch.float64)
        gradient = self.precision * current
        # samples are in the order of their logs: products of the rows of each log take a tenth of
        # the time of sums over all rows by index
        n_samples = torch.bincount(fit.group, minlength=n_logs).tolist()
        for axis in range(3):
            slope = jacobian[:, axis]
            slopes = slope.split(n_samples)
            weight = 1.0 / fit.variance[axis]
            hessian += weight * torch.block_diag(*(part.T @ part for part in slopes))
            if self.theta is None:
                columns = self.baseline.term_columns(axis)
                phi = fit.phi[:, columns]
                mixed = torch.cat(
                    [
                        rows.T @ part
                        for rows, part in zip(phi.split(n_samples), slopes, strict=True)
                    ],
                    dim=1,
                )
                hessian -= weight * (mixed.T @ torch.linalg.solve(fit.grams[axis], mixed))
            gradient = gradient + weight * torch.stack(
                [
                    part.T @ error
                    for part, error in zip(slopes, fit.error[:, axis].split(n_samples), strict=True)
                ]
            )
        covariance = torch.linalg.inv(hessian)
        return -(covariance @ gradient.flatten()).reshape(-1, 2), covariance

    def search_grid(self, current: Tensor, fit: _RegressionFit, spread: float) -> Tensor:
        """Return currents [L, 2] of lowest cost at fixed coefficients on a grid, log by log.

        Args:
            current: currents [L, 2], which are returned for logs without a better grid point.
            fit: fit at these currents.
            spread: prior standard deviation of a component of a current, m/s.
        """
        thinned_logs = [
            replace(log, trainable=log.trainable & (np.arange(len(log)) % _SEARCH_STRIDE == 0))
            for log in self.logs
        ]
        thinned = replace(self, logs=thinned_logs)
        group = thinned._samples.log_index
        n_logs = len(self.logs)

        def cost_of_logs(trial: Tensor) -> Tensor:
            error = thinned.residuals(trial[group], fit.theta)
            square = (error.square() / fit.variance).sum(1)
            total = torch.zeros(n_logs, dtype=torch.float64).index_add_(0, group, square)
            return _SEARCH_STRIDE * total + self.precision * trial.square().sum(1)

        lowest_cost = cost_of_logs(current)
        best = current.clone()
        radius = 1.25 * spread
        spacing = spread / 6
        line = torch.arange(-radius, radius + spacing / 2, spacing, dtype=torch.float64)
        points = torch.cartesian_prod(line, line)
        for point in points[points.norm(dim=1) <= radius]:
            trial = point.expand(n_logs, 2)
            trial_cost = cost_of_logs(trial)
            best = torch.where((trial_cost < lowest_cost)[:, None], trial, best)
            lowest_cost = torch.minimum(lowest_cost, trial_cost)
        return best


def _regularised_gram(phi: Tensor) -> Tensor:
    """Return phi' phi [J, J] with a slightly larger diagonal.

    Collinear regressors then share the explained variance.
    """
    gram = phi.T @ phi
    return gram + 1e-12 * torch.diag(gram.diagonal().clamp(min=1e-300))

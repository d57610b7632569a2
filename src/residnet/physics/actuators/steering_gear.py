"""Identification of a steering gear from commanded and measured rudder angles.

The gear is a dead time, a first-order lag and a rate limit in series: a_dot = (c(t - L) - a) / T
within +-rate. All logs together give its parameters by nonlinear least squares on simulated angles;
the Bayesian information criterion decides which of them the data support. Without commands, the
rate follows from the slope of the measured angle while the rudder moves between two levels.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from residnet.core.errors import FitError
from residnet.core.log import Log

_MIN_TRAVEL = math.radians(5.0)
"""Smallest change of the rudder angle from which a rate is estimated."""
_MIN_CHANGES = 2
"""Smallest number of rudder movements from which a rate is estimated."""
_RAMP_SHARES = (0.2, 0.8)
"""Part of a rudder movement over which its rate is measured, away from lag at both ends."""
_MAX_DELAY = 5.0
"""Longest dead time that is tried, s; chosen by hand for ship models and ships."""
_MAX_SAMPLES = 20_000
"""Largest number of samples of a fit; further logs are left out."""
_NORMAL_95 = 1.959964
"""Quantile of the standard normal distribution for 95 % intervals."""


class GearParameter(NamedTuple):
    """A parameter of the gear with its 95 % confidence interval; None if it is not identifiable."""

    value: float
    ci95: tuple[float, float] | None


@dataclass(frozen=True)
class SteeringGear:
    """An identified steering gear.

    Attributes:
        rate: largest rate in rad/s; None if the data do not reach one.
        lag: time constant in s; None if the data do not support one.
        delay: dead time in s; None if the data do not support one.
        rms: root mean square error of the simulated angle in rad; None without commands.
        n_movements: number of movements between two levels, from which a rate alone is estimated.
    """

    rate: GearParameter | None
    lag: GearParameter | None = None
    delay: GearParameter | None = None
    rms: float | None = None
    n_movements: int = 0

    def describe(self) -> str:
        """Return the parameters as text with their intervals."""

        def format_parameter(
            name: str, parameter: GearParameter, unit: str, factor: float = 1.0
        ) -> str:
            text = f"{name} {parameter.value * factor:.3g} {unit}"
            if parameter.ci95 is None:
                return text
            low, high = (limit * factor for limit in parameter.ci95)
            return f"{text} (95 % {low:.3g} to {high:.3g})"

        parts = []
        if self.rate is not None:
            parts.append(format_parameter("rate", self.rate, "deg/s", 180.0 / math.pi))
        if self.lag is not None:
            parts.append(format_parameter("time constant", self.lag, "s"))
        if self.delay is not None:
            parts.append(format_parameter("dead time", self.delay, "s"))
        return ", ".join(parts) or "no rate limit, lag or dead time"


class _Recording(NamedTuple):
    """Commands and angles of one log on a uniform grid."""

    dt: float
    command: np.ndarray
    angle: np.ndarray


def simulate_gear(
    command: np.ndarray, initial_angle: float, dt: float, rate: float, lag: float, delay: float
) -> np.ndarray:
    """Return the angle [T] of a gear that follows a command [T] on a uniform grid.

    Args:
        command: commanded angle in rad, held over each step.
        initial_angle: angle at the first sample in rad.
        dt: time step in s.
        rate: rate limit in rad/s; infinite for none.
        lag: time constant in s; 0 for none.
        delay: dead time in s, interpolated between samples.
    """
    times = np.arange(len(command)) * dt
    delayed = np.interp(times - delay, times, command)
    step_share = -math.expm1(-dt / lag) if lag > 0.0 else 1.0
    max_change = rate * dt
    angle = np.empty(len(command))
    position = initial_angle
    for k, target in enumerate(delayed.tolist()):
        angle[k] = position
        position += min(max(step_share * (target - position), -max_change), max_change)
    return angle


def identify_steering_gear(logs: Sequence[Log], command: str, angle: str) -> SteeringGear:
    """Identify a steering gear from logs with commanded and measured angles.

    Args:
        logs: logs with both channels.
        command: name of the commanded angle.
        angle: name of the measured angle.

    Raises:
        FitError: if the rudder hardly moves in these logs.
    """
    recordings = _collect_recordings(logs, command, angle)
    largest_motion = max(
        (float(np.ptp(recording.command)) for recording in recordings), default=0.0
    )
    if largest_motion < _MIN_TRAVEL:
        raise FitError(
            f"steering gear: {command} changes by {math.degrees(largest_motion):.2g} deg at most; a"
            " gear needs logs whose rudder moves by 5 deg"
        )
    # resolution is the time step: a faster lag or delay cannot be identified
    dt = min(recording.dt for recording in recordings)
    steepest = max(
        float(np.quantile(np.abs(np.gradient(recording.angle, recording.dt)), 0.995))
        for recording in recordings
    )
    initial = {"rate": steepest, "lag": max(2.0 * dt, 0.3), "delay": max(dt, 0.1)}
    n_samples = sum(len(recording.angle) for recording in recordings)
    best: tuple[float, tuple[str, ...], np.ndarray, np.ndarray, float] | None = None
    for size in range(4):
        for names in itertools.combinations(("rate", "lag", "delay"), size):
            theta, covariance, cost = _fit_parameters(recordings, names, initial)
            criterion = n_samples * math.log(max(cost, 1e-18) / n_samples)
            # samples of one movement are not independent: count parameters at the cost of
            # independent movements would give, which keeps spurious small lags out
            criterion += 3.0 * size * math.log(n_samples)
            if best is None or criterion < best[0]:
                best = (criterion, names, theta, covariance, cost)
    assert best is not None
    _, names, theta, covariance, cost = best
    parameters = {}
    for i, name in enumerate(names):
        value = math.exp(theta[i])
        deviation = _NORMAL_95 * math.sqrt(max(float(covariance[i, i]), 0.0))
        parameters[name] = GearParameter(
            value, (value * math.exp(-deviation), value * math.exp(deviation))
        )
    return SteeringGear(
        parameters.get("rate"),
        parameters.get("lag"),
        parameters.get("delay"),
        math.sqrt(cost / n_samples),
    )


def _collect_recordings(logs: Sequence[Log], command: str, angle: str) -> list[_Recording]:
    """Return commands and angles on the grid of the median interval of each log."""
    recordings: list[_Recording] = []
    n_samples = 0
    for log in logs:
        if command not in log.channels or angle not in log.channels or n_samples > _MAX_SAMPLES:
            continue
        is_finite = np.isfinite(log[command]) & np.isfinite(log[angle])
        if is_finite.sum() < 20:
            continue
        t = log.t[is_finite]
        dt = float(np.median(np.diff(t)))
        grid = np.arange(t[0], t[-1], dt)[:_MAX_SAMPLES]
        # commands are steps: the last value holds
        last_sample = np.searchsorted(t, grid + 1e-9, side="right") - 1
        recordings.append(
            _Recording(
                dt, log[command][is_finite][last_sample], np.interp(grid, t, log[angle][is_finite])
            )
        )
        n_samples += len(grid)
    return recordings


def _fit_parameters(
    recordings: Sequence[_Recording], names: tuple[str, ...], initial: dict[str, float]
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return logarithms of the parameters, their covariance and the sum of squares."""
    from scipy.optimize import least_squares

    offset = float(np.median(np.concatenate([r.angle - r.command for r in recordings])))

    def residuals(theta: np.ndarray) -> np.ndarray:
        settings = {"rate": math.inf, "lag": 0.0, "delay": 0.0}
        settings |= {name: math.exp(value) for name, value in zip(names, theta, strict=True)}
        return np.concatenate(
            [
                simulate_gear(
                    recording.command + offset, float(recording.angle[0]), recording.dt, **settings
                )
                - recording.angle
                for recording in recordings
            ]
        )

    if not names:
        return np.empty(0), np.empty((0, 0)), float(np.square(residuals(np.empty(0))).sum())
    lower = {"rate": 0.05 * initial["rate"], "lag": 1e-2, "delay": 1e-2}
    upper = {"rate": 20.0 * initial["rate"], "lag": 30.0, "delay": _MAX_DELAY}
    fit = least_squares(
        residuals,
        [math.log(min(max(initial[name], 1.01 * lower[name]), upper[name])) for name in names],
        bounds=([math.log(lower[n]) for n in names], [math.log(upper[n]) for n in names]),
        diff_step=[1e-3] * len(names),
        x_scale=0.3,
        max_nfev=60,
    )
    cost = 2.0 * float(fit.cost)
    errors = fit.fun
    # errors of one movement are correlated: the effective number of samples is smaller
    correlation = float(np.clip(np.corrcoef(errors[:-1], errors[1:])[0, 1], 0.0, 0.99))
    inflation = (1.0 + correlation) / (1.0 - correlation)
    jacobian = np.asarray(fit.jac, dtype=float)
    gram = jacobian.T @ jacobian
    variance = cost / max(len(errors) - len(names), 1) * inflation
    covariance = variance * np.linalg.pinv(gram)
    return np.asarray(fit.x), np.asarray(covariance), cost


def estimate_rudder_rate(logs: Sequence[Log], angle: str) -> SteeringGear:
    """Estimate the rate of a rudder from its measured angle alone.

    The rate is the median slope over the middle part of movements between two levels. A lag cannot
    be separated from it without the command.

    Args:
        logs: logs with the measured angle.
        angle: name of its channel.

    Raises:
        FitError: if there are too few movements.
    """
    slopes: list[float] = []
    for log in logs:
        if angle in log.channels:
            slopes += _movement_slopes(log.t, log[angle])
    if len(slopes) < _MIN_CHANGES:
        raise FitError(
            f"steering gear: {angle} moves {len(slopes)} times by more than"
            f" {math.degrees(_MIN_TRAVEL):g} deg at a constant rate; declare the rate under"
            " booklet.inputs"
        )
    rate = float(np.median(slopes))
    # standard error of a median, from the median absolute deviation
    slope_std = 1.4826 * float(np.median(np.abs(np.array(slopes) - rate)))
    deviation = _NORMAL_95 * 1.2533 * slope_std / math.sqrt(len(slopes))
    interval = (max(rate - deviation, 0.0), rate + deviation)
    return SteeringGear(GearParameter(rate, interval), n_movements=len(slopes))


def _movement_slopes(t: np.ndarray, angle: np.ndarray) -> list[float]:
    """Return the rate of each movement of a rudder between two levels, in rad/s."""
    is_finite = np.isfinite(angle)
    t = t[is_finite]
    angle = angle[is_finite]
    if len(t) < 10 or np.ptp(angle) < _MIN_TRAVEL:
        return []
    # a noise-free movement is monotonic; the tolerance bridges noise within it
    noise = 1.4826 * float(np.median(np.abs(np.diff(angle)))) + 1e-9
    speed = np.abs(np.gradient(angle, t))
    is_moving = speed > max(0.25 * float(np.quantile(speed, 0.995)), 3.0 * noise / _median_step(t))
    edges = np.flatnonzero(np.diff(np.concatenate(([0], is_moving.astype(int), [0]))))
    slopes = []
    for first, stop in edges.reshape(-1, 2):
        begin = max(int(first) - 1, 0)
        end = min(int(stop), len(t) - 1)
        travel = angle[end] - angle[begin]
        if abs(travel) < _MIN_TRAVEL:
            continue
        share = np.maximum.accumulate((angle[begin : end + 1] - angle[begin]) / travel)
        start_time, stop_time = np.interp(_RAMP_SHARES, share, t[begin : end + 1])
        if stop_time > start_time:
            part = (_RAMP_SHARES[1] - _RAMP_SHARES[0]) * abs(travel)
            slopes.append(float(part / (stop_time - start_time)))
    return slopes


def _median_step(t: np.ndarray) -> float:
    return float(np.median(np.diff(t)))

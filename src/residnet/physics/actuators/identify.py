"""Identification of actuators from tests: throttle map, rate limit, dead time, thrust curves.

Source: Woo et al. 2018, section 4.1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from residnet.core.errors import FitError


class IntervalEstimate(NamedTuple):
    """Estimate with its 95 % confidence interval.

    Attributes:
        value: estimate.
        low: lower limit.
        high: upper limit.
        unit: unit of all three.
    """

    value: float
    low: float
    high: float
    unit: str


class ThrottleMap(NamedTuple):
    """Map from throttle to revolutions, n = slope * throttle + offset, within +-n_max.

    Attributes:
        slope: revolutions in 1/s per throttle.
        offset: revolutions at zero throttle in 1/s.
        n_max: limit in 1/s; the largest measured value if the data do not saturate.
        saturated: whether the data saturate.
    """

    slope: IntervalEstimate
    offset: IntervalEstimate
    n_max: IntervalEstimate
    saturated: bool

    def __call__(self, throttle: np.ndarray) -> np.ndarray:
        """Return the revolutions [1/s] at a throttle."""
        return np.clip(
            self.slope.value * throttle + self.offset.value, -self.n_max.value, self.n_max.value
        )


class StepResponse(NamedTuple):
    """Response of a shaft to a step of the command.

    Attributes:
        rate: rate limit in 1/s^2.
        dead_time: dead time in s.
    """

    rate: IntervalEstimate
    dead_time: IntervalEstimate


class ThrustFit(NamedTuple):
    """Thrust c0 + c1 n + c2 n^2 of one direction of rotation.

    Attributes:
        coefficients: c0 in N, c1 in N s, c2 in N s^2.
        low: lowest revolutions of the data in 1/s.
        high: highest revolutions of the data in 1/s.
        rms: root mean square residual in N.
    """

    coefficients: tuple[IntervalEstimate, IntervalEstimate, IntervalEstimate]
    low: float
    high: float
    rms: float

    def __call__(self, n: np.ndarray) -> np.ndarray:
        """Return the thrust [N] per thruster at revolutions n [1/s]."""
        coefficients = [estimate.value for estimate in self.coefficients]
        thrust: np.ndarray = coefficients[0] + n * (coefficients[1] + n * coefficients[2])
        return thrust


_SATURATION_POINTS = 3
"""Minimum number of points at the same revolutions that count as saturation."""


def fit_throttle_map(throttle: np.ndarray, n: np.ndarray) -> ThrottleMap:
    """Fit a line with saturation to steady revolutions n [N] in 1/s over throttle [N].

    Slope, offset and saturation are estimated jointly by least squares.

    Raises:
        FitError: if there are fewer than five points, fewer than three different throttles on the
            slope or throttles of one direction only, or if revolutions decrease with throttle.
    """
    if throttle.size < 5 or np.unique(throttle).size < 3:
        raise FitError(
            f"throttle test: {throttle.size} points at {np.unique(throttle).size} throttles; at"
            " least 5 points at 3 throttles are needed"
        )
    if throttle.min() >= 0 or throttle.max() <= 0:
        raise FitError(
            "throttle test: only one direction was measured; the map needs throttle ahead and"
            " astern"
        )
    if np.corrcoef(throttle, n)[0, 1] < 0.5:
        raise FitError(
            "throttle test: revolutions do not rise with the throttle; check the columns, their"
            " signs and units"
        )
    max_throttle = float(np.abs(throttle).max())
    max_n = float(np.abs(n).max())
    # initial estimate: a line through the origin and the largest revolutions
    slope = max_n / max_throttle
    # saturated points have nearly the maximum revolutions at clearly different throttles
    is_at_bound = np.abs(n) > 0.97 * max_n
    is_saturated = (
        is_at_bound.sum() >= _SATURATION_POINTS
        and np.ptp(np.abs(throttle[is_at_bound])) > 0.05 * max_throttle
    )
    initial = [slope, 0.0]
    scale = [slope, 0.1 * max_n]
    if is_saturated:
        is_below_bound = ~is_at_bound
        if np.unique(throttle[is_below_bound]).size >= 2:
            initial[0] = scale[0] = float(
                np.polyfit(throttle[is_below_bound], n[is_below_bound], 1)[0]
            )
        initial = [*initial, float(np.median(np.abs(n[is_at_bound])))]
        scale = [*scale, max_n]

    def residual(parameters: np.ndarray) -> np.ndarray:
        bound = parameters[2] if is_saturated else np.inf
        return np.asarray(np.clip(parameters[0] * throttle + parameters[1], -bound, bound) - n)

    estimates, half_width = _fit_with_intervals(residual, initial, scale, n.size)
    if not is_saturated:
        estimates = [*estimates, max_n]
        half_width = [*half_width, 0.0]
    slope_estimate, offset, n_max = (
        IntervalEstimate(value_k, value_k - half_width_k, value_k + half_width_k, "1/s")
        for value_k, half_width_k in zip(estimates, half_width, strict=True)
    )
    return ThrottleMap(slope_estimate, offset, n_max, bool(is_saturated))


def simulate_shaft(
    t: np.ndarray, command: np.ndarray, rate_limit: float, dead_time: float, initial_n: float
) -> np.ndarray:
    """Simulate the revolutions [T] of a shaft with dead time and rate limit.

    Args:
        t: times [T] in s.
        command: commanded revolutions [T] in 1/s, held between samples.
        rate_limit: maximum rate of change in 1/s^2.
        dead_time: time between a command and its first effect, in s.
        initial_n: revolutions at the first sample in 1/s.
    """
    delayed_t = t - dead_time
    command_index = np.searchsorted(t, delayed_t, side="right") - 1
    n = np.empty_like(t)
    n[0] = initial_n
    max_change = rate_limit * np.diff(t)
    for k in range(1, t.size):
        # a delayed command may change within an interval: the shaft follows the previous command
        # until then, and the next one for the remaining share of the interval
        previous_command = command[max(command_index[k - 1], 0)]
        next_command = command[max(command_index[k], 0)]
        new_command_share = (
            1.0
            if previous_command == next_command
            else (delayed_t[k] - t[max(command_index[k], 0)]) / (delayed_t[k] - delayed_t[k - 1])
        )
        n_before_change = n[k - 1] + np.clip(
            previous_command - n[k - 1],
            -max_change[k - 1] * (1 - new_command_share),
            max_change[k - 1] * (1 - new_command_share),
        )
        n[k] = n_before_change + np.clip(
            next_command - n_before_change,
            -max_change[k - 1] * new_command_share,
            max_change[k - 1] * new_command_share,
        )
    return n


def fit_step_response(
    responses: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]],
) -> StepResponse:
    """Fit rate limit and dead time to step responses.

    Args:
        responses: time t [T] in s, command [T] and revolutions n [T] in 1/s of each response.

    Raises:
        FitError: if a response is too short, its command has no step, or the revolutions do not
            follow it.
    """
    for t, command, n in responses:
        if t.size < 20:
            raise FitError(f"step test: {t.size} samples; at least 20 are needed")
        if np.ptp(command) == 0:
            raise FitError("step test: the command never changes; a step is needed")
        if np.ptp(n) < 0.3 * np.ptp(command):
            raise FitError(
                "step test: the revolutions hardly follow the command; check columns and units, and"
                " log until they settle"
            )
    # initial estimates from the largest step: slope, and delay of the first 10 % of the response
    t, command, n = max(responses, key=lambda run: np.ptp(run[1]))
    # a percentile instead of the maximum, which would be noise
    max_slope = float(np.percentile(np.abs(np.gradient(n, t)), 95))
    step_time = t[np.flatnonzero(np.abs(command - command[0]) > 0.5 * np.ptp(command))[0]]
    response_index = np.flatnonzero((np.abs(n - n[0]) > 0.1 * np.ptp(n)) & (t >= step_time))
    initial_delay = (
        max(float(t[response_index[0]] - step_time) - 0.1 * np.ptp(n) / max_slope, 0.0)
        if response_index.size
        else 0.0
    )

    def residual(parameters: np.ndarray) -> np.ndarray:
        return np.concatenate(
            [
                simulate_shaft(
                    t,
                    command_samples,
                    abs(parameters[0]),
                    max(parameters[1], 0.0),
                    float(n[:3].mean()),
                )
                - n
                for t, command_samples, n in responses
            ]
        )

    n_samples = sum(response[0].size for response in responses)
    estimates, half_widths = _fit_with_intervals(
        residual,
        [max_slope, initial_delay],
        [max_slope, max(initial_delay, 10 * float(np.median(np.diff(t))))],
        n_samples,
        is_serial=True,
    )
    rate_limit = abs(estimates[0])
    dead_time = max(estimates[1], 0.0)
    return StepResponse(
        IntervalEstimate(
            rate_limit, rate_limit - half_widths[0], rate_limit + half_widths[0], "1/s^2"
        ),
        IntervalEstimate(
            dead_time, max(dead_time - half_widths[1], 0.0), dead_time + half_widths[1], "s"
        ),
    )


def fit_thrust_curves(
    n: np.ndarray, pull: np.ndarray, n_thrusters: int
) -> tuple[ThrustFit, ThrustFit]:
    """Fit the thrust curves ahead and astern of a thruster to a bollard pull test.

    Args:
        n: revolutions [N] in 1/s.
        pull: total pull [N] of all thrusters, in N.
        n_thrusters: number of thrusters that share the pull equally.

    Raises:
        FitError: if a direction has fewer than five points or four different revolutions, or its
            pull has the wrong sign.
    """
    return _fit_thrust_curve(n[n > 0], pull[n > 0] / n_thrusters, "ahead"), _fit_thrust_curve(
        n[n < 0], pull[n < 0] / n_thrusters, "astern"
    )


def _fit_thrust_curve(n: np.ndarray, thrust: np.ndarray, direction: str) -> ThrustFit:
    """Fit a quadratic to the thrust [N] of one thruster in one direction, with t intervals."""
    from scipy import stats

    n_levels = np.unique(np.round(n / max(float(np.abs(n).max(initial=0.0)), 1e-9), 2)).size
    if n.size < 5 or n_levels < 4:
        raise FitError(
            f"bollard pull {direction}: {n.size} points at {n_levels} revolutions; a quadratic with"
            " intervals needs 5 at 4 revolutions in each direction"
        )
    sign = 1.0 if direction == "ahead" else -1.0
    if float(np.sum(thrust * np.abs(n))) * sign < 0:
        raise FitError(
            f"bollard pull {direction}: the pull has the wrong sign; thrust is positive ahead and"
            " negative astern"
        )
    scale = float(np.abs(n).max())
    # scaled revolutions make the normal equations well-conditioned
    design_matrix = np.stack((np.ones_like(n), n / scale, (n / scale) ** 2), axis=1)
    solution, *_ = np.linalg.lstsq(design_matrix, thrust, rcond=None)
    residual = thrust - design_matrix @ solution
    variance = float(residual @ residual) / (n.size - 3)
    half_widths = np.sqrt(
        np.diag(np.linalg.inv(design_matrix.T @ design_matrix)) * variance
    ) * float(stats.t.ppf(0.975, n.size - 3))
    factors = np.array([1.0, scale, scale**2])
    estimates = zip(solution / factors, half_widths / factors, ("N", "N s", "N s^2"), strict=True)
    c0, c1, c2 = (
        IntervalEstimate(float(value), float(value - half_width), float(value + half_width), unit)
        for value, half_width, unit in estimates
    )
    return ThrustFit((c0, c1, c2), float(n.min()), float(n.max()), float(np.sqrt(variance)))


def _fit_with_intervals(
    residual: Callable[[np.ndarray], np.ndarray],
    initial: list[float],
    scale: list[float],
    n_samples: int,
    *,
    is_serial: bool = False,
) -> tuple[list[float], list[float]]:
    """Return the parameters and half widths of their 95 % confidence intervals.

    For time series the intervals are widened for autocorrelated residuals.
    """
    from scipy import stats
    from scipy.optimize import least_squares

    solution = least_squares(
        # large steps of the finite differences, because saturation and sampled delays make the
        # residual piecewise smooth
        residual,
        initial,
        x_scale=np.abs(scale),
        diff_step=[1e-3] * len(initial),
    )
    variance = 2 * float(solution.cost) / (n_samples - len(initial))
    if is_serial:
        centred_residual = solution.fun - solution.fun.mean()
        autocorrelation = float(
            np.clip(
                np.sum(centred_residual[1:] * centred_residual[:-1])
                / max(float(np.sum(centred_residual * centred_residual)), 1e-300),
                0.0,
                0.99,
            )
        )
        # variance inflation of an AR(1) process: n samples contain n (1 - a) / (1 + a) independent
        # ones
        variance *= (1 + autocorrelation) / (1 - autocorrelation)
    jacobian = np.asarray(solution.jac)
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * variance
    half_widths = np.sqrt(np.diag(covariance)) * float(stats.t.ppf(0.975, n_samples - len(initial)))
    return [float(parameter) for parameter in solution.x], [
        float(half_width) for half_width in half_widths
    ]

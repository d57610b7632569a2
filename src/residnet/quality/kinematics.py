"""Estimate inconsistencies between position, heading and velocities of a log.

The estimated causes are gains, lags, biases, the lever arm of the receiver and a current.

Increments of the pose between successive samples are compared with the integrals of the velocities.
White noise on pose and velocities gives the increments a tridiagonal covariance, by which they are
whitened. The difference is explained by few causes, selected by orthogonal matching pursuit over
groups of columns: each cause has columns with its effect on the increments. Standard errors are
sandwich estimates over twenty sections of the log, because filtered errors are not white.

A filter delays slow motions as another clock does, and faster ones by other times. The inverse of
either is a series in the derivatives of the channel (Oppenheim and Schafer, Discrete-Time Signal
Processing, sec. 5.1): the lag is the coefficient of the first one, that of motions slow against the
filter. Terms of second and third order are selected beside a lag as nuisances.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy

from residnet.preprocessing.channel_values import SIGMA_OF_MAD, nan_median, nan_std
from residnet.preprocessing.derivatives import fit_local_polynomials
from residnet.preprocessing.statistics import MIN_SAMPLES
from residnet.quality.statistics import (
    N_SECTIONS,
    SMOOTHING_SAMPLES,
    LogStatistics,
    fit_least_squares,
    interpolate_gaps,
)

_LAG_OF_CURVATURE = {
    name.replace("lag", "curvature"): name for name in ("lag", "lag_psi", "lag_xy")
}
"""Terms of second and third order -> lag without which they are not selected."""
_YAW_CLOCKS = {"lag": ("r",)}
_POSITION_CLOCKS = {"lag_psi": ("psi",), "lag": ("u", "v"), "lag_xy": ("psi", "u", "v")}
"""Lag -> channels that are shifted in time."""
_COURSE_TOLERANCE = 0.5
"""Largest difference of the share of the drift angle in a course from one."""
_MIN_COURSE_ADVANTAGE = 100.0
"""Smallest reduction of the BIC by a course in place of a lag: drift and yaw rate are nearly
proportional."""
_MAX_CLOCK_SAMPLES = 8000
"""Largest number of samples of a search of delays, which bounds its computing time."""
_MIN_CLOCK_ADVANTAGE = 20.0
"""Smallest reduction of the BIC by the shift of a clock."""
_MAX_CONDITION_INDEX = 30.0
"""Largest condition index of the causes beside a delay. Above it they cannot be separated: in a
zigzag of one period a delay of the heading is a gain of sway with a delay of u and v (Belsley, Kuh
and Welsch 1980, Regression Diagnostics, sec. 3.2)."""
_MAX_SHIFT = 3.0
"""Largest delay in s that is tried."""
_MAX_ROUNDING_SHARE = 1e-3
"""Unexplained share of the squared differences below which no delay is searched."""
_MAX_RECTANGLE_SHARE = 0.1
"""Largest squared difference from the rectangle rule over that from the trapezoidal rule at which a
pose is that of a simulation by Euler's method."""
_MIN_COMMON_SHARE = 0.7
"""Smallest number of increments of a hypothesis over the largest one."""
_MIN_SQUARED_SCALE = 0.01
"""Smallest variance of residuals over that of the noise: smaller ones are rounding."""
_MAX_ITERATIONS = 8
"""Largest number of iterations in the estimate of delays."""
_MAX_CAUSES = 4
"""Largest number of causes; chosen by hand, because further ones are collinear."""
# smallest reduction of the sum of squares by a cause in noise variances
_MIN_IMPROVEMENT = 60.0
# smallest t statistic of a cause
_MIN_T_STATISTIC = 3.5
_HALF_WINDOW = SMOOTHING_SAMPLES // 2
_IS_DISTANT = np.abs(np.arange(-_HALF_WINDOW, _HALF_WINDOW + 1)) > 1
_LEAVE_OUT_WEIGHTS = np.zeros(SMOOTHING_SAMPLES)
"""Weights of the parabolic smoother without the central sample and its neighbours."""
_LEAVE_OUT_WEIGHTS[_IS_DISTANT] = np.linalg.pinv(
    np.vander(np.arange(-_HALF_WINDOW, _HALF_WINDOW + 1)[_IS_DISTANT], 3)
)[-1]
_MIN_TRUE_SHARE = 1e-3
"""Smallest share of measured values that is true, in the conversion of a coefficient to a gain."""
_COLLINEARITY_TOLERANCE = 1e-9
"""Squared residual of a unit column regressed on others, below which it is collinear."""


Channels = Mapping[str, np.ndarray]
"""Name of a channel, as measured or smoothed -> values [T]."""


@dataclass(frozen=True)
class KinematicCause:
    """Estimated cause of a difference between two measurements.

    Attributes:
        estimates: size of the cause, one number per column.
        standard_errors: standard errors of the estimates.
    """

    estimates: np.ndarray
    standard_errors: np.ndarray

    @property
    def is_significant(self) -> bool:
        """Whether any estimate differs significantly from zero."""
        return bool((np.abs(self.estimates) > _MIN_T_STATISTIC * self.standard_errors).any())

    @property
    def is_gross(self) -> bool:
        """Whether a gain is a wrong sign or unit instead of a scale error."""
        return self.is_significant and not 0.6 < 1.0 + float(self.estimates[0]) < 1.6


@dataclass(frozen=True)
class _IncrementModel:
    """Increments of a pose, and the effects of possible causes on them.

    Attributes:
        measured_pose: measured pose [T], real or complex; NaN if missing.
        integrated_increments: integrals of the velocities [T - 1], NaN if missing.
        dt: time steps [T - 1] in s.
        pose_noise: standard deviation of the noise of the pose.
        rate_noise: standard deviation of the noise of the velocity [T - 1].
        columns: effect of each cause of unit size on the increments, arrays [T - 1].
        rate_factors: measured channels [T] whose product is the rate of the pose.
    """

    measured_pose: np.ndarray
    integrated_increments: np.ndarray
    dt: np.ndarray
    pose_noise: float
    rate_noise: np.ndarray
    columns: dict[str, list[np.ndarray]]
    rate_factors: tuple[np.ndarray, ...]

    def integrate_by_rectangles(self) -> _IncrementModel | None:
        """Return the model with the rectangle rule of a simulation; None if this fits no better.

        A simulation by Euler's method adds rates at the start of each step, or rates of which some
        are already those of its end. The trapezoidal integral differs from this by half a step,
        which is no delay of a clock.
        """
        increments = np.diff(self.measured_pose)
        integrals = [
            self.dt
            * math.prod(factor[end] for factor, end in zip(self.rate_factors, ends, strict=True))
            for ends in itertools.product(
                (slice(None, -1), slice(1, None)), repeat=len(self.rate_factors)
            )
        ]
        squares = [
            np.nanmean(np.abs(increments - integral) ** 2)
            for integral in (self.integrated_increments, *integrals)
        ]
        best = int(np.argmin(squares[1:]))
        if squares[1 + best] >= _MAX_RECTANGLE_SHARE * squares[0]:
            return None
        return replace(self, integrated_increments=integrals[best])


class _Explanation(NamedTuple):
    """Selected causes of the increments of a pose.

    Attributes:
        causes: cause -> estimate, in the order of selection.
        squares: squared whitened residuals [K] of the increments; NaN where they are not used.
        dimension: number of components of an increment.
        response_square: mean squared norm of the whitened increments before the regression.
        min_deviation: lower bound on the standard deviation of the increments in the whitening.
        n_parameters: number of columns of the regression.
        condition_index: ratio of the largest to the smallest singular value of the columns, which
            are scaled to unit length.
    """

    causes: dict[str, KinematicCause]
    squares: np.ndarray
    dimension: int
    response_square: float
    min_deviation: float
    n_parameters: int
    condition_index: float = 1.0

    def estimate(self, name: str) -> float:
        """Return the first estimate of a cause; 0 if it was not selected."""
        return float(self.causes[name].estimates[0]) if name in self.causes else 0.0


def _compute_bics(explanations: Sequence[_Explanation]) -> np.ndarray:
    """Return the BIC of explanations of the same increments over those that all of them use.

    Large residuals count as much as three standard deviations. An explanation that uses few
    increments has an infinite BIC.
    """
    squares = np.array([explanation.squares for explanation in explanations])
    n_used = np.isfinite(squares).sum(axis=1)
    is_compared = n_used > _MIN_COMMON_SHARE * n_used.max()
    squares = squares[:, np.isfinite(squares[is_compared]).all(axis=0)]
    n_common = max(squares.shape[1], 1)
    mean_squares = np.mean(np.minimum(squares, 9.0 * np.median(squares, axis=1)[:, None]), axis=1)
    # residuals far below the noise, or the differences that are explained, are rounding
    dimension = explanations[0].dimension
    min_square = dimension * max(
        _MIN_SQUARED_SCALE, _MAX_ROUNDING_SHARE * explanations[0].response_square
    )
    deviances = dimension * n_common * np.log(np.maximum(mean_squares, min_square))
    penalties = [explanation.n_parameters * math.log(n_common) for explanation in explanations]
    return np.where(is_compared, deviances + penalties, math.inf)


_MIN_HEADING_SIGNAL_TO_NOISE = 3.0
"""Smallest standard deviation of the heading over that of its noise, of which smoothing leaves .4,
for an estimate of the gain of r."""


def estimate_yaw_causes(log: LogStatistics) -> dict[str, KinematicCause]:
    """Estimate the causes of differences between the increments of psi and the integral of r.

    Causes: `gain` (r is 1 + value times too large), `lag` (delay of r against psi in s), `bias` (of
    r in rad/s) and `ramp` (growth of the bias from start to end in rad/s); or only `course` if psi
    is the course over ground (share of the drift angle atan2(v, u) that psi contains).
    """
    model = _model_heading(log, _select_channels(log, "r"))
    # half a step of a simulation is no drift, either
    if "u" in log and "v" in log and model.integrate_by_rectangles() is None:
        drift = np.unwrap(np.arctan2(log.smoothed("v"), log.smoothed("u")))
        columns = {name: model.columns[name] for name in ("bias", "ramp")}
        columns["course"] = [np.diff(drift)]
        # drift and yaw rate are nearly proportional, so that a course resembles a delay
        explanations = [_explain_increments(m) for m in (model, replace(model, columns=columns))]
        bics = _compute_bics(explanations)
        share = explanations[1].estimate("course")
        if bics[1] < bics[0] - _MIN_COURSE_ADVANTAGE and abs(share - 1.0) < _COURSE_TOLERANCE:
            return {"course": explanations[1].causes["course"]}
    return _compare_clocks(log, _model_heading, ("r",), _YAW_CLOCKS)


def _model_heading(log: LogStatistics, channels: Channels) -> _IncrementModel:
    """Return the model of the increments of psi by the integral of r and its errors.

    Args:
        log: statistics of the log.
        channels: measured and smoothed channels, of which some may be shifted.
    """
    t = log.t
    dt = np.diff(t)
    smoothed_rate = channels["r smoothed"]
    normalized_time = (0.5 * (t[1:] + t[:-1]) - t.mean()) / max(float(t[-1] - t[0]), 1e-12)
    columns = {"bias": [-dt], "ramp": [-dt, -dt * normalized_time]}
    # with a constant heading, gain and bias of r are collinear
    heading_std = nan_std(log.cached(_smooth_leaving_out_centre, "psi"))
    if log.cached(
        _is_significant, "r"
    ) and heading_std > _MIN_HEADING_SIGNAL_TO_NOISE * log.noise_std("psi"):
        columns = {"gain": [-_integrate(log.t, smoothed_rate)], **columns}
        columns["lag"] = [np.diff(smoothed_rate)]
        columns["curvature"] = _differentiate_twice(smoothed_rate, t)
    rate_noise = np.full(dt.size, log.noise_std("r"))
    return _IncrementModel(
        log["psi"],
        _integrate(log.t, channels["r"]),
        dt,
        log.noise_std("psi"),
        rate_noise,
        columns,
        (channels["r"],),
    )


def estimate_position_causes(log: LogStatistics) -> dict[str, KinematicCause]:
    """Estimate the causes of differences between increments of x, y and integrals of R(psi) [u, v].

    Causes: `gain_u`, `gain_v`, `gain` (u, v or both are 1 + value times too large), `heading`
    (correction of psi in rad), `lag` (delay of u and v against the position in s), `lag_psi` (delay
    of psi in s), `lag_xy` (delay of x, y in s), `lever_arm` (position of
    the receiver forward and to starboard in m), `current` (north and east in m/s, if u, v are
    relative to the water), `bias` (of u, v in m/s).
    """
    return _compare_clocks(log, _model_positions, ("u", "v", "psi"), _POSITION_CLOCKS)


def _model_positions(log: LogStatistics, channels: Channels) -> _IncrementModel:
    """Return the model of the increments of x, y by the integrals of R(psi) [u, v] and errors.

    Args:
        log: statistics of the log.
        channels: measured and smoothed channels, of which some may be shifted.
    """
    dt = np.diff(log.t)
    psi = channels["psi"]
    # horizontal vectors are complex numbers: north + 1j east, or forward + 1j starboard
    heading_rotation = np.exp(1j * psi)
    u = channels["u smoothed"]
    v = channels["v smoothed"]
    surge_increments = _integrate(log.t, heading_rotation * u)
    sway_increments = 1j * _integrate(log.t, heading_rotation * v)
    both_increments = surge_increments + sway_increments
    rotation_increments = np.diff(heading_rotation)
    integrated_rotation = _integrate(log.t, heading_rotation)
    columns: dict[str, list[np.ndarray]] = {
        "gain_u": [-surge_increments],
        "gain_v": [-sway_increments],
        "gain": [-both_increments],
        "heading": [-1j * both_increments],
    }
    columns |= _differentiate_by_lags(log.t, channels)
    columns |= {
        "lever_arm": [rotation_increments, 1j * rotation_increments],
        "current": [dt + 0j, 1j * dt],
        "bias": [
            -integrated_rotation,
            -1j * integrated_rotation,
        ],
    }
    noise_only_channels = {name for name in ("u", "v") if not log.cached(_is_significant, name)}
    noise_only_channels |= {"psi"} if "r" in log and not log.cached(_is_significant, "r") else set()
    columns = {
        name: cause_columns
        for name, cause_columns in columns.items()
        if not any(name in _UNIDENTIFIABLE_CAUSES[channel] for channel in noise_only_channels)
    }
    speed = np.hypot(np.nan_to_num(channels["u"]), np.nan_to_num(channels["v"]))
    heading_noise_velocity = log.noise_std("psi") * 0.5 * (speed[1:] + speed[:-1])
    rate_noise = np.hypot(max(log.noise_std("u"), log.noise_std("v")), heading_noise_velocity)
    velocity = channels["u"] + 1j * channels["v"]
    return _IncrementModel(
        log["x"] + 1j * log["y"],
        _integrate(log.t, heading_rotation * velocity),
        dt,
        max(log.noise_std("x"), log.noise_std("y")),
        rate_noise,
        columns,
        (heading_rotation, velocity),
    )


def _differentiate_by_lags(t: np.ndarray, channels: Channels) -> dict[str, list[np.ndarray]]:
    """Return the effects of lags on the increments of the position, and those of second order."""
    heading_rotation = np.exp(1j * channels["psi"])
    mid_rotation = np.exp(0.5j * (channels["psi"][1:] + channels["psi"][:-1]))
    velocity = channels["u smoothed"] + 1j * channels["v smoothed"]
    mid_velocity = 0.5 * (velocity[1:] + velocity[:-1])
    earth_velocity = heading_rotation * velocity
    lag = mid_rotation * np.diff(velocity)
    lag_psi = 0.5j * np.diff(channels["psi smoothed"]) * (earth_velocity[1:] + earth_velocity[:-1])
    return {
        "lag": [lag],
        "lag_psi": [lag_psi],
        "lag_xy": [-(lag + lag_psi)],
        "curvature": [mid_rotation * steps for steps in _differentiate_twice(velocity, t)],
        "curvature_psi": [
            mid_velocity * steps for steps in _differentiate_twice(heading_rotation, t)
        ],
        "curvature_xy": _differentiate_twice(earth_velocity, t),
    }


def _select_channels(log: LogStatistics, *names: str) -> dict[str, np.ndarray]:
    """Return channels [T] of a log as measured and smoothed."""
    smoothed = {f"{n} smoothed": log.cached(_smooth_leaving_out_centre, n) for n in names}
    return {**{name: log[name] for name in names}, **smoothed}


def _compare_clocks(
    log: LogStatistics,
    make_model: Callable[..., _IncrementModel],
    names: Sequence[str],
    clocks: Mapping[str, tuple[str, ...]],
) -> dict[str, KinematicCause]:
    """Estimate the causes with the delay of a clock, if this is more likely.

    A lag in the regression is the first term of a series. Where a delay is longer than the motion
    takes to change, the series diverges, and other causes explain more than this term. Therefore
    the channels of each clock are also shifted by its delay, which is estimated by the Gauss-Newton
    method, and the BIC compares these hypotheses with the regression alone.

    Args:
        log: statistics of the log.
        make_model: function that returns the model of the increments with shifted channels.
        names: channels that may be shifted.
        clocks: lag -> channels with its clock.
    """
    channels = _select_channels(log, *names)
    model = make_model(log, channels)
    rectangle_model = model.integrate_by_rectangles()
    if rectangle_model is not None:
        return _explain_increments(rectangle_model).causes
    regression = _explain_increments(model)
    # a delay is a lag to first order; without one, a shift imitates a cause such as a lever arm
    if not regression.causes.keys() & clocks.keys():
        return regression.causes
    # what is left of exact values is rounding
    residual_square = float(np.nan_to_num(regression.squares).mean())
    if residual_square <= _MAX_ROUNDING_SHARE * regression.response_square:
        return regression.causes
    excerpt = log.excerpt_middle(_MAX_CLOCK_SAMPLES)
    clock, n_samples = _select_clock(excerpt, make_model, _select_channels(excerpt, *names), clocks)
    if n_samples == 0:
        return regression.causes
    shifted = _shift_channels(log, channels, clocks[clock], n_samples)
    causes = _explain_increments(make_model(log, shifted), [clock]).causes
    if clock in causes:
        delay = _clock_sign(clock) * n_samples * log.sampling_interval
        causes[clock] = replace(causes[clock], estimates=causes[clock].estimates + delay)
    return causes


def _select_clock(
    log: LogStatistics,
    make_model: Callable[..., _IncrementModel],
    channels: Channels,
    clocks: Mapping[str, tuple[str, ...]],
) -> tuple[str, int]:
    """Return the likeliest clock and the number of samples by which its channels are taken later.

    A clock is selected if it reduces the BIC by more than `_MIN_CLOCK_ADVANTAGE`; otherwise the
    number is 0. A lag of the regression accounts for a second clock.
    """
    model = make_model(log, channels)
    regression = _explain_increments(model)
    explanations = [regression]
    shifts = [("", 0)]
    for clock in clocks:
        if clock not in model.columns:
            continue
        n_samples = 0
        for _ in range(_MAX_ITERATIONS):
            # Gauss-Newton: the lag that is left corrects the shift
            shifted = _shift_channels(log, channels, clocks[clock], n_samples)
            explanation = _explain_increments(
                make_model(log, shifted), [clock], regression.min_deviation
            )
            lag = _clock_sign(clock) * explanation.estimate(clock)
            correction = round(lag / log.sampling_interval)
            is_too_long = abs(n_samples + correction) * log.sampling_interval > _MAX_SHIFT
            if correction == 0 or is_too_long:
                break
            n_samples += correction
        # the causes must be separable
        if not is_too_long and explanation.condition_index <= _MAX_CONDITION_INDEX:
            explanations.append(explanation)
            shifts.append((clock, n_samples))
    bics = _compute_bics(explanations)
    bics[0] -= _MIN_CLOCK_ADVANTAGE
    return shifts[int(np.argmin(bics))]


def _clock_sign(name: str) -> float:
    """Return -1 for the clock of the position, for which all other channels are shifted."""
    return -1.0 if name == "lag_xy" else 1.0


def _shift_channels(
    log: LogStatistics, channels: Channels, names: Sequence[str], n_samples: int
) -> dict[str, np.ndarray]:
    """Return the channels with some of them taken a number of samples later; NaN beyond ends."""
    is_outside = log.near_seam(abs(n_samples))
    index = np.arange(len(log)) + n_samples
    is_outside |= (index < 0) | (index >= len(log))
    index = np.clip(index, 0, len(log) - 1)
    shifted = dict(channels)
    for name in names:
        for key in (name, f"{name} smoothed"):
            shifted[key] = np.where(is_outside, np.nan, channels[key][index])
    return shifted


# channel -> causes that are not identifiable if it holds noise only, because of the shared noise
_UNIDENTIFIABLE_CAUSES = {
    "u": ("gain_u", "gain", "lag", "lag_xy", "heading"),
    "v": ("gain_v",),
    "psi": ("lag_psi", "lever_arm"),
}


def _differentiate_twice(values: np.ndarray, t: np.ndarray) -> list[np.ndarray]:
    """Return the steps [T - 1] of the first and the second derivative of values [T]; no NaN."""
    derivative = interpolate_gaps(np.arange(values.size), values)
    steps = []
    for _ in range(2):
        derivative = np.gradient(derivative, t)
        steps.append(np.diff(derivative))
    return steps


def _integrate(t: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Return the trapezoidal integrals [T - 1] of a rate [T] over the steps between times [T]."""
    return np.asarray(0.5 * np.diff(t) * (rates[1:] + rates[:-1]))


def _is_significant(log: LogStatistics, name: str) -> bool:
    """Return whether the RMS of a smoothed channel exceeds its noise."""
    return float(
        np.sqrt(np.nanmean(log.cached(_smooth_leaving_out_centre, name) ** 2))
    ) > 1.2 * log.noise_std(name)


def _smooth_leaving_out_centre(log: LogStatistics, name: str) -> np.ndarray:
    """Smooth a channel [T] by a parabola over 15 samples without the central three.

    Smoothed regressors then share no noise with the response, which contains the noise of the
    central samples. Near the ends of a log the central samples are included. NaN is preserved.
    """
    values = log[name]
    is_finite = np.isfinite(values)
    if is_finite.sum() < SMOOTHING_SAMPLES:
        return values
    gap_free = interpolate_gaps(np.arange(values.size), values)
    smoothed_values = fit_local_polynomials(gap_free[:, None], SMOOTHING_SAMPLES, 2, 1.0)[0][:, 0]
    smoothed_values[_HALF_WINDOW:-_HALF_WINDOW] = np.convolve(gap_free, _LEAVE_OUT_WEIGHTS, "valid")
    return np.where(is_finite & ~log.near_seam(_HALF_WINDOW), smoothed_values, np.nan)


def _explain_increments(
    model: _IncrementModel, required: Sequence[str] = (), min_deviation: float = 0.0
) -> _Explanation:
    """Select and estimate the causes that explain the increments of a pose.

    Args:
        model: increments and the effects of causes.
        required: causes that are selected first.
        min_deviation: smallest standard deviation of the increments in the whitening, which is the
            same for all hypotheses that are compared.
    """
    measured_pose = model.measured_pose
    dt = model.dt
    columns = model.columns
    measured_indices = np.flatnonzero(np.isfinite(measured_pose))

    def sum_between_poses(steps: np.ndarray) -> np.ndarray:
        """Return the sums [K, ...] of steps [T - 1, ...] between measured poses; NaN if any is."""
        if measured_indices.size == measured_pose.size:
            return steps
        is_missing = ~np.isfinite(steps)
        initial_zeros = np.zeros((1, *steps.shape[1:]))
        cumulative_sums = np.concatenate(
            (initial_zeros, np.cumsum(np.where(is_missing, 0.0, steps), axis=0))
        )[measured_indices]
        n_missing = np.concatenate((initial_zeros, np.cumsum(is_missing, axis=0)))[measured_indices]
        return np.where(np.diff(n_missing, axis=0) > 0, np.nan, np.diff(cumulative_sums, axis=0))

    squares = np.full(max(measured_indices.size - 1, 0), np.nan)
    if measured_indices.size < MIN_SAMPLES:
        return _Explanation({}, squares, 1, 0.0, 0.0, 0)
    unexplained_increments = np.diff(measured_pose[measured_indices])
    unexplained_increments = unexplained_increments - sum_between_poses(model.integrated_increments)
    durations = sum_between_poses(dt)
    variance = (dt * model.rate_noise) ** 2
    cause_columns = sum_between_poses(
        np.stack(
            [column for columns_of_cause in columns.values() for column in columns_of_cause],
            axis=-1,
        )
    )
    is_usable = (
        np.isfinite(unexplained_increments)
        & np.isfinite(cause_columns).all(axis=1)
        & np.isfinite(sum_between_poses(model.rate_noise))
    )
    retained_indices = np.flatnonzero(is_usable & (durations <= 3.0 * nan_median(durations)))
    if retained_indices.size < MIN_SAMPLES:
        return _Explanation({}, squares, 1, 0.0, 0.0, 0)
    total_variance = sum_between_poses(variance)[retained_indices]
    shared_variance = variance[np.minimum(measured_indices[retained_indices], variance.size - 1)]
    shared_variance = np.where(
        np.isfinite(shared_variance), np.minimum(shared_variance, total_variance), total_variance
    )
    typical_increment = nan_median(np.abs(unexplained_increments[retained_indices]))
    min_deviation = max(min_deviation, 1e-3 * typical_increment + 1e-12)
    # successive increments share one noisy pose (negative covariance) and half a noisy velocity
    # (positive covariance); the sum is limited to non-positive values, because a positive one would
    # make the whitening amplify the highest frequencies
    end_variance = np.maximum(model.pose_noise**2 - 0.25 * shared_variance, 0.0)
    is_adjacent = np.append(retained_indices[1:] == retained_indices[:-1] + 1, False)
    # with noise of the pose only, the covariance is almost singular: the diagonal is increased
    covariance_band = np.stack(
        (
            1.0001 * (total_variance + 2.0 * end_variance + min_deviation**2),
            np.where(is_adjacent, -end_variance, 0.0),
        )
    )
    cholesky_factor = scipy.linalg.cholesky_banded(covariance_band, lower=True)
    # real and imaginary parts become successive rows, so that a section contains both
    whitened_rows = np.column_stack(
        (unexplained_increments[retained_indices], cause_columns[retained_indices])
    )
    whitened_rows = scipy.linalg.solve_banded(
        (1, 0), cholesky_factor, whitened_rows, overwrite_b=True
    )
    if np.iscomplexobj(whitened_rows):
        whitened_rows = np.stack((whitened_rows.real, whitened_rows.imag), axis=1).reshape(
            -1, whitened_rows.shape[1]
        )
    y = whitened_rows[:, 0]
    has_effect = whitened_rows[:, 1:].any(axis=0)
    cause_columns = whitened_rows[:, 1:][:, has_effect]
    names = np.array([name for name, columns_of_cause in columns.items() for _ in columns_of_cause])
    names = names[has_effect]
    # large residuals that no cause explains are jumps of the pose, which are excluded
    scaled_columns = cause_columns / np.abs(cause_columns).max(axis=0)
    abs_residuals = np.abs(
        y
        - scaled_columns
        @ np.linalg.lstsq(scaled_columns.T @ scaled_columns, scaled_columns.T @ y, rcond=1e-12)[0]
    )
    is_inlier = abs_residuals <= 8.0 * SIGMA_OF_MAD * max(nan_median(abs_residuals), 1e-300)
    causes, coefficients = _orthogonal_matching_pursuit(
        np.where(is_inlier, y, 0.0),
        np.where(is_inlier[:, None], cause_columns, 0.0),
        names,
        required,
    )
    residuals = y - cause_columns @ coefficients
    squares_by_component = (residuals**2).reshape(retained_indices.size, -1)
    squares[retained_indices] = squares_by_component.sum(axis=1)
    is_selected = coefficients != 0.0
    dimension = squares_by_component.shape[1]
    response_square = dimension * float(np.mean(y**2))
    return _Explanation(
        causes,
        squares,
        dimension,
        response_square,
        min_deviation,
        int(np.count_nonzero(is_selected)),
        _compute_condition_index(cause_columns[is_inlier][:, is_selected]),
    )


def _compute_condition_index(columns: np.ndarray) -> float:
    """Return the condition number of columns [N, k] scaled to unit length; 1 without columns."""
    if columns.shape[1] == 0:
        return 1.0
    return float(np.linalg.cond(columns / np.linalg.norm(columns, axis=0)))


def _orthogonal_matching_pursuit(
    response: np.ndarray, regressors: np.ndarray, names: np.ndarray, required: Sequence[str]
) -> tuple[dict[str, KinematicCause], np.ndarray]:
    """Select groups of columns by orthogonal matching pursuit.

    Args:
        response: whitened response [N].
        regressors: whitened columns [N, k].
        names: cause of each column [k].
        required: causes that are selected first.

    Returns:
        Cause -> estimate, in the order of selection, and the coefficients [k] of all columns.
    """
    coefficients = np.zeros(names.size)
    column_norms = np.maximum(np.linalg.norm(regressors, axis=0), 1e-300)
    regressors = regressors / column_norms
    gram = regressors.T @ regressors
    product = regressors.T @ response
    energy = float(response @ response)
    columns_by_cause = {
        name: np.flatnonzero(names == name) for name in dict.fromkeys(names.tolist())
    }

    def compute_residual_energy(causes: Iterable[str]) -> float:
        """Return the residual sum of squares of a fit with some causes."""
        column_indices = np.concatenate([columns_by_cause[name] for name in causes])
        coefficients = np.linalg.lstsq(
            gram[column_indices][:, column_indices],
            product[column_indices],
            rcond=_COLLINEARITY_TOLERANCE,
        )[0]
        return energy - float(product[column_indices] @ coefficients)

    if not columns_by_cause:
        return {}, coefficients
    variance = max(
        compute_residual_energy(columns_by_cause) / response.size, 1e-12 * energy / response.size
    )
    min_gain_by_cause = {
        cause_name: _MIN_IMPROVEMENT * variance * (1.0 + 0.2 * is_selected.size)
        for cause_name, is_selected in columns_by_cause.items()
    }
    selected_causes = [name for name in required if name in columns_by_cause]
    residual_energy = compute_residual_energy(selected_causes) if selected_causes else energy
    while len([name for name in selected_causes if name not in _LAG_OF_CURVATURE]) < _MAX_CAUSES:
        residual_energy_by_cause = {
            name: compute_residual_energy([*selected_causes, name])
            for name in columns_by_cause
            if name not in selected_causes
            and _LAG_OF_CURVATURE.get(name, name) in (name, *selected_causes)
        }
        # among equivalent causes (a lag of one channel, or of all others) the first counts;
        # rounding makes their gains equal
        net_gain_by_cause = {
            cause_name: round(
                (residual_energy - energy_of_cause - min_gain_by_cause[cause_name])
                / max(energy, 1e-300),
                9,
            )
            for cause_name, energy_of_cause in residual_energy_by_cause.items()
        }
        best_cause = max(net_gain_by_cause, key=lambda name: net_gain_by_cause[name], default="")
        if not best_cause or net_gain_by_cause[best_cause] <= 0.0:
            break
        selected_causes = [*selected_causes, best_cause]
        residual_energy = residual_energy_by_cause[best_cause]
    if not selected_causes:
        return {}, coefficients
    is_selected = np.isin(names, selected_causes)
    columns = regressors[:, is_selected]
    names = names[is_selected]
    column_norms = column_norms[is_selected]
    least_squares_fit = fit_least_squares(columns, response)
    white_noise_covariance = (
        np.linalg.pinv(columns.T @ columns)
        * least_squares_fit.sum_of_squares
        / max(response.size - columns.shape[1], 1)
    )
    sandwich_variance = np.diag(least_squares_fit.covariance) * N_SECTIONS / (N_SECTIONS - 1)
    standard_errors = (
        np.sqrt(np.maximum(sandwich_variance, np.diag(white_noise_covariance))) / column_norms
    )
    estimates = least_squares_fit.coefficients / column_norms
    coefficients[is_selected] = estimates
    # columns of gains are integrals of the measured values, which are 1 + gain times too large
    is_gain = np.array([name.startswith("gain") for name in names.tolist()])
    true_share = np.where(is_gain, 1.0 - estimates, 1.0)
    true_share = np.copysign(np.maximum(np.abs(true_share), _MIN_TRUE_SHARE), true_share)
    # the ratio to the standard error stays that of the regression
    standard_errors = standard_errors / np.abs(true_share)
    estimates = estimates / true_share
    causes = {
        name: KinematicCause(estimates[names == name], standard_errors[names == name])
        for name in selected_causes
        if name not in _LAG_OF_CURVATURE
    }
    return causes, coefficients

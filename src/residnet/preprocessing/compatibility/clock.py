"""Estimate the offset between two clocks from a heading on one and a yaw rate on the other.

The derivative of the heading is cross-correlated with the yaw rate over all offsets. Around the
maximum the heading is regressed on the integral of the yaw rate, with the offset, the drift, and
bias and scale of the gyro as parameters. Nothing is assumed about the vessel.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from residnet.preprocessing.channel_values import estimate_noise_std
from residnet.preprocessing.derivatives import fit_local_polynomials

_GRID_STEP = 0.1
"""Step in s of the offsets of the cross-correlation; doubled for long recordings."""
_MAX_GRID_SAMPLES = 200_000
"""Largest number of grid samples of a recording."""
_MIN_OVERLAP = 0.4
"""Smallest overlap, as a share of the shorter recording."""
_WINDOWS_SECONDS = (1.0, 3.0, 9.0)
"""Windows in s of the parabolas that differentiate the heading, for fast and slow turns."""
_EXCLUDED_SECONDS = 1.0
"""Distance in s from the optimum within which an offset is no alternative."""
_MAX_ITERATIONS = 30
"""Largest number of iterations of offset, drift and weights."""
_KNOT_SECONDS = 10.0
"""Distance in s of the knots of the random walk between the heading and the integral of r."""
_MAX_KNOTS = 60
"""Largest number of these knots."""
_MAX_GAPS = 10
"""Largest number of gaps of the yaw rate across which its integral may jump."""
_STUDENT_DOF = 5.0
"""Degrees of freedom of the residuals' Student distribution, robust against outliers."""
_N_SECTIONS = 20
"""Number of sections of the sandwich covariance, because residuals are correlated."""
_MIN_DRIFT_SECONDS = 600.0
"""Smallest overlap in s over which a drift of the clock is estimated."""


class ClockEstimate(NamedTuple):
    """Estimated offset between two clocks.

    Attributes:
        seconds: time in s to add to the clock of the yaw rate, at the middle of the overlap.
        standard_error: standard error of the offset in s.
        drift: share by which the clock of the yaw rate runs slow; 0 if it was not estimated.
        middle: time in the middle of the overlap in s, on the clock of the heading.
        correlation: correlation of the yaw rate with the derivative of the heading.
        margin: logarithm of the likelihood ratio to the best offset farther away than one second
            and than the window in which the heading is differentiated.
            Each 2 s of the overlap, or each window, count as one independent sample.
    """

    seconds: float
    standard_error: float
    drift: float
    middle: float
    correlation: float
    margin: float

    def convert_times(self, t: np.ndarray) -> np.ndarray:
        """Return times [T] of the clock of the yaw rate on the clock of the heading."""
        return np.asarray(t + self.seconds + self.drift * (t + self.seconds - self.middle))


def estimate_clock_from_rate(
    heading_times: np.ndarray, heading: np.ndarray, rate_times: np.ndarray, yaw_rate: np.ndarray
) -> ClockEstimate | None:
    """Estimate the time to add to the clock of a gyro so that it follows a heading.

    Args:
        heading_times: times of the heading [T] in s, increasing.
        heading: heading [T] in rad, unwrapped; NaN for missing values.
        rate_times: times of the yaw rate [K] in s on the clock of the gyro, increasing.
        yaw_rate: yaw rate [K], of any scale and sign; NaN for missing values.

    Returns:
        The estimate; None if there are too few values or no turns.
    """
    has_heading = np.isfinite(heading) & np.isfinite(heading_times)
    has_rate = np.isfinite(yaw_rate) & np.isfinite(rate_times)
    if min(int(has_heading.sum()), int(has_rate.sum())) < 50:
        return None
    heading_times = heading_times[has_heading]
    heading = heading[has_heading]
    rate_times = rate_times[has_rate]
    yaw_rate = yaw_rate[has_rate]
    records = heading_times, heading, rate_times, yaw_rate
    estimates = {
        window: estimate
        for window in _WINDOWS_SECONDS
        if (estimate := _correlate_rates(*records, window)) is not None
    }
    if not estimates:
        return None
    window = max(estimates, key=lambda window: estimates[window].margin)
    return _refine_offset(estimates[window], *records, window)


def _correlate_rates(
    heading_times: np.ndarray,
    heading: np.ndarray,
    rate_times: np.ndarray,
    yaw_rate: np.ndarray,
    window_seconds: float,
) -> ClockEstimate | None:
    """Maximise the normalised cross-correlation over all offsets with sufficient overlap."""
    durations = (heading_times[-1] - heading_times[0], rate_times[-1] - rate_times[0])
    step = max(_GRID_STEP, float(np.median(np.diff(heading_times))) / 2.0)
    step = max(step, float(max(durations)) / _MAX_GRID_SAMPLES)
    grids = (
        np.arange(heading_times[0], heading_times[-1], step),
        np.arange(rate_times[0], rate_times[-1], step),
    )
    window = max(5, 2 * round(0.5 * window_seconds / step) + 1)
    if min(grids[0].size, grids[1].size) < 3 * window:
        return None
    resampled_heading = np.interp(grids[0], heading_times, heading)[:, None]
    reference = fit_local_polynomials(resampled_heading, window, 2, step)[1][:, 0]
    signal = _smooth_rate(np.interp(grids[1], rate_times, yaw_rate), window)
    reference = reference - reference.mean()
    signal = signal - signal.mean()
    size = 1 << (reference.size + signal.size - 1).bit_length()

    def correlate(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Return the sum of first[i + lag] second[i] for each lag modulo the size."""
        spectrum = np.fft.rfft(first, size) * np.conj(np.fft.rfft(second, size))
        return np.asarray(np.fft.irfft(spectrum, size))

    # correlations with ones give the sums over the overlap at each lag
    reference_ones = np.ones(reference.size)
    signal_ones = np.ones(signal.size)
    counts = np.maximum(correlate(reference_ones, signal_ones), 1.0)
    reference_sum = correlate(reference, signal_ones)
    signal_sum = correlate(reference_ones, signal)
    reference_energy = correlate(reference**2, signal_ones) - reference_sum**2 / counts
    signal_energy = correlate(reference_ones, signal**2) - signal_sum**2 / counts
    product = correlate(reference, signal) - reference_sum * signal_sum / counts
    # an overlap without turns has no signal and no information on the offset
    min_energy_product = 1e-6 * float(reference @ reference) * float(signal @ signal)
    if min_energy_product <= 0.0:
        return None
    correlation = product / np.sqrt(
        np.maximum(reference_energy * signal_energy, min_energy_product)
    )
    correlation = np.clip(correlation, -0.9999, 0.9999)
    has_overlap = counts >= _MIN_OVERLAP * min(reference.size, signal.size)
    # log-likelihood ratio of a regression with this correlation, which grows with the overlap
    independent_share = min(step / max(2.0, window_seconds), 1.0)
    scores = -0.5 * independent_share * counts * np.log(1.0 - correlation**2) * has_overlap
    best_index = int(np.argmax(scores))
    lags = np.arange(size)
    lags = np.where(lags < reference.size, lags, lags - size)
    is_distant = np.abs(lags - lags[best_index]) * step > max(_EXCLUDED_SECONDS, window_seconds)
    margin = float(scores[best_index] - scores[is_distant].max(initial=0.0))
    seconds = float(grids[0][0] + lags[best_index] * step - grids[1][0])
    standard_error = max(step, 0.1 * window_seconds)
    return ClockEstimate(seconds, standard_error, 0.0, 0.0, float(correlation[best_index]), margin)


def _smooth_rate(yaw_rate: np.ndarray, window: int) -> np.ndarray:
    """Return the yaw rate [K] as the derivatives of local parabolas through its integral.

    These are means with parabolic weights over a window of samples.
    """
    window = min(2 * (window // 2) + 1, 2 * ((yaw_rate.size - 1) // 2) + 1)
    weights = 1.0 - np.linspace(-1.0, 1.0, window + 2)[1:-1] ** 2
    mean = yaw_rate.mean()
    smoothed = np.convolve(yaw_rate - mean, weights / weights.sum(), mode="same")
    return np.asarray(mean + smoothed)


def _refine_offset(
    coarse_estimate: ClockEstimate,
    heading_times: np.ndarray,
    heading: np.ndarray,
    rate_times: np.ndarray,
    yaw_rate: np.ndarray,
    window_seconds: float,
) -> ClockEstimate:
    """Refine an offset by regressing the heading on the shifted integral of the yaw rate.

    Args:
        coarse_estimate: result of the cross-correlation.
        heading_times: times of the heading [T] in s.
        heading: heading [T] in rad.
        rate_times: times of the yaw rate [K] in s on the clock of the gyro.
        yaw_rate: yaw rate [K].
        window_seconds: window in s in which the yaw rate is smoothed for derivatives by the offset.

    Returns:
        The refined estimate; the coarse_estimate one if the regression does not converge near it.
    """
    half_steps = 0.5 * np.diff(rate_times)
    integral = np.append(0.0, np.cumsum(half_steps * (yaw_rate[1:] + yaw_rate[:-1])))
    start = max(heading_times[0], rate_times[0] + coarse_estimate.seconds)
    stop = min(heading_times[-1], rate_times[-1] + coarse_estimate.seconds)
    middle = 0.5 * float(start + stop)
    in_overlap = (heading_times > start + 1.0) & (heading_times < stop - 1.0)
    # a heading within a gap of the yaw rate would be compared with an interpolated integral
    intervals = np.diff(rate_times)
    next_sample = np.searchsorted(rate_times, heading_times - coarse_estimate.seconds).clip(
        1, rate_times.size - 1
    )
    max_interval = 3.5 * float(np.median(intervals)) + 1e-9
    in_overlap &= intervals[next_sample - 1] < max_interval
    t = heading_times[in_overlap]
    nuisance, n_knots = _make_nuisance_columns(
        t, (float(start), float(stop)), rate_times + coarse_estimate.seconds, max_interval
    )
    response = heading[in_overlap]
    if t.size < 30:
        return coarse_estimate
    seconds = coarse_estimate.seconds
    # noise in the derivative by the offset would count as information on it
    smoothed_rate = _smooth_rate(yaw_rate, round(window_seconds / float(np.median(intervals))))
    has_drift = bool(stop - start > _MIN_DRIFT_SECONDS)
    drift = 0.0
    weights = np.ones(t.size)
    columns = np.zeros((t.size, 0))
    residual = response
    integral_at_heading = np.interp(t - seconds, rate_times, integral)
    gain = float(np.linalg.lstsq(np.column_stack((integral_at_heading, nuisance)), response)[0][0])
    residual_std = 0.0
    walk_std = 1.0
    rate_noise = estimate_noise_std(yaw_rate)
    knot_interval = float(stop - start) / (n_knots - 1)
    # prior of the random walk: without it, the walk absorbs turns that are slower than its knots
    n_other = nuisance.shape[1] - n_knots
    prior = np.pad(np.diff(np.eye(n_knots), axis=0), ((0, 0), (3, n_other)))
    for _ in range(_MAX_ITERATIONS):
        shifted = t - seconds - drift * (t - middle)
        rate = np.interp(shifted, rate_times, smoothed_rate)
        columns = np.column_stack((np.interp(shifted, rate_times, integral), nuisance))
        slope = -gain * rate
        columns = np.column_stack((slope, slope * (t - middle) * has_drift, columns))
        solution = _solve_weighted(columns, response, weights, prior * residual_std / walk_std)
        residual = response - columns @ solution
        residual_std = max(float(np.median(np.abs(residual))) / 0.6745, 1e-9)
        weights = (_STUDENT_DOF + 1.0) / (_STUDENT_DOF + (residual / residual_std) ** 2)
        seconds += float(np.clip(solution[0], -0.3, 0.3))
        drift += float(np.clip(solution[1], -1e-4, 1e-4)) if has_drift else 0.0
        gain = float(solution[2])
        # white noise of the gyro makes the smallest walk; a drifting bias adds to it
        steps = prior @ solution
        noise_walk = gain * rate_noise * math.sqrt(knot_interval * float(np.median(intervals)))
        walk_std = max(abs(noise_walk), float(np.sqrt(np.mean(steps**2))), 1e-9)
        if abs(solution[0]) < 1e-4:
            break
    if abs(seconds - coarse_estimate.seconds) > 5.0 * max(coarse_estimate.standard_error, 0.2):
        return coarse_estimate
    prior *= residual_std / walk_std
    standard_error = _compute_standard_error(columns, residual, weights, prior)
    return coarse_estimate._replace(
        seconds=seconds, standard_error=standard_error, drift=drift, middle=middle
    )


def _solve_weighted(
    columns: np.ndarray, response: np.ndarray, weights: np.ndarray, prior: np.ndarray
) -> np.ndarray:
    """Return the coefficients [k] of a weighted regression.

    Args:
        columns: design matrix [N, k].
        response: response [N].
        weights: weights [N].
        prior: rows [K, k] that are zero a priori, in units of the residuals.
    """
    root_weights = np.sqrt(weights)
    scales = np.abs(columns).max(axis=0)
    scales[scales == 0.0] = 1.0
    rows = np.vstack((columns * root_weights[:, None], prior))
    right_side = np.append(response * root_weights, np.zeros(len(prior)))
    return np.asarray(np.linalg.lstsq(rows / scales, right_side, rcond=1e-12)[0] / scales)


def _compute_standard_error(
    columns: np.ndarray, residual: np.ndarray, weights: np.ndarray, prior: np.ndarray
) -> float:
    """Return the standard error of the first coefficient of a weighted regression.

    Args:
        columns: design matrix [N, k].
        residual: residuals [N].
        weights: weights [N].
        prior: rows [K, k] that are zero a priori, in units of the residuals.
    """
    scales = np.abs(columns).max(axis=0)
    scales[scales == 0.0] = 1.0
    scaled = columns / scales
    information = scaled.T @ (scaled * weights[:, None])
    bread = np.linalg.pinv(information + (prior / scales).T @ (prior / scales))
    scores = scaled * (weights * residual)[:, None]
    sections = (np.arange(residual.size) * _N_SECTIONS) // residual.size
    section_scores = np.stack([scores[sections == k].sum(axis=0) for k in range(_N_SECTIONS)])
    covariance = bread @ section_scores.T @ section_scores @ bread
    covariance *= _N_SECTIONS / (_N_SECTIONS - 1.0)
    # with few sections the sandwich underestimates the error; lower bound: the standard error for
    # first-order autoregressive residuals
    centred = residual - residual.mean()
    energy = max(float(centred @ centred), 1e-300)
    autocorrelation = min(max(float(centred[1:] @ centred[:-1]) / energy, 0.0), 0.98)
    degrees_of_freedom = max(residual.size - columns.shape[1], 1)
    variance = float((weights * residual**2).sum()) / degrees_of_freedom
    variance *= (1.0 + autocorrelation) / (1.0 - autocorrelation)
    return float(np.sqrt(max(covariance[0, 0], variance * bread[0, 0])) / scales[0])


def _make_nuisance_columns(
    t: np.ndarray,
    overlap: tuple[float, float],
    rate_times: np.ndarray,
    max_interval: float,
) -> tuple[np.ndarray, int]:
    """Make columns [N, k] for the difference between a heading and the integral of a yaw rate.

    Args:
        t: times of the heading [N] in s.
        overlap: start and stop of both recordings in s.
        rate_times: times of the yaw rate in s on the same clock.
        max_interval: longest interval of the yaw rate that is no gap, in s.

    Returns:
        The columns, and the number of knots of the random walk, which are the first ones.
    """
    # the integral of the gyro's noise is a random walk, here piecewise linear; its bias is a trend
    start, stop = overlap
    n_knots = int(np.clip((stop - start) / _KNOT_SECONDS, 2, _MAX_KNOTS))
    knots = np.linspace(start, stop, n_knots)
    walk = np.maximum(1.0 - np.abs(t[:, None] - knots) / (knots[1] - knots[0]), 0.0)
    # the integral over a gap is unknown: one step at each of the longest gaps
    intervals = np.diff(rate_times)
    longest_gaps = np.argsort(intervals)[-_MAX_GAPS:]
    gap_times = rate_times[longest_gaps[intervals[longest_gaps] >= max_interval]]
    trend = t - 0.5 * (start + stop)
    return np.column_stack((walk, trend, (t[:, None] > gap_times).astype(np.float64))), n_knots

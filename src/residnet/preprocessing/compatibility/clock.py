"""Estimate the offset between two clocks from a heading on one and a yaw rate on the other.

The derivative of the heading is cross-correlated with the yaw rate over all offsets. Around the
maximum the heading is regressed on the integral of the yaw rate, with the offset, the drift, and
bias and scale of the gyro as parameters. Nothing is assumed about the vessel.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from residnet.preprocessing.derivatives import fit_local_polynomials

_GRID_STEP = 0.1
"""Step in s of the offsets of the cross-correlation; doubled for long recordings."""
_MAX_GRID_SAMPLES = 200_000
"""Largest number of grid samples of a recording."""
_MIN_OVERLAP = 0.4
"""Smallest overlap, as a share of the shorter recording."""
_HEADING_WINDOW_SECONDS = 1.0
"""Window in s of the local parabolas that differentiate the heading."""
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
        margin: logarithm of the likelihood ratio to the best offset that differs by more than one
            second. Each 2 s of the overlap count as one independent sample of the yaw rate.
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
    coarse_estimate = _correlate_rates(heading_times, heading, rate_times, yaw_rate)
    return coarse_estimate and _refine_offset(
        coarse_estimate, heading_times, heading, rate_times, yaw_rate
    )


def _correlate_rates(
    heading_times: np.ndarray, heading: np.ndarray, rate_times: np.ndarray, yaw_rate: np.ndarray
) -> ClockEstimate | None:
    """Maximise the normalised cross-correlation over all offsets with sufficient overlap."""
    durations = (heading_times[-1] - heading_times[0], rate_times[-1] - rate_times[0])
    step = max(_GRID_STEP, float(np.median(np.diff(heading_times))) / 2.0)
    step = max(step, float(max(durations)) / _MAX_GRID_SAMPLES)
    grids = (
        np.arange(heading_times[0], heading_times[-1], step),
        np.arange(rate_times[0], rate_times[-1], step),
    )
    window = max(5, 2 * round(0.5 * _HEADING_WINDOW_SECONDS / step) + 1)
    if min(grids[0].size, grids[1].size) < 3 * window:
        return None
    resampled_heading = np.interp(grids[0], heading_times, heading)[:, None]
    reference = fit_local_polynomials(resampled_heading, window, 2, step)[1][:, 0]
    signal = np.interp(grids[1], rate_times, yaw_rate)
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
    independent_share = min(step / 2.0, 1.0)
    scores = -0.5 * independent_share * counts * np.log(1.0 - correlation**2) * has_overlap
    best_index = int(np.argmax(scores))
    lags = np.arange(size)
    lags = np.where(lags < reference.size, lags, lags - size)
    is_distant = np.abs(lags - lags[best_index]) * step > _EXCLUDED_SECONDS
    margin = float(scores[best_index] - scores[is_distant].max(initial=0.0))
    seconds = float(grids[0][0] + lags[best_index] * step - grids[1][0])
    return ClockEstimate(seconds, step, 0.0, 0.0, float(correlation[best_index]), margin)


def _refine_offset(
    coarse_estimate: ClockEstimate,
    heading_times: np.ndarray,
    heading: np.ndarray,
    rate_times: np.ndarray,
    yaw_rate: np.ndarray,
) -> ClockEstimate:
    """Refine an offset by regressing the heading on the shifted integral of the yaw rate.

    Args:
        coarse_estimate: result of the cross-correlation.
        heading_times: times of the heading [T] in s.
        heading: heading [T] in rad.
        rate_times: times of the yaw rate [K] in s on the clock of the gyro.
        yaw_rate: yaw rate [K].

    Returns:
        The refined estimate; the coarse one if the regression does not converge near it.
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
    nuisance = _make_nuisance_columns(
        t, (float(start), float(stop)), rate_times + coarse_estimate.seconds, max_interval
    )
    response = heading[in_overlap]
    if t.size < 30:
        return coarse_estimate
    seconds = coarse_estimate.seconds
    has_drift = bool(stop - start > _MIN_DRIFT_SECONDS)
    drift = 0.0
    weights = np.ones(t.size)
    columns = np.zeros((t.size, 0))
    residual = response
    for _ in range(_MAX_ITERATIONS):
        gyro_times = t - seconds - drift * (t - middle)
        rate = np.interp(gyro_times, rate_times, yaw_rate)
        columns = np.column_stack((np.interp(gyro_times, rate_times, integral), nuisance))
        slope = -rate * np.linalg.lstsq(columns, response, rcond=None)[0][0]
        columns = np.column_stack((slope, slope * (t - middle) * has_drift, columns))
        root_weights = np.sqrt(weights)[:, None]
        scales = np.abs(columns).max(axis=0)
        scales[scales == 0.0] = 1.0
        solution = np.linalg.lstsq(
            columns / scales * root_weights, response * root_weights[:, 0], rcond=1e-12
        )[0]
        residual = response - columns / scales @ solution
        solution = solution / scales
        residual_std = max(float(np.median(np.abs(residual))) / 0.6745, 1e-9)
        weights = (_STUDENT_DOF + 1.0) / (_STUDENT_DOF + (residual / residual_std) ** 2)
        seconds += float(np.clip(solution[0], -0.3, 0.3))
        drift += float(np.clip(solution[1], -1e-4, 1e-4)) if has_drift else 0.0
        if abs(solution[0]) < 1e-4:
            break
    if abs(seconds - coarse_estimate.seconds) > 5.0 * max(coarse_estimate.standard_error, 0.2):
        return coarse_estimate
    standard_error = _compute_standard_error(columns, residual, weights)
    return coarse_estimate._replace(
        seconds=seconds, standard_error=standard_error, drift=drift, middle=middle
    )


def _compute_standard_error(
    columns: np.ndarray, residual: np.ndarray, weights: np.ndarray
) -> float:
    """Return the standard error of the first coefficient of a weighted regression.

    Args:
        columns: design matrix [N, k].
        residual: residuals [N].
        weights: weights [N].
    """
    scales = np.abs(columns).max(axis=0)
    scales[scales == 0.0] = 1.0
    scaled = columns / scales
    bread = np.linalg.pinv(scaled.T @ (scaled * weights[:, None]))
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
    t: np.ndarray, overlap: tuple[float, float], rate_times: np.ndarray, max_interval: float
) -> np.ndarray:
    """Return columns [N, k] for the difference between a heading and the integral of a yaw rate.

    Args:
        t: times of the heading [N] in s.
        overlap: start and stop of both recordings in s.
        rate_times: times of the yaw rate in s on the same clock.
        max_interval: longest interval of the yaw rate that is no gap, in s.
    """
    # the integral of the gyro's noise is a random walk: a piecewise linear function absorbs it
    start, stop = overlap
    n_knots = int(np.clip((stop - start) / _KNOT_SECONDS, 2, _MAX_KNOTS))
    knots = np.linspace(start, stop, n_knots)
    walk = np.maximum(1.0 - np.abs(t[:, None] - knots) / (knots[1] - knots[0]), 0.0)
    # the integral over a gap is unknown: one step at each of the longest gaps
    intervals = np.diff(rate_times)
    longest_gaps = np.argsort(intervals)[-_MAX_GAPS:]
    gap_times = rate_times[longest_gaps[intervals[longest_gaps] >= max_interval]]
    return np.column_stack((walk, (t[:, None] > gap_times).astype(np.float64)))

"""Calibration of bands on errors of free runs over unseen logs, and their coverage."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from residnet.core.layout import (
    EXTRA_STATES,
    HEADING,
    PLANAR_LAYOUT,
    POSITION,
    SURGE_SWAY_YAW,
    VELOCITIES,
    DegreesOfFreedom,
)
from residnet.evaluation.band import (
    MAX_LOG_FACTOR,
    Band,
    MotionIntensity,
    band_channels,
    compute_run_weights,
    conformal_level,
    effective_sample_size,
    excess_disagreement,
    interval_score,
    is_covered,
    largest_error_ratios,
    running_mean_squares,
    weighted_quantile,
    width_factors,
)
from residnet.evaluation.protocol import Window

if TYPE_CHECKING:
    from residnet.evaluation.freerun import FreeRunErrors, Prediction
    from residnet.preprocessing.prepare import PreparedLog

_MASKED_CHANNELS = tuple(PLANAR_LAYOUT.band_channels.index(name) for name in ("u", "v", "position"))
"""Channels that are scored only at usable samples, since they depend on the position sensor."""


@dataclass(frozen=True)
class RunErrors:
    """Errors and motion of a free run of L steps.

    Attributes:
        log: name of the log.
        manoeuvre: kind of manoeuvre.
        error: absolute errors [L, c] by channel, NaN for samples that are not scored.
        states: predicted states [L + 1, 3 + n], including the initial state.
        spread: standard deviation between ensemble members [L, c]; None without an ensemble.
        dof: degrees of freedom, which determine the channels.
        distance: running mean of the log distance to the training data [L]; None if unknown.
    """

    log: str
    manoeuvre: str
    error: np.ndarray
    states: np.ndarray
    spread: np.ndarray | None = None
    dof: DegreesOfFreedom = SURGE_SWAY_YAW
    distance: np.ndarray | None = None

    def half_widths(self, band: Band) -> np.ndarray:
        """Return the half widths [L, c] of a band along the run."""
        return band.half_widths(self.states, self.spread, self.distance)

    def __len__(self) -> int:
        return len(self.error)


def compute_run_errors(
    windows: Sequence[Window],
    predictions: Sequence[Prediction],
    logs: Sequence[PreparedLog],
    errors: FreeRunErrors | None = None,
) -> list[RunErrors]:
    """Return the errors of one model's free runs over W windows, without their initial samples.

    Args:
        windows: windows of the free runs.
        predictions: prediction for each window.
        logs: prepared logs of the windows.
        errors: errors of the predictions, if already computed.
    """
    # imported here because it imports PyTorch, which reports of finished runs do not need
    from residnet.evaluation.freerun import FreeRunErrors

    errors = (
        FreeRunErrors.from_predictions(windows, predictions, logs) if errors is None else errors
    )
    channel_errors = band_channels(np.abs(errors.error), np.hypot(*errors.error[:, POSITION].T))
    channel_errors[np.ix_(~errors.is_usable, np.array(_MASKED_CHANNELS))] = np.nan
    dof = errors.dof
    scored_channels = {
        *dof.active_states,
        *["heading"] * dof.has_heading,
        *["position"] * dof.has_position,
    }
    channel_errors[:, [name not in scored_channels for name in dof.layout.band_channels]] = np.nan
    errors_by_window = np.split(channel_errors, errors.window_starts[1:])
    return [
        RunErrors(
            log.log.name,
            log.log.manoeuvre,
            error[1:],
            prediction.states,
            prediction.spread,
            dof,
            prediction.distance,
        )
        for log, error, prediction in zip(
            (logs[window.log_index] for window in windows),
            errors_by_window,
            predictions,
            strict=True,
        )
    ]


@dataclass(frozen=True)
class BandCoverage:
    """Coverage and score of prediction intervals over some windows.

    Attributes:
        share: fraction of the samples inside the interval by channel, the `mean` of the channels,
            and `whole`: the fraction of windows entirely inside the simultaneous interval.
        score: mean interval score in units of the constant-velocity error.
        constant_width_score: mean interval score of an interval of constant width.
    """

    share: dict[str, float]
    score: float
    constant_width_score: float


@dataclass(frozen=True)
class BandCounts:
    """Counts and sums over the scored samples of each of W windows, by channel [W, c].

    Attributes:
        channels: names of the channels.
        n_scored: number of scored samples.
        n_inside: number of samples within the band.
        is_run_inside: 1 if the whole window is within the simultaneous band, NaN if unscored.
        interval_score_sum: sum of the interval scores, in the units of the band.
        constant_score_sum: sum of the interval scores of a band with constant width.
    """

    channels: tuple[str, ...]
    n_scored: np.ndarray
    n_inside: np.ndarray
    is_run_inside: np.ndarray
    interval_score_sum: np.ndarray
    constant_score_sum: np.ndarray

    def summarize(self, window_mask: np.ndarray) -> BandCoverage:
        """Return coverage and scores over selected windows [W] bool."""
        n_scored = self.n_scored[window_mask].sum(axis=0)
        is_scored = n_scored > 0

        def compute_mean(window_sums: np.ndarray) -> np.ndarray:
            return np.asarray(window_sums[window_mask].sum(axis=0)[is_scored] / n_scored[is_scored])

        coverage = compute_mean(self.n_inside)
        names = [name for name, scored in zip(self.channels, is_scored, strict=True) if scored]
        return BandCoverage(
            share={
                **dict(zip(names, map(float, coverage), strict=True)),
                "mean": float(coverage.mean()),
                "whole": float(np.nanmean(self.is_run_inside[window_mask])),
            },
            score=float(compute_mean(self.interval_score_sum).mean()),
            constant_width_score=float(compute_mean(self.constant_score_sum).mean()),
        )


def count_coverage(runs: Sequence[RunErrors], band: Band) -> BandCounts:
    """Return coverage and interval scores of a band over free runs of its model."""
    errors = [run.error for run in runs]
    widths = [run.half_widths(band) for run in runs]
    largest_ratios = largest_error_ratios(errors, widths)

    def scores(half_widths: Sequence[np.ndarray]) -> np.ndarray:
        return np.stack(
            [
                np.nansum(interval_score(error, width, band.level), axis=0) / band.score_unit
                for error, width in zip(errors, half_widths, strict=True)
            ]
        )

    return BandCounts(
        band.channels,
        np.stack([np.isfinite(error).sum(axis=0) for error in errors]),
        np.stack(
            [(error <= width).sum(axis=0) for error, width in zip(errors, widths, strict=True)]
        ),
        np.where(np.isnan(largest_ratios), np.nan, largest_ratios <= band.simultaneous_factor),
        scores(widths),
        scores([np.broadcast_to(band.constant_width, error.shape) for error in errors]),
    )


def band_limits(states: np.ndarray, half_width: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper limits [L + 1, 3 + n] of predicted states.

    The initial state is given and has zero width. The limits of x and y bound the circle of the
    position interval.

    Args:
        states: predicted states [L + 1, 3 + n], including the initial state.
        half_width: half widths [L, c] of the later samples.
    """
    half_widths_of_states = np.zeros_like(states)
    half_widths_of_states[1:, VELOCITIES] = half_width[:, :3]
    half_widths_of_states[1:, HEADING] = half_width[:, 3]
    half_widths_of_states[1:, POSITION] = half_width[:, 4:5]
    half_widths_of_states[1:, EXTRA_STATES] = half_width[:, 5:]
    return states - half_widths_of_states, states + half_widths_of_states


_MAX_HORIZONS = 100
"""Largest number of horizons at which half widths are tabulated."""
_SMOOTHING_SHARE = 0.11
"""Share of the horizon over which widths are smoothed."""
_SLOPE_RIDGE = 0.02
"""Ridge on the slopes, for measures of unit variance."""
_ALTERNATIONS = 2
"""Number of alternating fits of the shape over horizons and of the intensity slopes."""
_SCALE_FOLDS = 5
"""Number of folds of the cross-fitted error scales."""
_HORIZON_STRIDE = 3
"""Stride of the horizons at which slopes are fitted; neighbouring horizons are correlated."""
_NEWTON_STEPS = 8
"""Number of Newton steps; near the solution each doubles the number of correct digits."""


@dataclass(frozen=True)
class _CalibrationRuns:
    """Errors of W runs at G horizons.

    Attributes:
        names: log of each run.
        weights: weight of each run [W].
        steps: horizons in time steps [G].
        errors: errors [W, G, c] by channel; NaN where unscored.
        intensities: standardised intensity measures of the motion [W, G, 2 n].
        intensity: statistics of these measures.
    """

    names: Sequence[str]
    weights: np.ndarray
    steps: np.ndarray
    errors: np.ndarray
    intensities: np.ndarray
    intensity: MotionIntensity

    def select(self, run_mask: np.ndarray) -> _CalibrationRuns:
        """Return the selected runs [W] bool, with their weights normalised."""
        return replace(
            self,
            names=[name for name, selected in zip(self.names, run_mask, strict=True) if selected],
            weights=self.weights[run_mask] / self.weights[run_mask].sum(),
            errors=self.errors[run_mask],
            intensities=self.intensities[run_mask],
        )


def calibrate_band(
    runs: Sequence[RunErrors],
    coverage_level: float,
    step: float,
    score_unit: np.ndarray,
    other_kind_runs: Sequence[RunErrors] = (),
) -> Band:
    """Return the band that covers a share `coverage_level` of the errors of new runs.

    Locally scaled split conformal prediction: errors are divided by a scale that depends on horizon
    and intensity, and the half width is the scale times a quantile of the ratios. The scale is
    cross-fitted over logs, and the level is raised for the effective number of independent scores.

    Args:
        runs: runs of one protocol over logs that the model was not fitted on; at least one.
        coverage_level: nominal coverage.
        step: time step of the runs in s.
        score_unit: unit of the interval scores [c].
        other_kind_runs: runs over logs of a kind of manoeuvre of which the model and its domain
            contain no log; they determine how widths grow with the distance to the training data.
    """
    all_errors = _to_calibration_runs(runs, step)
    names = all_errors.names
    weights = all_errors.weights
    channels = runs[0].dof.layout.band_channels
    unexplained_errors = all_errors
    typical_spread: np.ndarray | None = None
    run_spreads = [run.spread for run in runs if run.spread is not None]
    if len(run_spreads) == len(runs):
        # only if all runs have a spread: otherwise the typical spread would belong to some runs
        # only
        spreads = _sample_at_horizons(run_spreads, unexplained_errors.steps)
        typical_spread = _smoothed_rms(spreads, unexplained_errors)
        # the excess disagreement is added to the variance in `Band.half_widths`, so that its share
        # is removed from the errors here
        disagreement_variance = np.nan_to_num(
            excess_disagreement(spreads, typical_spread, coverage_level, channels)
        )
        unexplained_errors = replace(
            unexplained_errors,
            errors=np.sqrt(np.maximum(unexplained_errors.errors**2 - disagreement_variance, 0.0)),
        )
    rms_shape, slopes = _fit_scale(unexplained_errors)
    cross_fitted_scale = _cross_fitted_scales(unexplained_errors)
    coverage = np.nanmean(
        is_covered(
            unexplained_errors.errors,
            _normalized_quantiles(unexplained_errors, cross_fitted_scale, coverage_level)
            * cross_fitted_scale,
        ),
        axis=(1, 2),
    )
    n_scores = effective_sample_size(coverage, weights, names, coverage_level)
    corrected_level = conformal_level(coverage_level, n_scores)
    quantiles = _normalized_quantiles(unexplained_errors, cross_fitted_scale, corrected_level)
    # channels without a model are not scored (NaN) and get a zero width
    half_width = np.nan_to_num(rms_shape * quantiles)
    unconditional_shape = _rms_shape(all_errors, np.zeros_like(slopes))
    unconditional_width = unconditional_shape * _normalized_quantiles(
        all_errors,
        np.broadcast_to(unconditional_shape, unexplained_errors.errors.shape),
        corrected_level,
    )
    unconditional_width = np.nan_to_num(unconditional_width)
    flat_errors = all_errors.errors.reshape(-1, len(channels))
    band = Band(
        coverage_level,
        step,
        unexplained_errors.steps,
        half_width,
        unconditional_width,
        np.ones(len(channels)),
        np.nan_to_num(
            weighted_quantile(
                flat_errors, np.repeat(weights, unexplained_errors.errors.shape[1]), corrected_level
            )
        ),
        score_unit,
        unexplained_errors.intensity,
        slopes,
        len(set(names)),
        n_scores,
        typical_spread=typical_spread,
        channels=channels,
    )
    band = _fit_distance_effect(band, runs, weights, other_kind_runs)
    largest_ratios = largest_error_ratios(
        [run.error for run in runs], [run.half_widths(band) for run in runs]
    )
    # the ratios above use the in-sample scale; they are corrected to the cross-fitted one, which is
    # what a new run would have
    in_sample_scale = rms_shape * width_factors(unexplained_errors.intensities, slopes)
    largest_ratios *= _largest_error_ratios(
        unexplained_errors.errors, cross_fitted_scale * quantiles
    ) / _largest_error_ratios(unexplained_errors.errors, in_sample_scale * quantiles)
    simultaneous_factor = np.nan_to_num(
        weighted_quantile(largest_ratios, weights, corrected_level), nan=1.0
    )
    return replace(
        band,
        simultaneous_factor=simultaneous_factor,
        cautions=describe_few_logs(band.n_logs, coverage_level),
    )


_DISTANCE_LEVEL = 0.9
"""Share of the samples of the calibration runs at which the distance does not change the width."""
_DISTANCE_SLOPES = np.linspace(0.0, 3.0, 61)
"""Slopes among which the smallest interval score selects."""


def _fit_distance_effect(
    band: Band,
    runs: Sequence[RunErrors],
    weights: np.ndarray,
    other_kind_runs: Sequence[RunErrors],
) -> Band:
    """Return the band with a width that grows with the distance to the training data.

    The slope of each channel is not negative and has the smallest interval score over the runs of
    another kind. A proper score rates wide intervals as well as misses.
    """
    distances = [run.distance for run in runs if run.distance is not None]
    if len(distances) < len(runs):
        return band
    sample_weights = np.repeat(weights, [len(distance) for distance in distances])
    pooled = np.concatenate(distances)
    threshold = float(weighted_quantile(pooled[:, None], sample_weights, _DISTANCE_LEVEL)[0])
    largest_distance = max(float(distance[-1]) for distance in distances)
    band = replace(band, distance_threshold=threshold, largest_distance=largest_distance)
    other_distances = [run.distance for run in other_kind_runs if run.distance is not None]
    if not other_kind_runs or len(other_distances) < len(other_kind_runs):
        return band
    excess = np.maximum(np.concatenate(other_distances) - threshold, 0.0)
    errors = np.concatenate([run.error for run in other_kind_runs])
    half_widths = np.concatenate([run.half_widths(band) for run in other_kind_runs])
    run_weights = compute_run_weights([run.log for run in other_kind_runs])
    other_weights = np.repeat(run_weights, [len(run) for run in other_kind_runs])
    slope = np.zeros(len(band.channels))
    for channel in range(len(slope)):
        is_counted = np.isfinite(errors[:, channel]) & (excess > 0.0)
        factors = np.exp(np.minimum(np.outer(_DISTANCE_SLOPES, excess[is_counted]), MAX_LOG_FACTOR))
        scores = interval_score(
            errors[is_counted, channel], half_widths[is_counted, channel] * factors, band.level
        )
        slope[channel] = _DISTANCE_SLOPES[int((scores @ other_weights[is_counted]).argmin())]
    return replace(band, distance_slope=slope)


def _sample_at_horizons(series: Sequence[np.ndarray], steps: np.ndarray) -> np.ndarray:
    """Return the values [W, G, c] of series [L, c] at given steps; NaN beyond the end of a run."""
    values = np.full((len(series), len(steps), series[0].shape[1]), np.nan)
    for values_of_run, run_series in zip(values, series, strict=True):
        reached_samples = steps[steps <= len(run_series)] - 1
        values_of_run[: len(reached_samples)] = run_series[reached_samples]
    return values


def _smoothed_rms(values: np.ndarray, runs: _CalibrationRuns) -> np.ndarray:
    """Return the root mean square [G, c] of values [W, G, c] over runs, smoothed over horizons."""
    sample_weights = np.where(np.isfinite(values), runs.weights[:, None, None], 0.0)
    total_weights = sample_weights.sum(axis=0)
    mean_squares = np.where(
        total_weights > 0, (sample_weights * np.nan_to_num(values) ** 2).sum(axis=0), np.nan
    )
    return np.asarray(
        np.sqrt(
            _smooth_over_horizons(
                mean_squares / np.where(total_weights > 0, total_weights, 1.0), runs.steps
            )
        )
    )


def _largest_error_ratios(error: np.ndarray, half_width: np.ndarray) -> np.ndarray:
    """Return the largest ratio of error to half width over the horizons of each run [W, c]."""
    ratios = np.where(
        np.isfinite(error) & (half_width > 0.0), error / np.maximum(half_width, 1e-300), 0.0
    )
    return np.asarray(np.maximum(ratios.max(axis=1), 1e-12))


def _fit_scale(runs: _CalibrationRuns) -> tuple[np.ndarray, np.ndarray]:
    """Return the shape over horizons [G, c] and the intensity slopes [2 n, c] of the errors."""
    slopes = np.zeros((runs.intensities.shape[2], runs.errors.shape[2]))
    for _ in range(_ALTERNATIONS):
        slopes = _fit_slopes(runs, _rms_shape(runs, slopes), slopes)
    return _rms_shape(runs, slopes), slopes


def _cross_fitted_scales(runs: _CalibrationRuns) -> np.ndarray:
    """Return cross-fitted error scales [W, G, c], each estimated from the runs of other logs.

    A scale estimated from the run itself would understate the errors of new runs.
    """
    _, log_indices = np.unique(runs.names, return_inverse=True)
    # whole logs are assigned to folds, since runs of one log are correlated
    fold_indices = log_indices % _SCALE_FOLDS
    scales = np.empty_like(runs.errors)
    for k in np.unique(fold_indices):
        in_fold = fold_indices == k
        other_runs = runs.select(~in_fold) if (~in_fold).any() else runs
        rms_shape, slopes = _fit_scale(other_runs)
        scales[in_fold] = rms_shape * width_factors(runs.intensities[in_fold], slopes)
    return scales


def describe_few_logs(n_logs: int, coverage_level: float) -> tuple[str, ...]:
    """Return a caution if there are too few logs for a guaranteed coverage; else nothing.

    The largest of n exchangeable scores covers a new one with probability n / (n + 1).
    """
    min_logs = math.ceil(coverage_level / (1.0 - coverage_level) - 1e-9)
    if n_logs >= min_logs:
        return ()
    subject = f"{n_logs} logs calibrate" if n_logs > 1 else "One log calibrates"
    return (
        f"{subject} this band; with fewer than {min_logs}, {100.0 * coverage_level:.3g} % coverage"
        " cannot be"
        " guaranteed for every distribution of errors.",
    )


def _to_calibration_runs(runs: Sequence[RunErrors], step: float) -> _CalibrationRuns:
    """Return errors and intensity measures of runs at the horizons of the band's tables."""
    longest_run = max(map(len, runs))
    steps = np.unique(
        np.linspace(1, longest_run, min(_MAX_HORIZONS, longest_run)).round().astype(int)
    )
    names = [run.log for run in runs]
    weights = compute_run_weights(names)
    mean_squares_of_runs = [running_mean_squares(run.states, step) for run in runs]
    intensity = MotionIntensity.from_runs(mean_squares_of_runs, weights)
    errors = _sample_at_horizons([run.error for run in runs], steps)
    intensities = _sample_at_horizons(mean_squares_of_runs, steps)
    intensities = np.nan_to_num(intensity.standardize(intensities))
    return _CalibrationRuns(names, weights, steps, errors, intensities, intensity)


def _rms_shape(runs: _CalibrationRuns, slopes: np.ndarray) -> np.ndarray:
    """Return the root mean square [G, c] of errors divided by their intensity factor, smoothed."""
    rms = _smoothed_rms(runs.errors / width_factors(runs.intensities, slopes), runs)
    return np.asarray(np.maximum(rms, 1e-12 + 1e-6 * np.nan_to_num(rms).max(axis=0)))


def _normalized_quantiles(runs: _CalibrationRuns, scale: np.ndarray, level: float) -> np.ndarray:
    """Return the quantile [G, c] of errors over a scale [W, G, c], smoothed over horizons."""
    return _smooth_over_horizons(
        weighted_quantile(runs.errors / scale, runs.weights, level), runs.steps
    )


def _smooth_over_horizons(values: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return moving means [G, c] over neighbouring horizons; gaps take the values of neighbours."""
    half_window = 0.5 * _SMOOTHING_SHARE * steps[-1]
    # near the start the window shrinks to stay symmetric, since errors grow quickly there
    half_windows = np.minimum(half_window, steps - 1 + 0.5)
    is_neighbour = np.abs(steps[:, None] - steps[None, :]) <= half_windows[:, None]
    is_finite = np.isfinite(values)
    n_neighbours = is_neighbour @ is_finite.astype(float)
    smoothed = (is_neighbour @ np.where(is_finite, values, 0.0)) / np.maximum(n_neighbours, 1.0)
    for column, has_neighbours in zip(smoothed.T, (n_neighbours > 0).T, strict=True):
        column[:] = (
            np.interp(steps, steps[has_neighbours], column[has_neighbours])
            if has_neighbours.any()
            else np.nan
        )
    return np.asarray(smoothed)


def _fit_slopes(
    runs: _CalibrationRuns, rms_shape: np.ndarray, initial_slopes: np.ndarray
) -> np.ndarray:
    """Return the slopes [2 n, c] of the logarithm of the errors by the intensity measures.

    Gamma regression with a logarithmic link of the errors divided by their shape, by Newton's
    method.
    """
    slopes = initial_slopes.copy()
    horizon_stride = slice(None, None, _HORIZON_STRIDE)
    errors = runs.errors[:, horizon_stride]
    intensities = runs.intensities[:, horizon_stride]
    rms_shape = rms_shape[horizon_stride]
    run_weights = runs.weights[:, None] / errors.shape[1]
    ridge = _SLOPE_RIDGE * np.eye(intensities.shape[2])
    flat_intensities = intensities.reshape(-1, intensities.shape[2])
    for channel in range(errors.shape[2]):
        normalized_errors = errors[:, :, channel] / rms_shape[:, channel]
        is_scored = np.isfinite(normalized_errors)
        y = np.where(is_scored, normalized_errors, 0.0)
        sample_weights = np.where(is_scored, run_weights, 0.0)
        if not is_scored.any():
            continue
        coefficients = slopes[:, channel].copy()
        for _ in range(_NEWTON_STEPS):
            predicted = np.exp(np.clip(intensities @ coefficients, -20.0, 20.0))
            # the mean is profiled out: the level of the errors is in the shape, not in the slopes
            predicted *= (sample_weights * y).sum() / max(
                (sample_weights * predicted).sum(), 1e-300
            )
            weighted_ratio = sample_weights * y / np.maximum(predicted, 1e-300)
            gradient = (
                flat_intensities.T @ (weighted_ratio - sample_weights).ravel()
                - ridge @ coefficients
            )
            hessian = (
                flat_intensities.T @ (weighted_ratio.reshape(-1, 1) * flat_intensities) + ridge
            )
            # limited steps, since the likelihood is flat far from its maximum
            coefficients = coefficients + np.clip(np.linalg.solve(hessian, gradient), -1.0, 1.0)
        slopes[:, channel] = coefficients
    return slopes

"""Goodness of fit of one-step predictions (Halvorsen 2019, appendix E); repeatability of logs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import scipy

from residnet.core.frames import wrap_angle_array
from residnet.core.layout import HEADING, POSE, POSITION
from residnet.core.names import ACCELERATION_NAMES
from residnet.evaluation.intervals import CONFIDENCE_LEVEL, bootstrap_tail_probability
from residnet.evaluation.limits_records import Repeatability, RepeatDifferences, RepeatTolerance
from residnet.evaluation.protocol import ProtocolConfig, Window
from residnet.evaluation.records import (
    GoodnessFile,
    GoodnessRow,
    Interval,
    MaeDifference,
    ModelKind,
)
from residnet.preprocessing.prepare import PreparedLog

_COMMAND_TOLERANCE = 0.05
"""Largest difference of the commands of repeated runs, relative to their range.

Smaller tolerances, or a coarser search, find few pairs.
"""
_START_TOLERANCE = 0.25
"""Largest difference of the initial velocities of repeated runs, in scales."""
_SEARCH_INTERVAL = 0.5
"""Interval in s of the starts that are tried."""


@dataclass(frozen=True)
class RepeatedPair:
    """A window and the segment of another log that repeats it.

    Attributes:
        window: the window.
        repeat_log: index of the log of the segment.
        repeat_start: first sample of the segment.
        mismatch: difference of the commands as a fraction of their range.
    """

    window: Window
    repeat_log: int
    repeat_start: int
    mismatch: float


def assess_repeatability(
    protocol: ProtocolConfig,
    logs: Sequence[PreparedLog],
    n_commands: int,
    scales: Mapping[str, float],
    dt: float,
) -> Repeatability:
    """Return the part of limits.json about repeated manoeuvres.

    Every window of the protocol is compared with every segment of equal length in later logs, and
    later in its own log, at starts every 0.5 s. A segment repeats a window if the root mean square
    difference of every command is below 5 % of the command's range over all logs, and each initial
    velocity differs by less than a quarter of its scale. The best segment of a log counts.

    Args:
        logs: logs on one time grid.
        n_commands: number of input columns that are commands.
        dt: time step in s.

    Returns:
        Tolerances and, with pairs, their mean differences. Two independent runs differ by sqrt(2)
        times their standard deviation.
    """
    dynamic_states = logs[0].dof.dynamic_states
    state_scales = np.array([scales.get(name, 1.0) for name in dynamic_states])
    scored_columns = [dynamic_states.index(name) for name in scales]
    pairs = list(find_pairs(protocol, logs, n_commands, state_scales, dt))
    tolerance = RepeatTolerance(
        command_share_of_range=_COMMAND_TOLERANCE,
        start={name: _START_TOLERANCE * float(scales[name]) for name in scales},
    )
    paired_logs = {pair.window.log_index for pair in pairs} | {pair.repeat_log for pair in pairs}
    if not pairs:
        return Repeatability(tolerance=tolerance, pairs=0, logs=0)
    differences = np.array([_pair_differences(pair, logs) for pair in pairs])
    manoeuvre_kinds = np.array([logs[pair.window.log_index].log.manoeuvre for pair in pairs])
    by_manoeuvre = {
        str(manoeuvre_kind): RepeatDifferences.model_validate(
            _mean_differences(
                differences[manoeuvre_kinds == manoeuvre_kind],
                dynamic_states,
                state_scales,
                scored_columns,
            )
        )
        for manoeuvre_kind in np.unique(manoeuvre_kinds)
    }
    return Repeatability.model_validate(
        {
            **_mean_differences(differences, dynamic_states, state_scales, scored_columns),
            "tolerance": tolerance,
            "logs": len(paired_logs),
            "manoeuvres": by_manoeuvre,
        }
    )


def find_pairs(
    protocol: ProtocolConfig,
    logs: Sequence[PreparedLog],
    n_commands: int,
    state_scales: np.ndarray,
    dt: float,
) -> Iterator[RepeatedPair]:
    """Yield pairs of repeated runs.

    Each window of the protocol is paired with at most one segment of its own log and of each later
    log. Without commands there are no pairs.

    Args:
        protocol: protocol of the windows.
        logs: logs on one time grid.
        n_commands: number of input columns that are commands.
        state_scales: scales of the dynamic states [n].
        dt: time step in s.
    """
    if n_commands == 0:
        return
    search_stride = max(round(_SEARCH_INTERVAL / dt), 1)
    recorded_commands = [log.regression_inputs[log.segment >= 0, :n_commands] for log in logs]
    command_ranges = np.concatenate(recorded_commands).max(0) - np.concatenate(
        recorded_commands
    ).min(0)
    # constant commands: any difference then counts relative to one unit
    command_ranges[command_ranges == 0] = 1.0
    # at the stride of the search, since the comparison of all starts is expensive
    coarse_commands = [
        np.nan_to_num(log.regression_inputs[::search_stride, :n_commands]) / command_ranges
        for log in logs
    ]
    for log_index, log in enumerate(logs):
        for window in protocol.make_windows(log, log_index, dt):
            length = window.stop - window.start
            window_commands = (
                np.nan_to_num(
                    log.regression_inputs[window.start : window.stop : search_stride, :n_commands]
                )
                / command_ranges
            )
            for other_index in range(log_index, len(logs)):
                starts = np.arange(0, len(logs[other_index]) - length + 1, search_stride)
                if len(starts) == 0:
                    continue
                command_mismatch = compute_command_mismatch(
                    window_commands, coarse_commands[other_index]
                )[: len(starts)]
                other_log = logs[other_index]
                start_differences = np.abs(
                    other_log.smoothed[starts, other_log.dof.dynamic_columns]
                    - window.initial_velocities
                )
                is_repeat = (
                    (command_mismatch < _COMMAND_TOLERANCE)
                    # a usable segment without gaps and with similar initial velocities
                    & (other_log.segment[starts] >= 0)
                    & (other_log.segment[starts] == other_log.segment[starts + length - 1])
                    & other_log.usable[starts]
                    & (start_differences < _START_TOLERANCE * state_scales).all(1)
                )
                if other_index == log_index:
                    # a segment of the same log must not overlap the window
                    is_repeat &= starts >= window.stop
                if is_repeat.any():
                    best_start = int(np.argmin(np.where(is_repeat, command_mismatch, np.inf)))
                    yield RepeatedPair(
                        window,
                        other_index,
                        int(starts[best_start]),
                        float(command_mismatch[best_start]),
                    )


def compute_command_mismatch(reference_commands: np.ndarray, series: np.ndarray) -> np.ndarray:
    """Return the difference of commands [L, m] to every segment of a series [T, m], [T - L + 1].

    It is the root mean square difference of the worst column. The square is expanded, so that the
    mixed term is a correlation, which is computed by FFT for all starts at once.
    """
    if len(series) < len(reference_commands):
        return np.zeros(0)
    length = len(reference_commands)
    column_mismatches = []
    column_means = series.mean(0)
    for reference_column, series_column in zip(
        (reference_commands - column_means).T, (series - column_means).T, strict=True
    ):
        cumulative_energy = np.concatenate(([0.0], np.cumsum(series_column**2)))
        squared_differences = (
            cumulative_energy[length:]
            - cumulative_energy[:-length]
            - 2 * scipy.signal.correlate(series_column, reference_column, mode="valid")
            + np.sum(reference_column**2)
        )
        column_mismatches.append(np.sqrt(np.maximum(squared_differences, 0.0) / length))
    return np.asarray(np.max(column_mismatches, axis=0))


def _pair_differences(pair: RepeatedPair, logs: Sequence[PreparedLog]) -> list[float]:
    """Return the differences of two runs, [n + 2].

    They are root mean square differences of the velocities, of u and v over the samples that are
    usable in both, and the differences of position and heading at the end.
    """
    reference_log = logs[pair.window.log_index]
    repeat_log = logs[pair.repeat_log]
    reference_slice = slice(pair.window.start, pair.window.stop)
    repeat_slice = slice(
        pair.repeat_start, pair.repeat_start + reference_slice.stop - reference_slice.start
    )
    velocity_columns = reference_log.dof.dynamic_columns
    velocity_differences = (
        reference_log.y[reference_slice, velocity_columns]
        - repeat_log.y[repeat_slice, velocity_columns]
    )
    is_usable = reference_log.usable[reference_slice] & repeat_log.usable[repeat_slice]
    reference_end = _final_relative_pose(reference_log.y[reference_slice])
    repeat_end = _final_relative_pose(repeat_log.y[repeat_slice])
    difference_columns = (*velocity_differences[is_usable, :2].T, *velocity_differences[:, 2:].T)
    rms = [
        float(np.sqrt(np.mean(difference_column**2))) for difference_column in difference_columns
    ]
    end_difference = reference_end - repeat_end
    return [
        *rms,
        float(np.hypot(*end_difference[POSITION])),
        float(abs(wrap_angle_array(end_difference[HEADING]))),
    ]


def _final_relative_pose(y: np.ndarray) -> np.ndarray:
    """Return the final pose [3] of a run [T, 3 + n] in the axes of its start."""
    north, east, heading_change = y[-1, POSE] - y[0, POSE]
    cos_heading = np.cos(y[0, HEADING])
    sin_heading = np.sin(y[0, HEADING])
    return np.array(
        [
            cos_heading * north + sin_heading * east,
            cos_heading * east - sin_heading * north,
            heading_change,
        ]
    )


def _mean_differences(
    differences: np.ndarray,
    dynamic_states: Sequence[str],
    state_scales: np.ndarray,
    scored_columns: list[int],
) -> dict[str, float]:
    """Return the fields of `RepeatDifferences` from the differences [P, n + 2] of pairs."""
    means = dict(
        zip((*dynamic_states, "position", "heading"), differences.mean(0).tolist(), strict=True)
    )
    normalized_differences = (differences[:, : len(dynamic_states)].mean(0) / state_scales)[
        scored_columns
    ]
    return means | {"pairs": len(differences), "nrmse": float(normalized_differences.mean())}


_N_BLOCK_RESAMPLES = 2_000
"""Number of bootstrap resamples; the 2.5 % tail then contains fifty."""
_NORMAL_APPROXIMATION_BLOCKS = 500
"""Number of blocks from which the normal approximation replaces the bootstrap."""
_MAX_INFLATION = 1.5
"""Largest widening of an interval; for few blocks the estimated factor is itself uncertain."""
_CORRELATION_THRESHOLD = 2.0
"""Threshold of insignificant correlations in standard deviations (Politis and White 2004, section
3.2: c = 2 for log base 10).
"""

Segments = Sequence[np.ndarray]


@dataclass(frozen=True)
class SerialDependence:
    """Serial dependence of a series.

    Attributes:
        block_length: length of blocks for a bootstrap of its mean, in samples.
        variance: long-run variance, n times the variance of the mean.
        effective_size: number of independent samples with the same variance of the mean, at most n.
    """

    block_length: int
    variance: float
    effective_size: float


@dataclass(frozen=True)
class BlockBootstrapInterval:
    """A mean with its 95 % interval.

    Attributes:
        mean: mean.
        lower: lower limit.
        upper: upper limit.
        block_length: length of the blocks in samples.
        n_blocks: number of blocks.
    """

    mean: float
    lower: float
    upper: float
    block_length: int
    n_blocks: float


def compute_autocovariance(segments: Segments, max_lag: int) -> np.ndarray:
    """Return autocovariances at lags 0 .. `max_lag` about the common mean of all segments.

    Products are within segments only; their sum is divided by the number n of all samples, which
    keeps the sequence positive semidefinite.
    """
    pooled = np.concatenate(list(segments))
    mean = pooled.mean()
    covariances = np.zeros(max_lag + 1)
    for segment in segments:
        centred = segment - mean
        # zero padding to twice the length avoids circular correlation
        spectrum = np.abs(np.fft.rfft(centred, 2 * len(centred))) ** 2
        n_lags = min(max_lag + 1, len(centred))
        covariances[:n_lags] += np.fft.irfft(spectrum, 2 * len(centred))[:n_lags]
    return covariances / len(pooled)


def estimate_serial_dependence(segments: Segments) -> SerialDependence:
    """Return block length and long-run variance chosen from the data, for fixed blocks.

    Politis and White 2004, Econometric Reviews 23, 53-70; corrected by Patton, Politis and White
    2009, 28, 372-375.

    Let m be the last lag with a significant correlation. A flat-top window of the autocovariances
    R(k) extends to the lag 2 m. With the windowed sums g = sum R(k) and G = sum |k| R(k), the block
    length is (3 G^2 / (2 g^2) n)^(1/3), at most min(3 sqrt(n), n / 3).
    """
    n = sum(len(segment) for segment in segments)
    n_insignificant_lags = max(5, math.ceil(math.sqrt(math.log10(n)))) if n > 1 else 5
    max_lag = math.ceil(math.sqrt(n)) + n_insignificant_lags
    covariance = compute_autocovariance(segments, max_lag + n_insignificant_lags)
    if covariance[0] <= 1e-300:
        return SerialDependence(1, 0.0, float(n))
    is_noise = np.abs(covariance[1:] / covariance[0]) < _CORRELATION_THRESHOLD * math.sqrt(
        math.log10(n) / n
    )
    insignificant_starts = np.flatnonzero(
        np.lib.stride_tricks.sliding_window_view(is_noise, n_insignificant_lags).all(axis=1)
    )
    significant_lags = np.flatnonzero(~is_noise)
    last_significant_lag = (
        int(insignificant_starts[0]) if insignificant_starts.size else int(significant_lags[-1]) + 1
    )
    bandwidth = min(2 * max(last_significant_lag, 1), max_lag)
    lag = np.arange(1, bandwidth + 1)
    windowed_covariance = (
        np.minimum(1.0, 2.0 * (1.0 - lag / bandwidth)) * covariance[1 : bandwidth + 1]
    )
    # the flat-top window does not guarantee a positive sum
    variance = max(
        float(covariance[0] + 2 * windowed_covariance.sum()), 0.05 * float(covariance[0])
    )
    weighted_lag_sum = 2 * float((lag * windowed_covariance).sum())
    max_block_length = max(min(3 * math.sqrt(n), n / 3), 1.0)
    block_length = math.ceil(
        min(max((1.5 * weighted_lag_sum**2 / variance**2 * n) ** (1 / 3), 1.0), max_block_length)
    )
    return SerialDependence(
        block_length, variance, min(n * float(covariance[0]) / variance, float(n))
    )


def block_bootstrap_interval(segments: Segments) -> BlockBootstrapInterval:
    """Return the mean of all samples with its 95 % interval by a moving-block bootstrap.

    `estimate_serial_dependence` gives the block length. Percentiles about the mean are widened by
    Student's t for few blocks (see `residnet.evaluation.intervals`) and by the ratio of the
    long-run standard error to the bootstrap standard error, between 1 and 1.5. The interval is
    valid for further data of the same kind, not for other manoeuvres.
    """
    dependence = estimate_serial_dependence(segments)
    n = sum(len(segment) for segment in segments)
    mean = float(np.concatenate(list(segments)).mean())
    sums, lengths = _block_sums(segments, dependence.block_length)
    n_blocks = n / float(lengths.mean())
    if dependence.variance == 0 and n >= 2:
        return BlockBootstrapInterval(mean, mean, mean, dependence.block_length, n_blocks)
    if n_blocks < 2:
        return BlockBootstrapInterval(mean, -math.inf, math.inf, dependence.block_length, n_blocks)
    tail_probability = bootstrap_tail_probability(max(math.floor(n_blocks), 2))
    n_drawn = math.ceil(n_blocks)
    if n_blocks > _NORMAL_APPROXIMATION_BLOCKS:
        # delta method for a ratio of sums
        standard_error = float(
            np.std(sums - lengths * (sums.sum() / lengths.sum())) / lengths.mean()
        ) / math.sqrt(n_blocks)
        lower = standard_error * float(scipy.stats.norm.ppf(tail_probability))
        upper = -lower
    else:
        block_indices = np.random.default_rng(0).integers(
            0, len(sums), size=(_N_BLOCK_RESAMPLES, n_drawn)
        )
        resampled_means = sums[block_indices].sum(axis=1) / lengths[block_indices].sum(axis=1)
        deviations = resampled_means - resampled_means.mean()
        standard_error = float(deviations.std())
        lower, upper = np.quantile(deviations, [tail_probability, 1 - tail_probability])
    inflation = (
        min(max(math.sqrt(dependence.variance / n) / standard_error, 1.0), _MAX_INFLATION)
        if standard_error > 0
        else 1.0
    )
    return BlockBootstrapInterval(
        mean,
        mean + inflation * float(lower),
        mean + inflation * float(upper),
        dependence.block_length,
        n_blocks,
    )


def _block_sums(segments: Segments, max_block_length: int) -> tuple[np.ndarray, np.ndarray]:
    """Return sums and lengths of all blocks of `max_block_length` samples.

    A segment that is shorter than a block is a block.
    """
    sums = []
    lengths = []
    for segment in segments:
        block_length = min(max_block_length, len(segment))
        cumulative_sum = np.concatenate(([0.0], np.cumsum(segment)))
        sums.append(cumulative_sum[block_length:] - cumulative_sum[:-block_length])
        lengths.append(np.full(len(sums[-1]), float(block_length)))
    return np.concatenate(sums), np.concatenate(lengths)


def independent_confidence_interval(values: np.ndarray) -> tuple[float, float]:
    """Return the 95 % interval of the mean as Halvorsen 2019, Listing 9.1 prints it.

    Student's t times the standard error of independent samples.

    The resampling of the listing only moves the centre of the interval at random; here the centre
    is the mean. For correlated values the interval is far too narrow (see E8 in
    docs/documents/corrections.md).
    """
    n = len(values)
    half_width = (
        float(scipy.stats.t.ppf(0.5 + CONFIDENCE_LEVEL / 2, n - 1) * values.std(ddof=1))
        / math.sqrt(n)
        if n > 1
        else math.inf
    )
    return float(values.mean()) - half_width, float(values.mean()) + half_width


def ljung_box_test(segments: Segments, n_lags: int) -> tuple[float, float]:
    """Return the statistic of Ljung and Box (1978) and its p-value under white noise.

    The statistic is n (n + 2) sum rho_k^2 / (n - k) over lags 1 .. `lags`.
    """
    n = sum(len(segment) for segment in segments)
    covariance = compute_autocovariance(segments, n_lags)
    if covariance[0] <= 1e-300:
        return 0.0, 1.0
    correlation = covariance[1:] / covariance[0]
    statistic = float(n * (n + 2) * (correlation**2 / (n - np.arange(1, n_lags + 1))).sum())
    return statistic, float(scipy.stats.chi2.sf(statistic, n_lags))


SCHEMA: Final = "residnet.goodness/1"
N_LAGS = 20
"""Lags of the whiteness test."""


@dataclass(frozen=True)
class OneStepResiduals:
    """One-step residuals of the accelerations along measured states, by segment.

    Attributes:
        model_name: name of the model.
        model_kind: constant_velocity, baseline, head or ensemble.
        n_parameters: number of fitted parameters of each axis.
        residuals: measured minus predicted acceleration, [T, n] for each segment.
        reference_name: name of the reference model; None for none.
    """

    model_name: str
    model_kind: ModelKind
    n_parameters: Sequence[float]
    residuals: Sequence[np.ndarray]
    reference_name: str | None = None


class FitMeasures(NamedTuple):
    """Measures of a regression; equations (9.11) to (9.16) of Halvorsen 2019.

    Attributes:
        rmse: root mean square residual.
        r2: coefficient of determination.
        r2_adjusted: coefficient of determination, adjusted for the number of parameters.
        cp: Mallows' C_p.
        aic: Akaike's criterion.
        bic: Bayesian criterion.
    """

    rmse: float
    r2: float | None
    r2_adjusted: float | None
    cp: float
    aic: float | None
    bic: float | None


def goodness_of_fit_measures(
    residuals: np.ndarray, measured: np.ndarray, n_parameters: float, noise_variance: float
) -> FitMeasures:
    """Return RMSE (9.11), R^2 (9.15), adjusted R^2 (9.16), C_p (9.12), AIC (9.13), BIC (9.14).

    Equations of Halvorsen 2019, with sums of squares in place of means.

    Args:
        residuals: measured minus predicted, [m].
        measured: measured values, [m].
        noise_variance: sigma^2 by `estimate_noise_variance` of the richest compared model. With the
            noise variance of each model itself the criteria do not discriminate.

    Returns:
        The measures; None if the target is constant, the noise is zero, or m does not exceed
        d + 1.
    """
    n_samples = len(residuals)
    rss = float(residuals @ residuals)
    total_sum_of_squares = float(((measured - measured.mean()) ** 2).sum())
    r2 = 1 - rss / total_sum_of_squares if total_sum_of_squares > 0 else None
    has_noise = noise_variance > 0
    return FitMeasures(
        rmse=math.sqrt(rss / n_samples),
        r2=r2,
        r2_adjusted=(
            1 - (1 - r2) * (n_samples - 1) / (n_samples - n_parameters - 1)
            if r2 is not None and n_samples > n_parameters + 1
            else None
        ),
        cp=(rss + 2 * n_parameters * noise_variance) / n_samples,
        aic=(rss + 2 * n_parameters * noise_variance) / (n_samples * noise_variance)
        if has_noise
        else None,
        bic=(rss + math.log(n_samples) * n_parameters * noise_variance)
        / (n_samples * noise_variance)
        if has_noise
        else None,
    )


def estimate_noise_variance(residuals: np.ndarray, n_parameters: float) -> float:
    """Return the noise variance sigma^2 = RSS / (m - d - 1) of m residuals and d parameters.

    Halvorsen 2019, eq. (9.17), prints the mean square for the sum of squares RSS. Infinite if m
    does not exceed d + 1.
    """
    degrees_of_freedom = len(residuals) - n_parameters - 1
    return float(residuals @ residuals) / degrees_of_freedom if degrees_of_freedom > 0 else math.inf


def build_goodness_table(
    models: Sequence[OneStepResiduals],
    targets: Sequence[np.ndarray],
    dt: float,
    axes: Iterable[tuple[int, str]] = tuple(enumerate(ACCELERATION_NAMES)),
) -> list[GoodnessRow]:
    """Return a row for each model and axis.

    Args:
        models: one-step residuals over the same segments.
        targets: measured accelerations, [T, n] of each segment.
        dt: time step, s.
        axes: index and name of each evaluated acceleration.
    """
    models_by_name = {model.model_name: model for model in models}
    rows = []
    for axis, name in axes:
        pooled_target = np.concatenate([segment[:, axis] for segment in targets])
        residuals_by_model = {
            model.model_name: [segment[:, axis] for segment in model.residuals] for model in models
        }
        pooled_residuals = {
            model_name: np.concatenate(segments)
            for model_name, segments in residuals_by_model.items()
        }
        # the model with the smallest estimate serves as the full model of C_p, AIC and BIC
        variance = min(
            estimate_noise_variance(pooled_residuals[model.model_name], model.n_parameters[axis])
            for model in models
        )
        for model in models:
            measures = goodness_of_fit_measures(
                pooled_residuals[model.model_name],
                pooled_target,
                model.n_parameters[axis],
                variance if math.isfinite(variance) else 0.0,
            )
            segments = residuals_by_model[model.model_name]
            row = _build_row(model, axis, name, segments, measures, dt)
            if model.reference_name in models_by_name:
                difference = paired_mae_difference(
                    segments,
                    residuals_by_model[str(model.reference_name)],
                    str(model.reference_name),
                )
                row = row.model_copy(update={"difference": difference})
            rows.append(row)
    return rows


def _build_row(
    model: OneStepResiduals,
    axis: int,
    name: str,
    segments: Sequence[np.ndarray],
    measures: FitMeasures,
    dt: float,
) -> GoodnessRow:
    """Return the row of a model and axis, without the difference to its reference.

    Args:
        model: the model.
        axis: number of the acceleration.
        name: name of the acceleration.
        segments: residuals of the acceleration, [T] for each segment.
        measures: measures of the fit.
        dt: time between samples, s.
    """
    absolute_residuals = [np.abs(segment) for segment in segments]
    mae_interval = block_bootstrap_interval(absolute_residuals)
    n_lags = min(N_LAGS, max(sum(map(len, segments)) // 5, 1))
    covariance = compute_autocovariance(segments, n_lags)
    statistic, p_value = ljung_box_test(segments, n_lags)
    mean_interval = block_bootstrap_interval(segments)
    return GoodnessRow(
        model=model.model_name,
        kind=model.model_kind,
        axis=name,
        samples=sum(map(len, segments)),
        parameters=float(model.n_parameters[axis]),
        rmse=measures.rmse,
        r2=measures.r2,
        r2_adjusted=measures.r2_adjusted,
        cp=measures.cp,
        aic=measures.aic,
        bic=measures.bic,
        mae=mae_interval.mean,
        mae_ci95=_finite_bounds(mae_interval.lower, mae_interval.upper),
        mae_ci95_independent=_finite_bounds(
            *independent_confidence_interval(np.concatenate(absolute_residuals))
        ),
        block_seconds=mae_interval.block_length * dt,
        mean=mean_interval.mean,
        mean_ci95=_finite_bounds(mean_interval.lower, mean_interval.upper),
        effective=estimate_serial_dependence(segments).effective_size,
        autocorrelation=(
            tuple((covariance[1:] / covariance[0]).tolist())
            if covariance[0] > 0
            else (0.0,) * n_lags
        ),
        ljung_box=statistic,
        white_p=p_value,
    )


def paired_mae_difference(
    residuals: Sequence[np.ndarray], reference_residuals: Sequence[np.ndarray], reference_name: str
) -> MaeDifference:
    """Return the paired difference of two models' mean absolute residuals, with its interval.

    It is negative if the model is better than the reference.

    Args:
        residuals: residuals of the model by segment.
        reference_residuals: residuals of the reference at the same samples.
        reference_name: name of the reference.
    """
    interval = block_bootstrap_interval(
        [
            np.abs(residual) - np.abs(reference_residual)
            for residual, reference_residual in zip(residuals, reference_residuals, strict=True)
        ]
    )
    reference_mae = float(np.abs(np.concatenate(list(reference_residuals))).mean())
    bounds = _finite_bounds(interval.lower, interval.upper)
    return MaeDifference(
        to=reference_name,
        mae=interval.mean,
        ci95=bounds,
        excludes_zero=bounds is not None and (bounds[0] > 0 or bounds[1] < 0),
        ratio=(reference_mae + interval.mean) / reference_mae if reference_mae > 0 else None,
    )


def _finite_bounds(lower: float, upper: float) -> Interval | None:
    return (lower, upper) if math.isfinite(lower) and math.isfinite(upper) else None


def build_goodness_file(
    run: str, splits: Mapping[str, Sequence[GoodnessRow]], dt: float
) -> GoodnessFile:
    """Return the contents of goodness.json."""
    rows_by_split = {split: tuple(rows) for split, rows in splits.items()}
    return GoodnessFile(schema=SCHEMA, run=run, lags=N_LAGS, step=dt, splits=rows_by_split)

"""Confidence and prediction intervals of free-run errors from blocks of dependent windows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
import scipy

from residnet.evaluation.records import BlockCount, Interval, PairedDifference
from residnet.evaluation.verdict import MIN_LOGS_FOR_INTERVAL

CONFIDENCE_LEVEL = 0.95
"""Level of all intervals."""
_N_RESAMPLES = 10_000
"""Number of bootstrap resamples; the 2.5 % tail then contains 250."""
MIN_LOGS_AS_BLOCKS = 5
"""Number of logs from which each log is a block.

Chosen by hand like the next two constants: fewer blocks estimate the variance poorly, and smaller
ones are correlated.
"""
TARGET_BLOCKS = 8
"""Number of blocks at which the division of fewer logs aims."""
_MIN_BLOCKS = 5
"""Smallest number of blocks for an interval."""


@dataclass(frozen=True)
class ResamplingBlocks:
    """Blocks of windows for a bootstrap.

    Attributes:
        block_indices: block of each window, [W], from 0 on.
        block_kind: `logs` if a block is all windows of a log; `windows` for consecutive windows of
            one log; `segments` for uninterrupted parts of logs.
        n_blocks: number of blocks.
    """

    block_indices: np.ndarray
    block_kind: Literal["logs", "windows", "segments"]
    n_blocks: int

    def to_record(self) -> BlockCount:
        """Return the entry `ci95_blocks` of metrics.json."""
        return BlockCount(of=self.block_kind, count=self.n_blocks)


def make_resampling_blocks(log_indices: Sequence[int] | np.ndarray) -> ResamplingBlocks | None:
    """Return bootstrap blocks of windows, given the log index of each window.

    Windows of a log are in time order.

    With five or more logs a block is a log, so that the interval holds for new logs. Three or four
    logs are cut into the smallest number of equal runs of consecutive windows that gives at least
    eight blocks; the interval is then valid only if the variance between logs is small against the
    variance between such runs. Returns None, and thus no interval, for fewer than three logs or
    five blocks.
    """
    log_numbers = np.asarray(log_indices, dtype=int)
    unique_logs, windows_per_log = np.unique(log_numbers, return_counts=True)
    if len(unique_logs) >= MIN_LOGS_AS_BLOCKS:
        return ResamplingBlocks(np.searchsorted(unique_logs, log_numbers), "logs", len(unique_logs))
    if len(unique_logs) < MIN_LOGS_FOR_INTERVAL:
        return None
    block_length = int(windows_per_log.max())
    while (
        block_length > 1
        and sum(math.ceil(n_windows / block_length) for n_windows in windows_per_log)
        < TARGET_BLOCKS
    ):
        block_length -= 1
    block_indices = np.zeros(len(log_numbers), dtype=int)
    n_blocks = 0
    for log_number, n_windows in zip(unique_logs, windows_per_log, strict=True):
        for consecutive_windows in np.array_split(
            np.flatnonzero(log_numbers == log_number), math.ceil(n_windows / block_length)
        ):
            block_indices[consecutive_windows] = n_blocks
            n_blocks += 1
    return ResamplingBlocks(block_indices, "windows", n_blocks) if n_blocks >= _MIN_BLOCKS else None


def bootstrap_intervals(
    values: np.ndarray, resampling_blocks: ResamplingBlocks | None
) -> list[Interval | None]:
    """Return 95 % confidence intervals of the means of columns [W, C] over windows.

    Intervals are None without blocks.

    Percentile bootstrap over blocks drawn with replacement, with a fixed seed. The percentile
    levels are widened by Student's t for few blocks (Hesterberg 2015, The American Statistician 69,
    371-386, section 5.3): plain percentiles cover some 83 % with five blocks.
    """
    if resampling_blocks is None:
        return [None] * values.shape[1]
    block_sums = np.stack(
        [
            np.bincount(resampling_blocks.block_indices, column, resampling_blocks.n_blocks)
            for column in values.T
        ],
        axis=1,
    )
    block_counts = _draw_block_counts(resampling_blocks.n_blocks)
    resampled_means = (block_counts @ block_sums) / (
        block_counts
        @ np.bincount(resampling_blocks.block_indices, minlength=resampling_blocks.n_blocks)
    )[:, None]
    # block sums instead of windows: one matrix product gives all resamples of all columns
    tail_probability = bootstrap_tail_probability(resampling_blocks.n_blocks)
    return [
        (float(lower), float(upper))
        for lower, upper in np.quantile(
            resampled_means, [tail_probability, 1 - tail_probability], axis=0
        ).T
    ]


class WindowErrors(NamedTuple):
    """Errors of the windows of one split.

    Attributes:
        values: non-negative errors [W, C]; a column is one kind of error of one model.
        log_indices: log index [W] of each window.
    """

    values: np.ndarray
    log_indices: np.ndarray

    @property
    def n_logs(self) -> int:
        """Number of logs that the windows come from."""
        return len(np.unique(self.log_indices))


class SpreadBetweenLogs(NamedTuple):
    """Relative variance of the mean error of a log.

    Attributes:
        variance: the variance in units of the squared mean over logs.
        n_logs: number of logs that estimate it.
        degrees_of_freedom: degrees of freedom of the estimate.
    """

    variance: float
    n_logs: int
    degrees_of_freedom: float


_LOG_VARIANCE_SPREAD = 1.0
"""Standard deviation of the logarithm of the ratio of the variances of two splits.

With 1, spreads of two splits differ by a factor of up to 2.7 in 95 % of cases. Drawn logs (three
of test, two of validation, five of training): coverage of the 95 % intervals 0.956 for equal
spreads, 0.919 where that of the test logs is 1.5 times that of the others. Pooling after an F test
of equal variances (level 0.25) has 0.952 and 0.922, but its largest tenth of upper limits begins at
3.4 and 6.1 times the mean in place of 2.8 and 4.2 times.
"""


def prediction_intervals(
    errors: WindowErrors, other_splits: Sequence[WindowErrors] = ()
) -> list[Interval | None]:
    """Return 95 % prediction intervals of the means of columns over new logs.

    The number of new logs equals the number of logs in the data. Windows of a log share manoeuvre,
    weather and speed, so the spread of the means of logs counts. Errors are positive with a random
    scale: the interval is Student's t for the logarithm of the mean over logs, with the variance of
    the observed and of the new logs (Hahn and Meeker 1991, Statistical Intervals, chapter 4).

    Args:
        errors: errors of the windows, which alone determine the means.
        other_splits: errors of the same models at the same horizon on other logs, which also
            estimate the spread between logs, see `estimate_spread_between_logs`.

    Returns:
        An interval for each column; None for fewer than three logs.
    """
    if errors.n_logs < MIN_LOGS_FOR_INTERVAL:
        return [None] * errors.values.shape[1]
    spread = estimate_spread_between_logs(errors, other_splits)
    half_width = scipy.stats.t.ppf(
        0.5 + CONFIDENCE_LEVEL / 2, spread.degrees_of_freedom
    ) * math.sqrt(2 / errors.n_logs * spread.variance)
    # relative deviations of means are deviations of logarithms in first order
    interval_factor = math.exp(half_width)
    return [
        (float(mean / interval_factor), float(mean * interval_factor))
        for mean in errors.values.mean(0)
    ]


def estimate_spread_between_logs(
    errors: WindowErrors, other_splits: Sequence[WindowErrors] = ()
) -> SpreadBetweenLogs:
    """Return the relative variance of the mean error of a log of the first split.

    The variance refers to the mean over logs of its split, so that a log with nearly no error does
    not increase it, and smaller errors on training logs do not bias it. It is pooled over all
    columns, since a few logs estimate it poorly and the best column would get too narrow an
    interval; correlated columns count as two. It is also pooled over splits, which have the same
    coefficient of variation. If the first split varies more than the others, their variance is a
    prior of its own: it counts only as many degrees of freedom as the scatter of variances between
    splits allows (moderated variance, Smyth 2004, Statistical Applications in Genetics and
    Molecular Biology 3, article 3). Where the logs of splits have different numbers of windows k,
    the component of variance of the windows, which contributes a share 1 / k, is adjusted to that
    of the first split (one-way random model, Searle, Casella and McCulloch 1992, Variance
    Components, chapter 3).
    """
    splits = [split for split in (errors, *other_splits) if split.n_logs > 1]
    components = [_estimate_variance_components(split) for split in splits]
    within_degrees = np.array([len(split.values) - split.n_logs for split in splits])
    within_variance = float(
        within_degrees @ [component.within_logs for component in components]
    ) / max(int(within_degrees.sum()), 1)
    variances = np.array(
        [
            max(
                component.between_logs
                + within_variance * (1 / components[0].n_windows - 1 / component.n_windows),
                0.0,
            )
            for component in components
        ]
    )
    n_logs = np.array([split.n_logs for split in splits])
    degrees_of_freedom = min(errors.values.shape[1], 2) * (n_logs - 1)
    if len(splits) > 1:
        others = slice(1, None)
        other_variance = float(np.average(variances[others], weights=degrees_of_freedom[others]))
        other_degrees = float(degrees_of_freedom[others].sum())
        if variances[0] > other_variance:
            # the variance of the logarithm of a variance with f degrees of freedom is about 2 / f
            other_degrees = 2.0 / (2.0 / other_degrees + _LOG_VARIANCE_SPREAD**2)
        total_degrees = float(degrees_of_freedom[0]) + other_degrees
        variance = (
            float(degrees_of_freedom[0]) * float(variances[0]) + other_degrees * other_variance
        ) / total_degrees
        return SpreadBetweenLogs(variance, int(n_logs.sum()), total_degrees)
    return SpreadBetweenLogs(float(variances[0]), int(n_logs[0]), int(degrees_of_freedom[0]))


class _VarianceComponents(NamedTuple):
    """Relative variances of the errors of a split, means over its columns.

    Attributes:
        between_logs: variance of the means of logs.
        within_logs: variance of the windows about the mean of their log.
        n_windows: harmonic mean of the number of windows of a log.
    """

    between_logs: float
    within_logs: float
    n_windows: float


def _estimate_variance_components(errors: WindowErrors) -> _VarianceComponents:
    """Return the relative variances of errors of at least two logs, between and within logs."""
    unique_logs, log_positions = np.unique(errors.log_indices, return_inverse=True)
    n_logs = len(unique_logs)
    windows_per_log = np.bincount(log_positions)
    # columns without any error, or with a diverged one, would distort the pooled variance
    is_usable = errors.values.any(axis=0) & np.isfinite(errors.values).all(axis=0)
    values = errors.values[:, is_usable]
    n_windows = float(n_logs / (1 / windows_per_log).sum())
    if values.shape[1] == 0:
        return _VarianceComponents(0.0, 0.0, n_windows)
    log_sums = np.stack([np.bincount(log_positions, column, n_logs) for column in values.T], axis=1)
    log_means = log_sums / windows_per_log[:, None]
    split_means = log_means.mean(axis=0)
    within_sum = (((values - log_means[log_positions]) / split_means) ** 2).sum(axis=0).mean()
    return _VarianceComponents(
        float((log_means / split_means).var(axis=0, ddof=1).mean()),
        float(within_sum) / max(len(values) - n_logs, 1),
        n_windows,
    )


def bootstrap_tail_probability(n_blocks: int) -> float:
    """Return the tail probability of the percentiles at either end, for at least 2 blocks.

    It is 0.025 for many blocks and less for few.
    """
    widened_t_quantile = math.sqrt(n_blocks / (n_blocks - 1)) * scipy.stats.t.ppf(
        0.5 + CONFIDENCE_LEVEL / 2, n_blocks - 1
    )
    return float(scipy.stats.norm.cdf(-widened_t_quantile))


@lru_cache(maxsize=16)
def _draw_block_counts(n_blocks: int) -> np.ndarray:
    """Return how often each block is drawn in each resample, [resamples, n_blocks]."""
    return (
        # a fixed seed: the same results give the same intervals in every report
        np.random.default_rng(0)
        .multinomial(n_blocks, np.full(n_blocks, 1 / n_blocks), size=_N_RESAMPLES)
        .astype(float)
    )


def paired_difference(
    model_errors: np.ndarray,
    reference_errors: np.ndarray,
    reference_name: str,
    resampling_blocks: ResamplingBlocks | None,
) -> PairedDifference:
    """Return the paired difference of two models' mean errors.

    Args:
        model_errors: error of each window, [W].
        reference_errors: error of the reference model over the same windows, [W].
    """
    differences = model_errors - reference_errors
    (confidence_interval,) = bootstrap_intervals(differences[:, None], resampling_blocks)
    reference_mean = float(reference_errors.mean())
    ratio = float(model_errors.mean()) / reference_mean if reference_mean > 0 else None
    return PairedDifference(
        to=reference_name,
        nrmse_mean=float(differences.mean()),
        ci95=confidence_interval,
        excludes_zero=confidence_interval is not None
        and (confidence_interval[0] > 0 or confidence_interval[1] < 0),
        ratio=ratio,
        worse=ratio is not None and ratio > 1.05,
    )

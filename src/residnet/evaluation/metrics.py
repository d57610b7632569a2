"""Errors of free runs: rows of metrics.json, their intervals, and the limits of a model."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

import numpy as np
import scipy

from residnet.core.files import atomic_write, make_file_stem
from residnet.core.layout import PLANAR_LAYOUT, VELOCITIES, DegreesOfFreedom
from residnet.core.model_names import CONSTANT_VELOCITY
from residnet.core.names import POSE_ERROR_UNITS
from residnet.evaluation.band import BandsByModel
from residnet.evaluation.bands import band_limits, compute_run_errors, count_coverage
from residnet.evaluation.records import (
    BlockCount,
    ClassErrors,
    ClassRow,
    HorizonRow,
    Interval,
    KinematicErrors,
    MetricsFile,
    MetricsRow,
    OutsideRange,
    PairedDifference,
    PoseErrors,
    ProtocolLimits,
    WorstWindow,
)
from residnet.evaluation.verdict import MIN_LOGS_FOR_INTERVAL, describe_divergence

if TYPE_CHECKING:
    import pandas as pd

    from residnet.evaluation.freerun import Candidate, FreeRun
    from residnet.preprocessing.prepare import PreparedLog


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
        """Number of logs."""
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
    degrees_of_freedom: int


_HOMOGENEITY_LEVEL = 0.25
"""Level of the F test by which a larger spread of a split is not pooled with that of others.

Source: Bancroft 1964, Biometrics 20, 427-442, who recommends 0.25 for tests before pooling. In
simulations the coverage of the 95 % intervals is 0.953 for equal spreads, and 0.943 where that of
three test logs is twice that of the others; a level of 0.05 gives 0.941 and 0.866.
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
    coefficient of variation (pooled variance), unless the first split varies significantly more
    (one-sided F test). Where the logs of splits have different numbers of windows k, the component
    of variance of the windows, which contributes a share 1 / k, is adjusted to that of the first
    split (one-way random model, Searle, Casella and McCulloch 1992, Variance Components, chapter
    3).
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
        largest_ratio = scipy.stats.f.ppf(
            1 - _HOMOGENEITY_LEVEL, degrees_of_freedom[0], degrees_of_freedom[others].sum()
        )
        if variances[0] <= largest_ratio * other_variance:
            return SpreadBetweenLogs(
                float(np.average(variances, weights=degrees_of_freedom)),
                int(n_logs.sum()),
                int(degrees_of_freedom.sum()),
            )
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


SCHEMA: Final = "residnet.metrics/1"
LIMITS_SCHEMA: Final = "residnet.limits/1"
_N_WORST_WINDOWS = 3
"""Number of reported worst windows of a model."""
_N_SPEED_CLASSES = 3
"""Number of classes of speed, and of wind speed."""
_MIN_CLASS_WINDOWS = 3
"""Smallest number of windows of a reported class."""
_WIND_CHANNEL = "wind_speed"
_HORIZONS = (10.0, 30.0, 100.0)
"""Horizons in s of the reported pose errors."""


@dataclass(frozen=True)
class HorizonErrors:
    """Errors of the W windows of one split and protocol that reach a horizon.

    Attributes:
        n_steps: the horizon in time steps.
        seconds: the horizon in s.
        log_indices: log index [W] of each window.
        mean_speeds: mean speed [W] of each window in m/s.
        distance: mean distance travelled in m.
        integration_errors: magnitudes [W] of the pose errors of the integrated measured velocities.
        pose_errors: magnitudes [W] of the pose errors by model and name.
    """

    n_steps: int
    seconds: float
    log_indices: np.ndarray
    mean_speeds: np.ndarray
    distance: float
    integration_errors: Mapping[str, np.ndarray]
    pose_errors: Mapping[str, Mapping[str, np.ndarray]]

    def summarize(self, other_splits: Sequence[HorizonErrors] = ()) -> HorizonRow:
        """Return means and intervals at the horizon.

        Args:
            other_splits: errors of the same models on other logs after the same time, which also
                estimate the spread between logs.
        """
        (floor,) = _summarize_pose_errors(
            {"floor": self.integration_errors}, self.log_indices
        ).values()
        other_errors = [other._to_window_errors(self.pose_errors) for other in other_splits]
        n_logs = len(np.unique(self.log_indices))
        return HorizonRow(
            seconds=self.seconds,
            windows=len(self.log_indices),
            logs=n_logs,
            logs_of_spread=(
                estimate_spread_between_logs(
                    self._to_window_errors(self.pose_errors), other_errors
                ).n_logs
                if n_logs >= MIN_LOGS_FOR_INTERVAL
                else 0
            ),
            slowest=float(self.mean_speeds.min()),
            fastest=float(self.mean_speeds.max()),
            sailed=self.distance,
            floor=floor,
            models=_summarize_pose_errors(self.pose_errors, self.log_indices, other_errors),
            change_from_constant_velocity=_compare_pose_errors(self.pose_errors, self.log_indices),
        )

    def _to_window_errors(self, models: Collection[str]) -> WindowErrors:
        """Return the pose errors of models as one table, in the order of the models."""
        return WindowErrors(
            np.column_stack(
                [sizes for name in models for sizes in self.pose_errors[name].values()]
            ),
            self.log_indices,
        )


class ProtocolEvaluation:
    """Errors of all models over the W windows of one protocol, and statistics of them.

    Args:
        free_run: free runs of all models.
        scales: denominators of the nrmse.
    """

    def __init__(
        self,
        free_run: FreeRun,
        candidates: Sequence[Candidate],
        logs: Sequence[PreparedLog],
        scales: Mapping[str, float],
    ) -> None:
        # imported here because it imports PyTorch, which reports of finished runs do not need
        from residnet.evaluation.freerun import FreeRunErrors

        self.free_run = free_run
        self.candidates = candidates
        self.logs = logs
        self.dof = logs[0].dof
        self.state_scales = np.array([scales.get(name, 1.0) for name in self.dof.dynamic_states])
        self.log_slices = [(logs[w.log_index], slice(w.start, w.stop)) for w in free_run.windows]
        self.log_indices = np.array([window.log_index for window in free_run.windows])
        self.errors = {
            candidate.name: FreeRunErrors.from_predictions(
                free_run.windows, free_run.predictions[candidate.name], logs
            )
            for candidate in candidates
        }
        self.nrmse_by_window = {
            name: errors.nrmse(self.state_scales) for name, errors in self.errors.items()
        }
        self._horizon_errors: list[HorizonErrors] | None = None

    def paired_difference(
        self,
        model_name: str,
        reference_name: str | None,
        window_mask: np.ndarray,
        errors_by_model: Mapping[str, np.ndarray] | None = None,
    ) -> PairedDifference | None:
        """Return the paired difference of two models over selected windows [W] bool.

        None if the reference model was not evaluated. `errors_by_model` [W] replaces the nrmse.
        """
        errors_by_model = self.nrmse_by_window if errors_by_model is None else errors_by_model
        if reference_name is None or reference_name not in errors_by_model:
            return None
        resampling_blocks = make_resampling_blocks(self.log_indices[window_mask])
        return paired_difference(
            errors_by_model[model_name][window_mask],
            errors_by_model[reference_name][window_mask],
            reference_name,
            resampling_blocks,
        )

    def build_rows(self, groups: Mapping[str, Sequence[str]]) -> list[MetricsRow]:
        """Return the rows of metrics.json.

        One row per model for all windows, every kind of manoeuvre and every named group of kinds.
        `difference` compares a model with its reference (`Candidate.reference`); None without one.
        Rows of models with prediction intervals also have coverage and interval score.
        """
        manoeuvre_kinds = [log.log.manoeuvre for log, _ in self.log_slices]
        kinds_by_group: dict[str, Sequence[str]] = {"all": manoeuvre_kinds}
        kinds_by_group |= {
            manoeuvre_kind: [manoeuvre_kind] for manoeuvre_kind in sorted(set(manoeuvre_kinds))
        } | dict(groups)
        coverage_by_model = {
            candidate.name: count_coverage(
                compute_run_errors(
                    self.free_run.windows,
                    self.free_run.predictions[candidate.name],
                    self.logs,
                    self.errors[candidate.name],
                ),
                candidate.bands[self.free_run.protocol],
            )
            for candidate in self.candidates
            if self.free_run.protocol in candidate.bands
        }
        metric_rows = []
        for candidate in self.candidates:
            for group_name, group_kinds in kinds_by_group.items():
                # groups of the config may name kinds that this split does not have
                window_mask = np.isin(manoeuvre_kinds, list(group_kinds))
                if not window_mask.any():
                    continue
                row = self._summarize_windows(candidate, group_name, window_mask)
                if candidate.name in coverage_by_model:
                    coverage = coverage_by_model[candidate.name].summarize(window_mask)
                    row = row.model_copy(
                        update={
                            "band_coverage": coverage.share,
                            "band_score": coverage.score,
                            "band_score_constant": coverage.constant_width_score,
                        }
                    )
                metric_rows.append(row)
        return metric_rows

    def _summarize_windows(
        self, candidate: Candidate, manoeuvre: str, window_mask: np.ndarray
    ) -> MetricsRow:
        """Return the row of one model over selected windows [W] bool, without band coverage."""
        model_name = candidate.name
        errors = self.errors[model_name]
        resampling_blocks = make_resampling_blocks(self.log_indices[window_mask])
        dof = self.dof
        pose_errors = errors.final_pose_errors()
        errors_by_window = np.column_stack(
            (errors.rmse, self.nrmse_by_window[model_name], *pose_errors.values())
        )[window_mask]
        rmse = errors_by_window[:, : dof.n_dynamic].mean(0)
        mae = errors.mae[window_mask].mean(0)
        nrmse = rmse / self.state_scales
        confidence_intervals = bootstrap_intervals(errors_by_window, resampling_blocks)
        n_usable = errors.n_usable[window_mask]

        def map_by_state(by_state: np.ndarray) -> dict[str, float]:
            return {dof.dynamic_states[axis]: float(by_state[axis]) for axis in dof.active_indices}

        # the pose errors are the columns after the dynamic states and the NRMSE
        final_pose_errors: dict[str, Any] = {}
        for column, pose_error_name in enumerate(pose_errors, dof.n_dynamic + 1):
            final_pose_errors |= {
                f"{pose_error_name}_error_end": float(errors_by_window[:, column].mean()),
                f"{pose_error_name}_error_end_ci95": confidence_intervals[column],
            }
        n_diverged = sum(
            prediction.has_diverged
            for prediction, is_selected in zip(
                self.free_run.predictions[model_name], window_mask, strict=True
            )
            if is_selected
        )
        return MetricsRow(
            model=model_name,
            kind=candidate.model_kind,
            split=self.free_run.split,
            protocol=self.free_run.protocol,
            manoeuvre=manoeuvre,
            windows=len(n_usable),
            n=int(n_usable.sum()),
            diverged=n_diverged,
            rmse=map_by_state(rmse),
            mae=map_by_state(mae),
            nrmse=map_by_state(nrmse) | {"mean": float(nrmse[dof.active_indices].mean())},
            rmse_ci95={
                dof.dynamic_states[axis]: confidence_intervals[axis] for axis in dof.active_indices
            },
            nrmse_mean_ci95=confidence_intervals[dof.n_dynamic],
            ci95_blocks=None if resampling_blocks is None else resampling_blocks.to_record(),
            difference=self.paired_difference(model_name, candidate.reference, window_mask),
            **final_pose_errors,
        )

    def build_limits(
        self, dt: float, other_splits: Sequence[ProtocolEvaluation] = ()
    ) -> ProtocolLimits:
        """Return the part of limits.json for one protocol and split.

        Args:
            dt: time step of the grid in s.
            other_splits: the same models and protocol on other logs, which also estimate the spread
                between logs.
        """
        return ProtocolLimits(
            kinematics=self.evaluate_kinematics(dt),
            bands=tuple(self.evaluate_by_class()),
            worst={name: tuple(self.list_worst_windows(name)) for name in self.errors},
            compared=self.compare_with_references(),
            outside=self.share_outside_training_range(),
            horizons=tuple(self.evaluate_horizons(dt, other_splits)),
            beyond_calibration=self.share_beyond_calibration(),
        )

    def evaluate_horizons(
        self, dt: float, other_splits: Sequence[ProtocolEvaluation] = ()
    ) -> list[HorizonRow]:
        """Return means and prediction intervals of the pose errors, see `compute_horizon_errors`.

        Args:
            dt: time step of the grid in s.
            other_splits: the same models and protocol on other logs.
        """
        other_errors = [
            horizon
            for evaluation in other_splits
            for horizon in evaluation.compute_horizon_errors(dt)
        ]
        return [
            horizon.summarize([other for other in other_errors if other.n_steps == horizon.n_steps])
            for horizon in self.compute_horizon_errors(dt)
        ]

    def compute_horizon_errors(self, dt: float) -> list[HorizonErrors]:
        """Return position and attitude errors of all models after 10, 30 and 100 s and at the end.

        Each split needs those of all others, so that they are computed once.

        Args:
            dt: time step of the grid in s.

        Returns:
            One entry for each horizon below the length of the longest window and one for its end.
        """
        if self._horizon_errors is not None:
            return self._horizon_errors
        from residnet.evaluation.freerun import compute_integration_errors

        any_errors = next(iter(self.errors.values()))
        mean_speeds = self._mean_speeds()
        max_steps = int(any_errors.window_lengths.max()) - 1
        horizon_steps = [round(seconds / dt) for seconds in _HORIZONS]
        entries = []
        for n_steps in [
            *(n_steps for n_steps in horizon_steps if 0 < n_steps < max_steps),
            max_steps,
        ]:
            reaches_horizon = any_errors.window_lengths > n_steps
            # the final pose must have been measured, not bridged over a gap
            reaches_horizon[reaches_horizon] = any_errors.is_usable[
                (any_errors.window_starts + n_steps)[reaches_horizon]
            ]
            if not reaches_horizon.any():
                continue
            long_slices = (self.log_slices[i] for i in np.flatnonzero(reaches_horizon).tolist())
            measured_states = [
                log.y[window_slice][: n_steps + 1] for log, window_slice in long_slices
            ]
            distances = [
                float(np.hypot(*states[:, VELOCITIES][:, :2].T).sum()) * dt
                for states in measured_states
            ]
            entries.append(
                HorizonErrors(
                    n_steps=n_steps,
                    seconds=n_steps * dt,
                    log_indices=self.log_indices[reaches_horizon],
                    mean_speeds=mean_speeds[reaches_horizon],
                    distance=float(np.mean(distances)),
                    integration_errors=compute_integration_errors(
                        np.stack(measured_states), self.dof, dt
                    ),
                    pose_errors={
                        name: errors.final_pose_errors(
                            (errors.window_starts + n_steps)[reaches_horizon]
                        )
                        for name, errors in self.errors.items()
                    },
                )
            )
        self._horizon_errors = entries
        return entries

    def evaluate_kinematics(self, dt: float) -> KinematicErrors:
        """Return pose errors of the integrated measured velocities (noise floor).

        The measured velocities are integrated over each window from its measured pose. A model with
        exact velocities would have these errors.

        Returns:
            Mean and root mean square of each pose error at the ends of windows; no errors if some
            velocities were not measured.
        """
        if self.dof.fixed_states:
            return KinematicErrors()
        from residnet.evaluation.freerun import compute_integration_errors

        states_by_length: dict[int, list[np.ndarray]] = {}
        for log, window_slice in self.log_slices:
            states_by_length.setdefault(window_slice.stop - window_slice.start, []).append(
                log.y[window_slice]
            )
        integration_errors = [
            compute_integration_errors(np.stack(states_of_length), self.dof, dt)
            for states_of_length in states_by_length.values()
        ]
        summary: dict[str, float] = {}
        for name in self.dof.pose_error_names:
            values = np.concatenate(
                [errors_of_length[name] for errors_of_length in integration_errors]
            )
            summary[f"{name}_mean"] = float(values.mean())
            summary[f"{name}_rms"] = float(np.sqrt(np.mean(values**2)))
        return KinematicErrors.model_validate({"windows": len(self.log_slices), **summary})

    def _mean_speeds(self) -> np.ndarray:
        return np.array(
            [
                np.hypot(*log.y[window_slice, VELOCITIES][:, :2].T).mean()
                for log, window_slice in self.log_slices
            ]
        )

    def evaluate_by_class(self) -> list[ClassRow]:
        """Return errors by thirds of the windows in mean speed and mean true wind speed.

        Wind speed only if every log has it. A class of fewer than three windows is omitted, and so
        is a quantity with a single class.
        """
        values_by_quantity: dict[Literal["speed", "wind"], np.ndarray] = {
            "speed": self._mean_speeds()
        }
        if all(_WIND_CHANNEL in log.log.channels for log, _ in self.log_slices):
            mean_wind_speeds = [
                log.log[_WIND_CHANNEL][window_slice].mean() for log, window_slice in self.log_slices
            ]
            values_by_quantity["wind"] = np.array(mean_wind_speeds)
        entries = []
        for quantity, values in values_by_quantity.items():
            if not np.isfinite(values).all():
                continue
            # quantiles of the windows instead of equal ranges, so that each class has enough
            # windows; `searchsorted` keeps windows with equal values in one class
            class_limits = np.quantile(values, np.arange(1, _N_SPEED_CLASSES) / _N_SPEED_CLASSES)
            class_indices = np.searchsorted(class_limits, values, side="left")
            class_masks = [
                class_indices == k
                for k in range(_N_SPEED_CLASSES)
                if (class_indices == k).sum() >= _MIN_CLASS_WINDOWS
            ]
            entries += [
                ClassRow(
                    by=quantity,
                    low=float(values[class_mask].min()),
                    high=float(values[class_mask].max()),
                    windows=int(class_mask.sum()),
                    models={
                        candidate.name: ClassErrors(
                            nrmse_mean=float(
                                self.nrmse_by_window[candidate.name][class_mask].mean()
                            ),
                            difference=self.paired_difference(
                                candidate.name, candidate.reference, class_mask
                            ),
                        )
                        for candidate in self.candidates
                    },
                )
                for class_mask in (class_masks if len(class_masks) > 1 else ())
            ]
        return entries

    def list_worst_windows(self, model_name: str) -> list[WorstWindow]:
        """Return the three windows with the largest nrmse of a model.

        The pose error is the first one that the velocities of the model determine.
        """
        errors = self.errors[model_name]
        nrmse = self.nrmse_by_window[model_name]
        pose_error_name = self.dof.pose_error_names[0]
        pose_errors = errors.final_pose_errors()[pose_error_name]
        return [
            WorstWindow.model_validate(
                {
                    "log": self.log_slices[i][0].log.name,
                    "manoeuvre": self.log_slices[i][0].log.manoeuvre,
                    "t": float(self.log_slices[i][0].log.t[self.free_run.windows[i].start]),
                    "nrmse": float(nrmse[i]),
                    "rmse": {
                        self.dof.dynamic_states[axis]: float(errors.rmse[i, axis])
                        for axis in self.dof.active_indices
                    },
                    f"{pose_error_name}_error_end": float(pose_errors[i]),
                }
            )
            for i in np.argsort(-nrmse, kind="stable")[:_N_WORST_WINDOWS].tolist()
        ]

    def compare_with_references(self) -> dict[str, dict[str, PairedDifference | None]]:
        """Return paired differences of each model from constant velocity and to the first
        baseline.
        """
        all_windows = np.ones(len(self.log_indices), dtype=bool)
        reference_names = [CONSTANT_VELOCITY] if CONSTANT_VELOCITY in self.errors else []
        reference_names += [
            candidate.name for candidate in self.candidates if candidate.model_kind == "baseline"
        ][:1]
        return {
            model_name: {
                reference_name: self.paired_difference(model_name, reference_name, all_windows)
                for reference_name in reference_names
                if reference_name != model_name
            }
            for model_name in self.errors
        }

    def share_beyond_calibration(self) -> dict[str, float]:
        """Return by model the share of windows beyond the calibration of its intervals.

        These windows are farther from the training data than any run that calibrated the intervals.
        """
        shares = {}
        for candidate in self.candidates:
            band = candidate.bands.get(self.free_run.protocol)
            predictions = self.free_run.predictions[candidate.name]
            distances = [one.distance[-1] for one in predictions if one.distance is not None]
            if band is not None and len(distances) == len(predictions) > 0:
                shares[candidate.name] = float(np.mean(np.array(distances) > band.largest_distance))
        return shares

    def share_outside_training_range(self) -> OutsideRange:
        """Return the share of samples outside the range of the training data.

        Returns:
            Share of the usable samples with a velocity or an input outside its range; no share if
            the ranges are unknown. Depth has no effect on the motion and is ignored.
        """
        ranges = next(
            (
                candidate.training_ranges
                for candidate in self.candidates
                if candidate.training_ranges
            ),
            {},
        )
        if not ranges:
            return OutsideRange()
        values = np.concatenate(
            [
                np.concatenate(
                    (log.y[window_slice, log.dof.dynamic_columns], log.w[window_slice]), axis=1
                )[log.usable[window_slice]]
                for log, window_slice in self.log_slices
            ]
        )
        lower, upper = np.array(list(ranges.values())).T
        unused_channels = self.log_slices[0][0].dof.unmodelled_states
        is_outside = (values < lower) | (values > upper)
        is_outside &= np.array([name not in unused_channels for name in ranges])
        shares = dict(zip(ranges, is_outside.mean(0).tolist(), strict=True))
        return OutsideRange(
            share=float(is_outside.any(1).mean()),
            channels={name: share for name, share in shares.items() if share > 0},
        )


def _summarize_pose_errors(
    pose_errors: Mapping[str, Mapping[str, np.ndarray]],
    log_indices: np.ndarray,
    other_splits: Sequence[WindowErrors] = (),
) -> dict[str, PoseErrors]:
    """Return means and intervals of the magnitudes [W] of pose errors, by model and name."""
    values = np.column_stack(
        [sizes for sizes_by_name in pose_errors.values() for sizes in sizes_by_name.values()]
    )
    means_and_intervals = zip(
        values.mean(0).tolist(),
        prediction_intervals(WindowErrors(values, log_indices), other_splits),
        strict=True,
    )
    summary: dict[str, PoseErrors] = {}
    for model, sizes_by_name in pose_errors.items():
        mean_and_interval = {name: next(means_and_intervals) for name in sizes_by_name}
        # errors of angles are at most half a turn
        upper_bounds = {
            name: math.pi if POSE_ERROR_UNITS[name] == "rad" else math.inf for name in sizes_by_name
        }
        intervals_by_name = {
            name: interval and (interval[0], min(interval[1], upper_bounds[name]))
            for name, (_, interval) in mean_and_interval.items()
        }
        means = {name: mean for name, (mean, _) in mean_and_interval.items()}
        summary[model] = PoseErrors.model_validate({**means, "intervals": intervals_by_name})
    return summary


def _compare_pose_errors(
    pose_errors: Mapping[str, Mapping[str, np.ndarray]], log_indices: np.ndarray
) -> dict[str, dict[str, Interval | None]]:
    """Return confidence intervals of the differences to the constant-velocity model.

    Args:
        pose_errors: magnitudes [W] of the pose errors by model and name.
        log_indices: log index [W] of each window.
    """
    reference_errors = pose_errors.get(CONSTANT_VELOCITY)
    if reference_errors is None:
        return {}
    blocks = make_resampling_blocks(log_indices)
    changes: dict[str, dict[str, Interval | None]] = {}
    for model, sizes_by_name in pose_errors.items():
        if model == CONSTANT_VELOCITY:
            continue
        differences = np.column_stack(
            [sizes - reference_errors[name] for name, sizes in sizes_by_name.items()]
        )
        changes[model] = dict(
            zip(sizes_by_name, bootstrap_intervals(differences, blocks), strict=True)
        )
    return changes


def find_row(
    rows: Sequence[MetricsRow],
    *,
    model: str,
    split: str | None = None,
    protocol: str | None = None,
    manoeuvre: str = "all",
) -> MetricsRow:
    """Return the row of a model and manoeuvre, and of a split and protocol if these are given.

    Raises:
        KeyError: if there is no such row, or several.
    """
    matching_rows = [
        row
        for row in rows
        if row.model == model
        and row.manoeuvre == manoeuvre
        and split in (None, row.split)
        and protocol in (None, row.protocol)
    ]
    if len(matching_rows) != 1:
        raise KeyError(
            f"{len(matching_rows)} rows of model {model}, split {split}, protocol {protocol},"
            f" manoeuvre {manoeuvre}"
        )
    return matching_rows[0]


def build_metrics_file(
    run: str,
    units: Mapping[str, str],
    scales: Mapping[str, float],
    selected: str,
    selected_ensemble: str | None,
    predictor: str,
    rows: Sequence[MetricsRow],
) -> MetricsFile:
    """Return the contents of metrics.json.

    Args:
        run: name of the run.
        units: unit of each state.
        scales: denominators of the nrmse.
        selected: name of the single model that the validation data chose.
        selected_ensemble: name of the best ensemble; None without ensembles.
        predictor: name of the model that is reported first and exported by default.
        rows: rows of all splits, without `selected`.
    """
    return MetricsFile(
        schema=SCHEMA,
        run=run,
        channels=dict(units),
        scales=dict(scales),
        selected=selected,
        selected_ensemble=selected_ensemble,
        predictor=predictor,
        rows=tuple(mark_selected(rows, selected)),
    )


def mark_selected(rows: Sequence[MetricsRow], selected: str) -> list[MetricsRow]:
    """Return the rows with `selected` set, by the name of the selected model."""
    return [row.model_copy(update={"selected": row.model == selected}) for row in rows]


def build_metrics_table(rows: Sequence[MetricsRow]) -> pd.DataFrame:
    """Return rows of metrics.json as a table with one column per number.

    Args:
        rows: rows of metrics.json.

    Returns:
        Columns model, kind, split, protocol, manoeuvre (and selected where a model was chosen),
        windows, diverged, n, then rmse_u, rmse_v, rmse_r (m/s, m/s, rad/s), the same for mae and
        nrmse with nrmse_mean, note (such as "2/12 diverged"; diverged windows count with the
        error of `constant_velocity`), and position_error_end (m), heading_error_end (rad), or
        depth_error_end (m) and attitude_error_end (rad) for vessels that dive.
    """
    import pandas as pd

    return pd.DataFrame([_flatten_row(row) for row in rows])


def _flatten_row(row: MetricsRow) -> dict[str, str | float | None]:
    flat_row: dict[str, str | float | None] = {
        "model": row.model,
        "kind": row.kind,
        "split": row.split,
        "protocol": row.protocol,
        "manoeuvre": row.manoeuvre,
    }
    if row.selected is not None:
        flat_row["selected"] = row.selected
    flat_row |= {"windows": row.windows, "diverged": row.diverged, "n": row.n}
    for name, errors in {"rmse": row.rmse, "mae": row.mae, "nrmse": row.nrmse}.items():
        flat_row |= {f"{name}_{channel}": value for channel, value in errors.items()}
    # next to the score, which contains constant-velocity errors for diverged windows
    flat_row["note"] = describe_divergence(row)
    return flat_row | {f"{name}_error_end": e for name, e in row.final_pose_errors.items()}


INPUT_PREFIX = "input_"
"""Prefix of the column names of inputs."""


def state_column_names(dof: DegreesOfFreedom) -> tuple[str, ...]:
    """Return column names of states: u, v, r, heading and position, then roll or dive states."""
    planar = dof.dynamic_states[: PLANAR_LAYOUT.n_dof]
    non_planar_states = dof.dynamic_states[PLANAR_LAYOUT.n_dof :]
    return (*planar, "psi", "x", "y", *non_planar_states)


def iterate_rollout_columns(
    runs: Sequence[FreeRun],
    logs: Sequence[PreparedLog],
    inputs: Sequence[str] = (),
    bands: BandsByModel | None = None,
) -> Iterator[tuple[PreparedLog, dict[str, np.ndarray]]]:
    """Yield each log with windows, with a row for each step of each model's free runs.

    Columns: protocol, model, window, t (s, the log's clock), usable, diverged, then u, v, r, psi,
    x, y (and p and phi with roll) as measured and with `_hat` as predicted (SI, rad), and the
    inputs held over the step after each sample with the prefix `input_`. With prediction intervals,
    `_low` and `_high` are their pointwise limits; for x and y the box about the position circle.
    They are NaN for models without intervals.

    Args:
        inputs: names of the inputs, in column order.
        bands: prediction intervals by model and protocol; None if no model has any.
    """
    bands_by_model = bands or {}
    for log_index, log in enumerate(logs):
        tables: list[dict[str, np.ndarray]] = []
        state_columns = {
            name: log.dof.state_names.index(name) for name in state_column_names(log.dof)
        }
        for run in runs:
            window_indices = [
                window_index
                for window_index, window in enumerate(run.windows)
                if window.log_index == log_index
            ]
            for model, predictions in run.predictions.items():
                band = bands_by_model.get(model, {}).get(run.protocol)
                for window_number, window_index in enumerate(window_indices):
                    window_slice = slice(
                        run.windows[window_index].start, run.windows[window_index].stop
                    )
                    prediction = predictions[window_index]
                    label_columns = {
                        "protocol": run.protocol,
                        "model": model,
                        "window": window_number,
                    }
                    states_by_suffix = {"": log.y[window_slice], "_hat": prediction.states}
                    if any(bands_by_model.values()):
                        lower = upper = np.full_like(prediction.states, np.nan)
                        if band is not None:
                            half_widths = band.half_widths(
                                prediction.states, prediction.spread, prediction.distance
                            )
                            lower, upper = band_limits(prediction.states, half_widths)
                        states_by_suffix |= {"_low": lower, "_high": upper}
                    tables.append(
                        {
                            name: np.full(len(prediction.states), label)
                            for name, label in label_columns.items()
                        }
                        | {"t": log.log.t[window_slice], "usable": log.usable[window_slice]}
                        | {"diverged": np.full(len(prediction.states), prediction.has_diverged)}
                        | {
                            f"{name}{suffix}": values[:, column]
                            for suffix, values in states_by_suffix.items()
                            for name, column in state_columns.items()
                        }
                        | {
                            f"{INPUT_PREFIX}{input_name}": log.w[window_slice, k]
                            for k, input_name in enumerate(inputs)
                        }
                    )
        if tables:
            yield (
                log,
                {name: np.concatenate([table[name] for table in tables]) for name in tables[0]},
            )


def write_rollouts(
    folder: Path,
    runs: Sequence[FreeRun],
    logs: Sequence[PreparedLog],
    inputs: Sequence[str],
    bands: BandsByModel | None = None,
) -> None:
    """Write one file per log of a split, as `iterate_rollout_columns` gives it."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    for log, columns in iterate_rollout_columns(runs, logs, inputs, bands):
        table = pa.table({name: pa.array(values) for name, values in columns.items()})
        with atomic_write(folder / f"{make_file_stem(log.log.name)}.parquet") as file:
            # dictionary encoding pays only for repeated texts, not for floating-point columns
            pq.write_table(table, file, compression="zstd", use_dictionary=["protocol", "model"])

"""Statistics of a log that several checks share: noise, smoothed channels, least-squares fits.

`LogStatistics` wraps a log and computes each statistic once.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence
from functools import cache, cached_property
from typing import Any, NamedTuple, TypeVar

import numpy as np

from residnet.core.layout import SIX_DOF_LAYOUT
from residnet.core.log import Log
from residnet.core.names import ACCELERATION_NAMES, VELOCITY_NAMES
from residnet.core.stretches import find_runs as runs_of
from residnet.preprocessing.channel_values import (
    CACHED_SAMPLES,
    estimate_noise_std,
    find_hampel_outliers,
    mask_from_ranges,
    nan_median,
    nan_quantiles,
    nan_std,
    sample_rows,
)
from residnet.preprocessing.derivatives import fit_local_polynomials
from residnet.preprocessing.statistics import OverlappingBlocks

MOTION_CHANNELS = frozenset((*SIX_DOF_LAYOUT.state_names, *ACCELERATION_NAMES))
"""Channels of states and accelerations; all other channels count as inputs."""
STEERING_CHANNELS = ("delta", "tau_n", "acting_tau_n", "cmd_delta", "nozzle", "cmd_nozzle")
"""Channels whose deflection turns the vessel."""
N_SECTIONS = 20
"""Sections of a log whose residuals are assumed independent of each other."""
SMOOTHING_SAMPLES = 15
"""Window length of the parabolic smoother in samples."""

_N_SUBSAMPLE_SEGMENTS = 5
"""Number of stretches that form a subsample."""
_MAX_SUBSAMPLE = 40_000
"""Largest number of samples of a subsample.

Chosen by hand; `tests/io/test_relations.py` compares findings on the subsample and on all samples.
"""
_SEAM_STEPS = 5
"""Gap between the stretches of a subsample in sampling intervals: too long for interpolation."""
_MIN_GAP_STEPS = 8.0
"""Shortest gap in a log in sampling intervals across which no statistic is computed."""
_T = TypeVar("_T")


class LogStatistics:
    """Log under inspection with cached statistics.

    Args:
        log: log with increasing times.
        inputs: channels that drive the vessel.
        seam_times: start times in s of stretches that do not follow the previous one in time.
        subsample: statistics of a subsample; None takes evenly spread stretches of a long log.
        invalid: samples whose measured channels read as NaN [T] bool; None for no samples.
    """

    def __init__(
        self,
        log: Log,
        inputs: Sequence[str] = (),
        seam_times: np.ndarray | None = None,
        subsample: LogStatistics | None = None,
        invalid: np.ndarray | None = None,
    ) -> None:
        self.log = log
        self.t = log.t
        self.units = log.units
        self.name = log.name
        self.inputs = tuple(inputs)
        self._seams = seam_times
        self._subsample = subsample
        self._invalid = invalid
        self.noise_std = cache(lambda name: estimate_noise_std(self.subsample[name]))
        """Estimate the standard deviation of the white noise of a channel."""
        self.std = cache(lambda name: nan_std(self[name]))
        """Compute the standard deviation of a channel."""
        self.smoothed = cache(lambda name: smooth_by_parabola(self.t, log[name]))
        """Smooth a channel [T] by a moving parabola; NaN is interpolated."""
        self._cache: dict[Hashable, Any] = {}
        self._spikes: dict[str, np.ndarray] = {}

    def __contains__(self, name: object) -> bool:
        return name in self.log.channels

    def __iter__(self) -> Iterator[str]:
        return iter(self.log.channels)

    def __getitem__(self, name: str) -> np.ndarray:
        values = self.log[name]
        if self._invalid is None or name not in MOTION_CHANNELS:
            return values
        return np.where(self._invalid, np.nan, values)

    def __len__(self) -> int:
        return len(self.log)

    def is_spike(self, name: str) -> np.ndarray:
        """Return [T] bool: outliers of a channel among their neighbours (Hampel filter)."""
        if name not in self._spikes:
            # several channels of a short log at once, as many as fit into the cache of a core
            channel_names = [n for n in self.measured_motion if n not in self._spikes and n != name]
            channel_names = (
                [name, *channel_names[: CACHED_SAMPLES // len(self) - 1]]
                if len(self) < CACHED_SAMPLES
                else [name]
            )
            spike_masks = find_hampel_outliers([self.log[n] for n in channel_names])
            self._spikes.update(zip(channel_names, spike_masks, strict=True))
        return self._spikes[name]

    @cached_property
    def sampling_interval(self) -> float:
        """Median time between samples in s."""
        return nan_median(np.diff(self.t)[:: max(len(self) // _MAX_SUBSAMPLE, 1)])

    @cached_property
    def measured_motion(self) -> list[str]:
        """Channels of states and accelerations that are not inputs."""
        return [name for name in self if name in MOTION_CHANNELS and name not in self.inputs]

    @cached_property
    def velocities(self) -> list[str]:
        """Planar velocities (u, v, r) of the log."""
        return [name for name in VELOCITY_NAMES if name in self]

    @cached_property
    def rms_speed(self) -> float:
        """Root mean square of the speed in m/s; 0 if u or v is missing."""
        squared_speed = (
            self["u"] ** 2 + self["v"] ** 2 if "u" in self and "v" in self else np.zeros(1)
        )
        return (
            float(np.sqrt(np.nanmean(squared_speed))) if np.isfinite(squared_speed).any() else 0.0
        )

    @cached_property
    def subsample(self) -> LogStatistics:
        """Evenly spread stretches of a long log with short gaps between them; a short log itself.

        Statistics are computed from the subsample; findings about single samples use all rows.
        """
        if self._subsample is not None:
            return self._subsample
        return self if self._seams is not None else self._from_rows(self.subsample_rows)

    @cached_property
    def subsample_rows(self) -> np.ndarray:
        """Rows [K] of the subsample; all rows of a short log."""
        return sample_rows(len(self), _MAX_SUBSAMPLE, _N_SUBSAMPLE_SEGMENTS)

    def excerpt_around(self, sample_mask: np.ndarray) -> tuple[np.ndarray, LogStatistics]:
        """Return a subsample with one stretch around given samples.

        Args:
            sample_mask: samples to include [T] bool; the stretch is centred on their longest run.

        Returns:
            Rows [K] of the subsample and its statistics.
        """
        starts, stops = runs_of(sample_mask)
        longest_segment = int(np.argmax(stops - starts))
        rows = sample_rows(
            len(self),
            _MAX_SUBSAMPLE,
            _N_SUBSAMPLE_SEGMENTS,
            int(starts[longest_segment] + stops[longest_segment]) // 2,
        )
        excerpt = self._from_rows(rows)
        return rows, excerpt if self._invalid is None else excerpt.mask_samples(self._invalid[rows])

    def excerpt_middle(self, n_samples: int) -> LogStatistics:
        """Return the statistics of a stretch in the middle; of a short log, itself.

        Args:
            n_samples: largest number of samples.
        """
        if len(self) <= n_samples:
            return self
        start = (len(self) - n_samples) // 2
        rows = np.arange(start, start + n_samples)
        excerpt = LogStatistics(self.log.select_rows(rows), self.inputs, self._seams)
        return excerpt if self._invalid is None else excerpt.mask_samples(self._invalid[rows])

    def _from_rows(self, rows: np.ndarray) -> LogStatistics:
        """Return the statistics of some rows, with the gaps between stretches shortened."""
        if rows.size == len(self):
            return self
        log = self.log.select_rows(rows)
        is_segment_start = np.append(True, np.diff(rows) > 1)
        time_shifts = np.where(
            is_segment_start,
            np.diff(log.t, prepend=log.t[0]) - _SEAM_STEPS * self.sampling_interval,
            0.0,
        )
        time_shifts[0] = 0.0
        log = log.replace(t=log.t - np.cumsum(time_shifts))
        # the first sample of each stretch becomes NaN, so that no increment spans two stretches
        seam_times = log.t[np.flatnonzero(is_segment_start)[1:]]
        return LogStatistics(log, self.inputs, seam_times).mask_samples(is_segment_start)

    def on_grid(self, grid: Log) -> LogStatistics:
        """Return the statistics of the same log on a uniform grid."""
        return LogStatistics(grid, self.inputs, self._seams)

    def with_subsample(self, subsample: LogStatistics, log: Log) -> LogStatistics:
        """Return the statistics of another log with the same samples and a given subsample."""
        return LogStatistics(log, self.inputs, self._seams, subsample, self._invalid)

    def near_seam(self, n_samples: int) -> np.ndarray:
        """Return [T] bool: samples within a distance in samples from a seam or a gap.

        A seam is the boundary of two stretches of a subsample.
        """
        is_gap = np.diff(self.t) > _MIN_GAP_STEPS * self.sampling_interval
        seam_indices = np.flatnonzero(is_gap) + 1
        if self._seams is not None:
            seam_indices = np.union1d(seam_indices, np.searchsorted(self.t, self._seams))
        return mask_from_ranges(
            len(self), seam_indices - n_samples - _SEAM_STEPS, seam_indices + n_samples
        )

    def cached(self, statistic: Callable[..., _T], *arguments: Hashable) -> _T:
        """Return `statistic(self, *arguments)`, computed once."""
        key = (statistic, *arguments)
        if key not in self._cache:
            self._cache[key] = statistic(self, *arguments)
        result: _T = self._cache[key]
        return result

    def mask_samples(self, invalid: np.ndarray) -> LogStatistics:
        """Return the statistics with NaN in the measured channels at invalid samples [T]."""
        if not invalid.any():
            return self
        if len(self) > _MAX_SUBSAMPLE:
            # a view with a mask, because copies of all channels of a long log would double the
            # memory
            subsample = self.subsample.mask_samples(invalid[self.subsample_rows])
            return LogStatistics(self.log, self.inputs, self._seams, subsample, invalid)
        channels = {
            name: np.where(invalid, np.nan, values) if name in MOTION_CHANNELS else values
            for name, values in self.log.channels.items()
        }
        return LogStatistics(self.log.replace(channels=channels), self.inputs, self._seams)


def interpolate_gaps(t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return values [T] with missing ones interpolated linearly; 0 if all are missing."""
    is_finite = np.isfinite(values)
    if is_finite.all():
        return values
    return (
        np.interp(t, t[is_finite], values[is_finite]) if is_finite.any() else np.zeros(values.size)
    )


def smooth_by_parabola(t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Smooth values [T] by a moving parabola over 15 samples, if so many; interpolate NaN."""
    gap_free = interpolate_gaps(np.arange(t.size), values)
    if t.size < SMOOTHING_SAMPLES:
        return gap_free
    return fit_local_polynomials(gap_free[:, None], SMOOTHING_SAMPLES, 2, 1.0)[0][:, 0]


def moving_average(values: np.ndarray, n_samples: int) -> np.ndarray:
    """Return the centred moving average [T] of the finite values; NaN in windows without any."""
    import pandas as pd

    window_length = min(n_samples, values.size)
    return pd.Series(values).rolling(window_length, min_periods=1, center=True).mean().to_numpy()


MIN_TURN_SHARE = 0.05
"""Smallest share of yaw motion to one side that counts as turning to that side.

Noise and overshoots reach .0001 in circles after a straight run; zigzags and random steps of five
vessels reach .3 and more.
"""


def compute_port_share(logs: Sequence[LogStatistics]) -> float:
    """Return the share of the yaw motion of logs that is to port, smoothed over 2 s."""
    yaw_rates = np.concatenate(
        [moving_average(log["r"], max(round(2.0 / log.sampling_interval), 5)) for log in logs]
    )
    total = float(np.nansum(np.abs(yaw_rates)))
    return float(np.nansum(np.abs(yaw_rates[yaw_rates < 0.0]))) / max(total, 1e-300)


def abs_quantile(values: np.ndarray, quantile_level: float = 0.95) -> float:
    """Return a quantile of the absolute values of a channel."""
    magnitudes = np.abs(values)
    return (
        float(np.nanmax(magnitudes))
        if quantile_level == 1.0
        else nan_quantiles(magnitudes, quantile_level)[0]
    )


def count_reversals(heading: np.ndarray, min_swing: float) -> int:
    """Count the reversals of a heading [T] in rad after swings of at least `min_swing` rad."""
    drop_from_maximum = np.maximum.accumulate(heading) - heading
    rise_from_minimum = heading - np.minimum.accumulate(heading)
    if min(drop_from_maximum.max(), rise_from_minimum.max()) < min_swing:
        return 0
    # only turning points can start or end a swing
    increments = np.diff(heading, prepend=heading[0], append=heading[-1])
    directions = np.sign(increments)
    n_reversals = 0
    direction = 0
    minimum = float(heading[0])
    maximum = float(heading[0])
    for heading_value in heading[directions[1:] * directions[:-1] <= 0.0].tolist():
        if direction >= 0 and maximum - heading_value >= min_swing:
            n_reversals = n_reversals + direction
            direction = -1
            minimum = heading_value
        elif direction <= 0 and heading_value - minimum >= min_swing:
            n_reversals = n_reversals - direction
            direction = 1
            maximum = heading_value
        minimum = min(minimum, heading_value)
        maximum = max(maximum, heading_value)
    return n_reversals


class LeastSquaresFit(NamedTuple):
    """Linear least-squares fit with a cluster-robust covariance.

    Attributes:
        coefficients: coefficients [k].
        covariance: covariance of the coefficients [k, k].
        residuals: residuals [T].
    """

    coefficients: np.ndarray
    covariance: np.ndarray
    residuals: np.ndarray

    @property
    def sum_of_squares(self) -> float:
        """Sum of squared residuals, in squared units of the response."""
        return float(self.residuals @ self.residuals)

    @property
    def standard_errors(self) -> np.ndarray:
        """Square roots of the diagonal of the covariance, one for each coefficient [k]."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 1e-300))

    @property
    def t_statistic(self) -> float:
        """Last coefficient over its standard error."""
        return float(self.coefficients[-1] / self.standard_errors[-1])


def fit_least_squares(x: np.ndarray, y: np.ndarray) -> LeastSquaresFit:
    """Fit y by the columns of x with a cluster-robust covariance.

    The covariance is a sandwich estimator with the sections of the log as clusters, because
    filtered residuals are correlated within a section. A column of zeros has a coefficient of zero.

    Args:
        x: regressors [N, k]; rows with NaN are omitted.
        y: response [N].
    """
    is_finite = np.isfinite(x).all(axis=1) & np.isfinite(y)
    x = x[is_finite]
    y = y[is_finite]
    column_norms = np.linalg.norm(x, axis=0)
    column_scales = np.where(column_norms > 0.0, column_norms, 1.0)
    x = x / column_scales
    gram_inv = np.linalg.pinv(x.T @ x, rcond=1e-10)
    coefficients = gram_inv @ (x.T @ y)
    residuals = y - x @ coefficients
    cumulative_scores = np.concatenate(
        (np.zeros((1, coefficients.size)), np.cumsum(x * residuals[:, None], axis=0))
    )
    scores = np.diff(cumulative_scores[_section_bounds(residuals.size)], axis=0)
    covariance = gram_inv @ (scores.T @ scores) @ gram_inv
    return LeastSquaresFit(
        coefficients / column_scales, covariance / np.outer(column_scales, column_scales), residuals
    )


def _section_bounds(n_rows: int) -> np.ndarray:
    """Return the bounds [N_SECTIONS + 1] of the sections; the first ones may be longer."""
    section_length, n_longer = divmod(n_rows, N_SECTIONS)
    section_indices = np.arange(N_SECTIONS + 1)
    return section_indices * section_length + np.minimum(section_indices, n_longer)


_MIN_BLOCK_SAMPLES = 16
"""Smallest number of samples of a block."""
_MIN_BLOCK_DURATION = 3.0
"""Shortest duration of a block in s."""
# number of blocks that overlap each sample
_BLOCK_OVERLAP = 4
# largest number of blocks, evenly spread over a long log
_MAX_BLOCKS = 5_000
# smallest change of a velocity over a block, in standard deviations of its noise
_MIN_SIGNAL_TO_NOISE = 10.0


def make_blocks(log: LogStatistics, *velocities: str) -> OverlappingBlocks:
    """Return overlapping blocks over which velocities change by more than their noise."""
    min_length = max(_MIN_BLOCK_SAMPLES, round(_MIN_BLOCK_DURATION / log.sampling_interval))
    block_length = min(3 * min_length, max(min_length, len(log) // 20))
    for candidate_length in (min_length, 2 * min_length, 3 * min_length):
        if candidate_length > len(log) // 20:
            break
        is_within_segment = ~log.near_seam(candidate_length)[candidate_length:]
        block_changes = {
            n: (log[n][candidate_length:] - log[n][:-candidate_length])[is_within_segment]
            for n in velocities
        }
        signal_to_noise = [
            nan_std(block_change) / max(log.noise_std(name), 1e-12)
            for name, block_change in block_changes.items()
            if np.isfinite(block_change).any()
        ]
        if min(signal_to_noise, default=_MIN_SIGNAL_TO_NOISE) >= _MIN_SIGNAL_TO_NOISE:
            block_length = candidate_length
            break
    block_stride = max(block_length // _BLOCK_OVERLAP, (len(log) - block_length) // _MAX_BLOCKS, 1)
    return OverlappingBlocks(
        log.t, np.arange(0, len(log) - block_length, block_stride), block_length
    )

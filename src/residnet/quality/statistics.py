"""What several checks need to know of a log: noise, smoothed channels, robust fits, agreement.

A log under examination (`LogStatistics`) computes each of them once.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
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
from residnet.preprocessing.statistics import MIN_SAMPLES, OverlappingBlocks

MOTION_CHANNELS = frozenset((*SIX_DOF_LAYOUT.state_names, *ACCELERATION_NAMES))
"""Channels that a sensor or filter measures; all others drive the vessel."""
STEERING_CHANNELS = ("delta", "tau_n", "acting_tau_n", "cmd_delta", "nozzle", "cmd_nozzle")
"""Channels of which a positive value turns the vessel."""
N_SECTIONS = 20
"""Parts of a log whose errors are taken as independent of each other, and of nothing shorter."""
SMOOTHING_SAMPLES = 15
"""Samples of the parabola that smooths a channel."""

_MAX_SUBSAMPLE, _N_SUBSAMPLE_SEGMENTS = 40_000, 5
"""Samples of a log beyond which statistics are of as many, and in how many stretches these lie.

By choice; `tests/data/test_relations.py` compares what they say with what all samples say.
"""
_SEAM_STEPS = 5
"""Steps between such stretches: more than a grid bridges."""
_T = TypeVar("_T")


class LogStatistics:
    """A log under examination, with what checks find out about it computed once.

    Args:
        log: with an increasing clock.
        inputs: channels that drive the vessel.
        seam_times: times in s at which the later of two stretches begins that are not of one moment.
        subsample: what `subsample` is, where it is known; None takes evenly spread stretches of a long log.
        invalid: [T] bool, samples whose measured channels are not known; None where all are as logged.
    """

    def __init__(
        self,
        log: Log,
        inputs: Sequence[str] = (),
        seam_times: np.ndarray | None = None,
        subsample: LogStatistics | None = None,
        invalid: np.ndarray | None = None,
    ) -> None:
        self.log, self.t, self.units, self.name = log, log.t, log.units, log.name
        self.inputs, self._seams, self._subsample = tuple(inputs), seam_times, subsample
        self._invalid = invalid
        self.noise_std = cache(lambda name: estimate_noise_std(self.subsample[name]))
        """Standard deviation of a channel's white noise."""
        self.std = cache(lambda name: nan_std(self[name]))
        """Standard deviation of a channel."""
        self.smoothed = cache(lambda name: smooth_by_parabola(self.t, log[name]))
        """A channel [T] smoothed by a parabola over 15 samples, NaN bridged."""
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
        """Return [T] bool: samples of a channel that stand far out of their neighbours."""
        if name not in self._spikes:
            # as many channels of a short log at once as stay in a core's cache
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
        """Usual time between samples in s."""
        return nan_median(np.diff(self.t)[:: max(len(self) // _MAX_SUBSAMPLE, 1)])

    @cached_property
    def measured_motion(self) -> list[str]:
        """Channels of the motion, inputs left out."""
        return [name for name in self if name in MOTION_CHANNELS and name not in self.inputs]

    @cached_property
    def velocities(self) -> list[str]:
        """Velocities that the log has."""
        return [name for name in VELOCITY_NAMES if name in self]

    @cached_property
    def rms_speed(self) -> float:
        """Root mean square of the speed where it is known, m/s; 0 where it is not."""
        squared_speed = (
            self["u"] ** 2 + self["v"] ** 2 if "u" in self and "v" in self else np.zeros(1)
        )
        return (
            float(np.sqrt(np.nanmean(squared_speed))) if np.isfinite(squared_speed).any() else 0.0
        )

    @cached_property
    def subsample(self) -> LogStatistics:
        """Stretches of a long log, evenly spread, one a short pause after the other; a short log
        itself. Statistics are told by them; what single samples do is told by all rows.
        """
        if self._subsample is not None:
            return self._subsample
        return self if self._seams is not None else self._from_rows(self.subsample_rows)

    @cached_property
    def subsample_rows(self) -> np.ndarray:
        """Rows [K] that `subsample` holds, all of a short log."""
        return sample_rows(len(self), _MAX_SUBSAMPLE, _N_SUBSAMPLE_SEGMENTS)

    def excerpt_around(self, sample_mask: np.ndarray) -> tuple[np.ndarray, LogStatistics]:
        """Return rows [K] and their record as `subsample` has them, one stretch about samples at [T].

        Of several runs of such samples it is about the longest.
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

    def _from_rows(self, rows: np.ndarray) -> LogStatistics:
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
        # no increment leads from one stretch to the next
        seam_times = log.t[np.flatnonzero(is_segment_start)[1:]]
        return LogStatistics(log, self.inputs, seam_times).mask_samples(is_segment_start)

    def on_grid(self, grid: Log) -> LogStatistics:
        """Return the record of the same samples on a grid."""
        return LogStatistics(grid, self.inputs, self._seams)

    def with_subsample(self, subsample: LogStatistics, log: Log) -> LogStatistics:
        """Return the record of the same samples as another log holds them, with `subsample` of them."""
        return LogStatistics(log, self.inputs, self._seams, subsample, self._invalid)

    def near_seam(self, n_samples: int) -> np.ndarray:
        """Return [T] bool: samples within so many of where two stretches meet."""
        seam_indices = np.searchsorted(self.t, np.zeros(0) if self._seams is None else self._seams)
        return mask_from_ranges(
            len(self), seam_indices - n_samples - _SEAM_STEPS, seam_indices + n_samples
        )

    def cached(self, statistic: Callable[..., _T], *arguments: Hashable) -> _T:
        """Return a statistic of this record, `statistic(record, *about)`, computed once."""
        key = (statistic, *arguments)
        if key not in self._cache:
            self._cache[key] = statistic(self, *arguments)
        result: _T = self._cache[key]
        return result

    def mask_samples(self, invalid: np.ndarray) -> LogStatistics:
        """Return the record with NaN in the measured channels where bad [T]."""
        if not invalid.any():
            return self
        if len(self) > _MAX_SUBSAMPLE:
            # copies of all channels of a long log would be as large again
            subsample = self.subsample.mask_samples(invalid[self.subsample_rows])
            return LogStatistics(self.log, self.inputs, self._seams, subsample, invalid)
        channels = {
            name: np.where(invalid, np.nan, values) if name in MOTION_CHANNELS else values
            for name, values in self.log.channels.items()
        }
        return LogStatistics(self.log.replace(channels=channels), self.inputs, self._seams)


def interpolate_gaps(t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return values [T] with straight lines where some are missing, 0 where all are."""
    is_finite = np.isfinite(values)
    if is_finite.all():
        return values
    return (
        np.interp(t, t[is_finite], values[is_finite]) if is_finite.any() else np.zeros(values.size)
    )


def smooth_by_parabola(t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return values [T] smoothed by a parabola over 15 samples, NaN bridged by sample."""
    gap_free = interpolate_gaps(np.arange(t.size), values)
    return fit_local_polynomials(gap_free[:, None], SMOOTHING_SAMPLES, 2, 1.0)[0][:, 0]


def moving_average(values: np.ndarray, n_samples: int) -> np.ndarray:
    """Return the moving average [T] over so many samples, NaN left out; NaN where none is known."""
    window_length, is_finite = min(n_samples, values.size), np.isfinite(values)
    padding = window_length // 2, (window_length - 1) // 2
    cumulative_sums = (
        np.cumsum(cumulative_sum)
        for cumulative_sum in (is_finite, np.where(is_finite, values, 0.0))
    )
    padded_sums = (
        np.pad(np.append(0.0, cumulative_sum), padding, mode="edge")
        for cumulative_sum in cumulative_sums
    )
    n_known, window_sums = (
        cumulative_sum[window_length:] - cumulative_sum[:-window_length]
        for cumulative_sum in padded_sums
    )
    return np.where(n_known > 0.5, window_sums / np.maximum(n_known, 1.0), np.nan)


def abs_quantile(values: np.ndarray, quantile_level: float = 0.95) -> float:
    """Return the size that a channel reaches, by a quantile of its absolute values."""
    magnitudes = np.abs(values)
    return (
        float(np.nanmax(magnitudes))
        if quantile_level == 1.0
        else nan_quantiles(magnitudes, quantile_level)[0]
    )


def count_reversals(heading: np.ndarray, min_swing: float) -> int:
    """Return how often a heading [T] rad turns round after having gone `min_swing` rad one way."""
    drop_from_maximum, rise_from_minimum = (
        np.maximum.accumulate(heading) - heading,
        heading - np.minimum.accumulate(heading),
    )
    if min(drop_from_maximum.max(), rise_from_minimum.max()) < min_swing:
        return 0
    # where it goes the same way on, nothing turns
    increments = np.diff(heading, prepend=heading[0], append=heading[-1])
    directions = np.sign(increments)
    n_reversals, direction, minimum, maximum = 0, 0, float(heading[0]), float(heading[0])
    for heading_value in heading[directions[1:] * directions[:-1] <= 0.0].tolist():
        if direction >= 0 and maximum - heading_value >= min_swing:
            n_reversals, direction, minimum = n_reversals + direction, -1, heading_value
        elif direction <= 0 and heading_value - minimum >= min_swing:
            n_reversals, direction, maximum = n_reversals - direction, 1, heading_value
        minimum, maximum = min(minimum, heading_value), max(maximum, heading_value)
    return n_reversals


def estimate_resolution(values: np.ndarray) -> float:
    """Return the least step between the values of a channel; 0 where it has no grid."""
    nonzero_changes = np.abs(np.diff(values))
    nonzero_changes = nonzero_changes[np.isfinite(nonzero_changes) & (nonzero_changes > 0.0)]
    if nonzero_changes.size < MIN_SAMPLES:
        return 0.0
    min_step = nan_quantiles(nonzero_changes, 0.01)[0]
    changes_in_steps = nonzero_changes / min_step
    return (
        min_step
        if float((np.abs(changes_in_steps - np.round(changes_in_steps)) < 0.02).mean()) > 0.95
        else 0.0
    )


class LeastSquaresFit(NamedTuple):
    """A least-squares fit: values [k], their covariance [k, k], what is left of known rows [N]."""

    coefficients: np.ndarray
    covariance: np.ndarray
    residuals: np.ndarray

    @property
    def sum_of_squares(self) -> float:
        """Sum of squares of what is left."""
        return float(self.residuals @ self.residuals)

    @property
    def standard_errors(self) -> np.ndarray:
        """Standard errors [k]."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 1e-300))

    @property
    def t_statistic(self) -> float:
        """The last value in its standard errors."""
        return float(self.coefficients[-1] / self.standard_errors[-1])


def fit_least_squares(x: np.ndarray, y: np.ndarray) -> LeastSquaresFit:
    """Return y [N] fitted by the columns of x [N, k], over the rows that are known.

    The covariance is a sandwich over sections: what filters leave hangs together, but not for
    longer than a twentieth of the log. A column of zeros keeps a coefficient of zero.
    """
    is_finite = np.isfinite(x).all(axis=1) & np.isfinite(y)
    x, y = x[is_finite], y[is_finite]
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
    """Return the rows [SECTIONS + 1] at which sections meet; the first ones may hold a row more."""
    section_length, n_longer = divmod(n_rows, N_SECTIONS)
    section_indices = np.arange(N_SECTIONS + 1)
    return section_indices * section_length + np.minimum(section_indices, n_longer)


# a block covers so many samples and so many seconds at least
_MIN_BLOCK_SAMPLES, _MIN_BLOCK_DURATION = 16, 3.0
# blocks begin so many times in the length of one
_BLOCK_OVERLAP = 4
# blocks of a long log that are looked at, evenly spread: more tell the same
_MAX_BLOCKS = 5_000
# over a block each velocity changes by so many standard deviations of its noise, where it can
_MIN_SIGNAL_TO_NOISE = 10.0


def make_blocks(log: LogStatistics, *velocities: str) -> OverlappingBlocks:
    """Return blocks over which some velocities change by more than their noise."""
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


def make_velocity_terms(velocities: Mapping[str, np.ndarray]) -> list[np.ndarray]:
    """Return terms of second degree in velocities."""
    terms = [*velocities.values(), *(values * np.abs(values) for values in velocities.values())]
    if "u" in velocities:
        terms += [velocities["u"] * velocities[name] for name in ("v", "r") if name in velocities]
    if "v" in velocities and "r" in velocities:
        terms.append(velocities["v"] * velocities["r"])
    return terms


def make_input_terms(
    input_values: Sequence[np.ndarray], u: np.ndarray | None, *, is_linear: bool
) -> list[np.ndarray]:
    """Return terms of second degree that hold inputs; `u` is the speed ahead."""
    if is_linear:
        return [*input_values]
    flow_terms = [] if u is None else [u * np.abs(u) * values for values in input_values]
    return [*input_values, *(values * np.abs(values) for values in input_values), *flow_terms]

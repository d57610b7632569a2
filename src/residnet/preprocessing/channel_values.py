"""Detect noise, outliers, spikes, fill values and repeated values in single channels."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from residnet.core.frames import unwrap_angle
from residnet.core.layout import SIX_DOF_LAYOUT
from residnet.core.log import Log
from residnet.core.stretches import find_runs

SIGMA_OF_MAD = 1.4826
"""Ratio of the standard deviation of a Gaussian to its median absolute deviation."""
NEGLIGIBLE_MOTION_SHARE = 1e-3
"""Share of the expected standard deviation below which a sensor counts as constant.

No wrong unit makes a signal smaller by this factor.
"""
SPIKE_REASON = "spike"
"""Key of the mask of spikes in `Log.masks`."""
_MIN_SPIKE_CHANGES = 12.0
"""Minimum distance of a spike from the median of its neighbours, relative to usual changes.

The usual change is the 99 % quantile of the change between samples.
"""
_MIN_SPIKE_DISTANCES = 30.0
"""Minimum distance of a spike from the median of its neighbours, relative to the 99 % quantile of
such distances.
"""
_MAX_SPIKE_SAMPLES = 2
"""Maximum length of a spike in samples."""
_MIN_THRESHOLD_CHANGES = 3.0
"""Lower bound of both minimum distances, relative to the 99 % quantile of the change between
samples.
"""
_MIN_RANGE_EXCESS = 0.9
"""Alternative minimum: distance outside the range of the channel, relative to that range (99 % of
the values).
"""
_MIN_SAMPLES = 20
"""Smallest number of samples for the detection of spikes; chosen by hand."""
CACHED_SAMPLES = 8_192
"""Samples per chunk, so that the neighbours fit into the cache of a core."""
_MIN_LOST_DISTANCE = 10.0
"""Minimum distance of a vessel from the origin at a lost pose, relative to the 99 % quantile of the
distance between samples.
"""
_MAX_SUBSAMPLE = 40_000
"""Number of samples for quantiles of a long channel."""
_N_SUBSAMPLE_SEGMENTS = 40
"""Number of segments of the channel that form this subsample."""


def estimate_noise_std(values: np.ndarray) -> float:
    """Estimate the standard deviation of white noise in a channel from third differences.

    Third differences suppress the motion. The result is 0 with fewer than 8 finite samples, or if
    most third differences are zero.
    """
    finite_values = values[np.isfinite(values)]
    if finite_values.size < 8:
        return 0.0
    # the third difference of white noise has 1 + 9 + 9 + 1 = 20 times its variance
    return SIGMA_OF_MAD * nan_median(np.abs(np.diff(finite_values, 3))) / math.sqrt(20.0)


def nan_quantiles(values: np.ndarray, *levels: float) -> list[float]:
    """Return quantiles of the values [T] that are not NaN; NaN for an empty selection.

    The result equals numpy.nanquantile, which takes ten times as long for a short log.
    """
    finite_values = values[~np.isnan(values)]
    if not finite_values.size:
        return [np.nan] * len(levels)
    positions = [level * (finite_values.size - 1) for level in levels]
    neighbours = [
        (math.floor(position), math.ceil(position), position % 1.0) for position in positions
    ]
    finite_values.partition(
        [
            position
            for lower_index, upper_index, _ in neighbours
            for position in (lower_index, upper_index)
        ]
    )
    return [
        float(
            finite_values[lower_index]
            + fraction * (finite_values[upper_index] - finite_values[lower_index])
        )
        for lower_index, upper_index, fraction in neighbours
    ]


def nan_median(values: np.ndarray) -> float:
    """Return the median of the values [T] that are not NaN; NaN for an empty selection."""
    return nan_quantiles(values, 0.5)[0]


def nan_std(values: np.ndarray) -> float:
    """Return the standard deviation of the finite values; NaN for an empty selection."""
    finite_values = values[np.isfinite(values)]
    if not finite_values.size:
        return np.nan
    deviations = finite_values - finite_values.sum() / finite_values.size
    return math.sqrt(float(deviations @ deviations) / finite_values.size)


def find_lost_poses(x: np.ndarray, y: np.ndarray, angles: Sequence[np.ndarray]) -> np.ndarray:
    """Return where a tracking system lost the vessel and wrote zeros for its pose, bool [T].

    A vessel that passes the origin moves there in small steps.

    Args:
        x: first coordinate of the position [T]; NaN where it is missing.
        y: second coordinate of the position [T].
        angles: heading, or the components of the quaternion, [T] each; at least one.
    """
    is_zero = (x == 0.0) & (y == 0.0)
    for angle in angles:
        is_zero &= angle == 0.0
    is_lost = np.zeros(x.size, dtype=bool)
    measured = np.flatnonzero(~is_zero & np.isfinite(x) & np.isfinite(y))
    if not is_zero.any() or measured.size < _MIN_SAMPLES:
        return is_lost
    distance = np.hypot(x[measured], y[measured])
    steps = np.hypot(np.diff(x[measured]), np.diff(y[measured]))
    limit = _MIN_LOST_DISTANCE * nan_quantiles(steps, 0.99)[0]
    for start, stop in zip(*find_runs(is_zero), strict=True):
        # the measured samples before and after the zeros
        position = int(np.searchsorted(measured, start))
        is_lost[start:stop] = distance[max(position - 1, 0) : position + 1].min() > limit
    return is_lost


def _selection_medians(
    get_members: Callable[[slice], list[np.ndarray]], n_samples: int
) -> np.ndarray:
    """Return element-wise medians [T] by forgetful selection.

    Among any n/2 + 2 of n candidates, neither the minimum nor the maximum can be the median. Both
    are removed and the next candidate is added, until one or two candidates remain. With vectorised
    minima and maxima this is faster than sorting.

    Args:
        get_members: returns for a chunk of samples the arrays of which the element-wise median is
            computed.
        n_samples: T.
    """
    medians = np.empty(n_samples)
    for start in range(0, n_samples, CACHED_SAMPLES):
        chunk = slice(start, min(start + CACHED_SAMPLES, n_samples))
        remaining = get_members(chunk)
        candidates = remaining[: len(remaining) // 2 + 2]
        remaining = remaining[len(remaining) // 2 + 2 :]
        while len(candidates) > 2:
            n_half = len(candidates) // 2
            for i in range(n_half):
                lower_candidate = candidates[i]
                upper_candidate = candidates[-1 - i]
                candidates[i] = np.minimum(lower_candidate, upper_candidate)
                candidates[-1 - i] = np.maximum(lower_candidate, upper_candidate)
            # with an odd number the middle candidate may be the minimum or the maximum
            for i in range(1, len(candidates) - n_half):
                lower_candidate = candidates[0]
                upper_candidate = candidates[i]
                candidates[0] = np.minimum(lower_candidate, upper_candidate)
                candidates[i] = np.maximum(lower_candidate, upper_candidate)
            for i in range(len(candidates) - 2, n_half - 1, -1):
                lower_candidate = candidates[-1]
                upper_candidate = candidates[i]
                candidates[-1] = np.maximum(lower_candidate, upper_candidate)
                candidates[i] = np.minimum(lower_candidate, upper_candidate)
            candidates = candidates[1:-1] + remaining[:1]
            remaining = remaining[1:]
        medians[chunk] = (
            candidates[0] if len(candidates) == 1 else 0.5 * (candidates[0] + candidates[1])
        )
    return medians


def find_hampel_outliers(
    columns: Sequence[np.ndarray], sigmas: float = 6.0, samples: int = 11
) -> list[np.ndarray]:
    """Find outliers by the rule of `residnet.preprocessing.masks.HampelMask`.

    Several short columns are processed in one pass.

    Args:
        columns: channels, [T] each.
        sigmas: distance of an outlier in robust standard deviations.
        samples: number of neighbours, made odd.

    Returns:
        [T] bool for each column; False at missing values.
    """
    half_window = samples // 2
    max_offset = 2 * half_window
    n_neighbours = 2 * half_window + 1
    outlier_masks = [np.zeros(values.size, dtype=bool) for values in columns]
    finite_indices = [np.flatnonzero(np.isfinite(values)) for values in columns]
    usable_columns = [
        i for i, indices in enumerate(finite_indices) if indices.size > 2 * max_offset
    ]
    finite_values = [columns[i][finite_indices[i]] for i in usable_columns]
    if not finite_values:
        return outlier_masks

    def neighbours(values: np.ndarray, offset: int, chunk: slice) -> np.ndarray:
        return values[chunk.start + offset : chunk.stop + offset]

    def split_by_column(values: np.ndarray, margin: int) -> list[np.ndarray]:
        """Split values of the padded, concatenated columns into values of each column."""
        starts = np.cumsum(
            [0, *(column_values.size + 2 * margin for column_values in finite_values[:-1])]
        )
        return [
            values[start : start + column_values.size]
            for start, column_values in zip(starts, finite_values, strict=True)
        ]

    # distance from the median of the linear interpolations between pairs of neighbours
    padded = np.concatenate(
        [
            np.pad(column_values, max_offset, mode="reflect", reflect_type="odd")
            for column_values in finite_values
        ]
    )
    interpolations = _selection_medians(
        lambda k: [
            0.5 * (neighbours(padded, i, k) + neighbours(padded, 2 * max_offset - i, k))
            for i in range(max_offset)
        ],
        padded.size - 2 * max_offset,
    )
    deviations = [
        column_values - interpolation
        for column_values, interpolation in zip(
            finite_values, split_by_column(interpolations, max_offset), strict=True
        )
    ]
    padded = np.concatenate(
        [np.pad(column_values, half_window, mode="reflect") for column_values in deviations]
    )
    medians = _selection_medians(
        lambda k: [neighbours(padded, i, k) for i in range(n_neighbours)],
        padded.size - 2 * half_window,
    )
    windows = sliding_window_view(padded, n_neighbours)
    for i, column_values, deviation, median_deviation, window_deviations in zip(
        usable_columns,
        finite_values,
        deviations,
        split_by_column(medians, half_window),
        split_by_column(windows, half_window),
        strict=True,
    ):
        distance = np.abs(deviation - median_deviation)
        sampled_distances = distance[
            sample_rows(column_values.size, _MAX_SUBSAMPLE, _N_SUBSAMPLE_SEGMENTS)
        ]
        # lower bound of the deviation: a coarse channel alternates between adjacent values of its
        # resolution, and values have rounding errors
        resolution = (
            2.0 * nan_quantiles(sampled_distances[sampled_distances > 0.0], 0.1)[0]
            if sampled_distances.any()
            else 0.0
        )
        floor = max(
            SIGMA_OF_MAD * nan_median(sampled_distances),
            resolution,
            1e-9 * float(np.abs(column_values).max()),
        )
        # where a smooth channel is curved, as at the end of a turn, the median deviation is large;
        # it raises the threshold, so that the curvature is not taken for an outlier
        suspect_indices = np.flatnonzero(
            distance > sigmas * np.maximum(floor, np.abs(median_deviation))
        )
        if suspect_indices.size:
            local_deviation = np.median(
                np.abs(
                    window_deviations[suspect_indices] - median_deviation[suspect_indices, None]
                ),
                axis=1,
            )
            outlier_masks[i][finite_indices[i][suspect_indices]] = (
                distance[suspect_indices] > sigmas * SIGMA_OF_MAD * local_deviation
            )
    return outlier_masks


def sample_rows(
    n_rows: int, max_rows: int, n_segments: int, centre_row: int | None = None
) -> np.ndarray:
    """Return the rows [K] of evenly spread stretches; all rows if there are at most `max_rows`.

    Args:
        n_rows: number of rows.
        max_rows: total length of the stretches.
        n_segments: number of stretches.
        centre_row: row around which the nearest stretch is centred; None for even spacing.
    """
    if n_rows <= max_rows:
        return np.arange(n_rows)
    segment_length = max_rows // n_segments
    segment_starts = np.linspace(0, n_rows - segment_length, n_segments).astype(int)
    if centre_row is not None:
        nearest_start = min(max(centre_row - segment_length // 2, 0), n_rows - segment_length)
        segment_starts[np.argmin(np.abs(segment_starts - nearest_start))] = nearest_start
    return np.unique((segment_starts[:, None] + np.arange(segment_length)).ravel())


def mask_from_ranges(n_samples: int, starts: np.ndarray, stops: np.ndarray) -> np.ndarray:
    """Return [n_samples] bool: samples in any of the half-open ranges; inverse of `find_runs`."""
    boundary_counts = np.zeros(n_samples + 1, dtype=np.int64)
    np.add.at(boundary_counts, np.clip(starts, 0, n_samples), 1)
    np.add.at(boundary_counts, np.clip(stops, 0, n_samples), -1)
    return np.cumsum(boundary_counts[:-1]) > 0


def find_steps_above(log: Log, channel: str, limit: float) -> np.ndarray:
    """Return the indices [K] of the samples after steps above a limit.

    Args:
        log: the log.
        channel: name of the channel; angles are unwrapped.
        limit: largest regular difference of successive samples, SI.
    """
    values = log[channel]
    values = unwrap_angle(values) if log.units[channel] == "rad" else values
    return np.flatnonzero(np.abs(np.diff(values)) > limit) + 1


def find_spikes(log: Log) -> dict[str, np.ndarray]:
    """Find spikes: single samples or pairs that the inertia of vessel and actuators excludes.

    In a channel of the motion, a spike is far from the median of its neighbours, compared with the
    usual changes and distances, and ends within two samples. Other channels may jump; their spikes
    must exceed the range of the channel by half of that range.

    Returns:
        Channel -> [T] bool, for channels with spikes.
    """
    spikes_by_channel = {}
    for name, values in log.channels.items():
        is_angle = log.units[name] == "rad"
        is_spike = _find_channel_spikes(
            unwrap_angle(values) if is_angle else values, name in SIX_DOF_LAYOUT.state_names
        )
        if is_spike.any():
            spikes_by_channel[name] = is_spike
    return spikes_by_channel


def bridge_spikes(log: Log, required_channels: Collection[str] | None = None) -> Log:
    """Replace spikes and add the mask `spike`; a log without spikes is returned unchanged.

    Channels of the motion are interpolated, other channels hold their last value. The mask excludes
    the samples from fits and scores.

    Args:
        log: the log.
        required_channels: channels to check; None for all.
    """
    spikes_by_channel = {
        name: is_spike
        for name, is_spike in find_spikes(log).items()
        if required_channels is None or name in required_channels
    }
    if not spikes_by_channel:
        return log
    channels = dict(log.channels)
    for name, is_spike in spikes_by_channel.items():
        valid_indices = np.flatnonzero(~is_spike & np.isfinite(log[name]))
        spike_indices = np.flatnonzero(is_spike)
        values = log[name].copy()
        if name in SIX_DOF_LAYOUT.state_names:
            values[spike_indices] = np.interp(
                log.t[spike_indices], log.t[valid_indices], values[valid_indices]
            )
        else:
            values[spike_indices] = values[
                valid_indices[np.maximum(np.searchsorted(valid_indices, spike_indices) - 1, 0)]
            ]
        channels[name] = values
    spike_mask = np.logical_or.reduce(list(spikes_by_channel.values()))
    previous_mask = log.masks.get(SPIKE_REASON, np.zeros(len(log), dtype=bool))
    n_spikes_by_channel = {
        name: int(is_spike.sum()) for name, is_spike in spikes_by_channel.items()
    }
    return log.replace(
        channels=channels,
        masks={**log.masks, SPIKE_REASON: previous_mask | spike_mask},
        meta={**log.meta, "spikes": n_spikes_by_channel},
    )


def _find_channel_spikes(values: np.ndarray, is_measured_motion: bool) -> np.ndarray:
    """Find the spikes of one channel.

    Args:
        values: channel [T], angles unwrapped.
        is_measured_motion: whether the channel belongs to the motion and cannot jump.

    Returns:
        [T] bool.
    """
    spike_mask = np.zeros(values.size, dtype=bool)
    finite_indices = np.flatnonzero(np.isfinite(values))
    if finite_indices.size < _MIN_SAMPLES:
        return spike_mask
    finite_values = values[finite_indices]
    changes = np.abs(np.diff(finite_values))
    # quantiles of a long channel use a subsample
    subsample = slice(None, None, -(-finite_values.size // _MAX_SUBSAMPLE))
    lower_quantile, upper_quantile = nan_quantiles(finite_values[subsample], 0.005, 0.995)
    value_range = upper_quantile - lower_quantile
    high_change = nan_quantiles(changes[subsample], 0.99)[0]
    # quick exit: without a large change there is no spike
    largest = float(changes.max())
    scan_threshold = (
        min(_MIN_THRESHOLD_CHANGES * high_change, _MIN_RANGE_EXCESS * value_range)
        if is_measured_motion
        else 0.5 * value_range
    )
    if largest <= scan_threshold or not largest:
        return spike_mask
    # a distance from the median of the neighbours requires one large step or three smaller ones
    step_indices = np.flatnonzero(
        changes > (scan_threshold / 3.0 if finite_values.size > _MAX_SUBSAMPLE else -1.0)
    )
    is_candidate = np.zeros(finite_values.size, dtype=bool)
    for index_shift in range(-2, 4):
        is_candidate[np.clip(step_indices + index_shift, 0, finite_values.size - 1)] = True
    candidate_indices = np.flatnonzero(is_candidate)
    padded = np.pad(finite_values, 3, mode="edge")

    def distance_from_median(indices: np.ndarray) -> np.ndarray:
        """Return the distance [K] of samples [K] from the median of seven neighbours."""
        neighbour_medians = _selection_medians(
            lambda chunk: [padded[indices[chunk] + i] for i in range(7)], indices.size
        )
        return np.asarray(np.abs(finite_values[indices] - neighbour_medians))

    distance = np.zeros(finite_values.size)
    is_outlier = np.zeros(finite_values.size, dtype=bool)
    distance[candidate_indices] = distance_from_median(candidate_indices)
    range_excess = np.maximum(lower_quantile - finite_values, finite_values - upper_quantile)
    if is_measured_motion:
        typical_distances = (
            distance_from_median(
                sample_rows(finite_values.size, _MAX_SUBSAMPLE, _N_SUBSAMPLE_SEGMENTS)
            )
            if finite_values.size > _MAX_SUBSAMPLE
            else distance
        )
        # in a steady channel the neighbours of a spike, too, differ from their median by a few
        # times the usual change
        min_distance = min(
            _MIN_SPIKE_CHANGES * high_change,
            _MIN_SPIKE_DISTANCES * nan_quantiles(typical_distances, 0.99)[0],
        )
        # in a noisy channel only the range of the channel reveals a spike
        is_out_of_range = (
            (range_excess > _MIN_RANGE_EXCESS * value_range)
            & (distance > _MIN_RANGE_EXCESS * value_range)
            & (value_range > 0.0)
        )
        is_outlier = (
            distance > max(min_distance, _MIN_THRESHOLD_CHANGES * high_change, 1e-6 * value_range)
        ) | is_out_of_range
    else:
        # a display that flickers in its last digit exceeds its range by one step of that digit
        min_excess = 0.5 * value_range + np.min(changes[changes > 0.0])
        is_outlier = (
            (np.minimum(range_excess, distance) > 1.001 * min_excess)
            if value_range > 0.0
            else range_excess < -1.0
        )
    starts, stops = find_runs(is_outlier)
    is_single = (stops - starts <= _MAX_SPIKE_SAMPLES) & (starts > 0) & (stops < finite_values.size)
    spike_mask[finite_indices] = mask_from_ranges(
        finite_values.size, starts[is_single], stops[is_single]
    )
    # frequent spikes indicate a faulty sensor rather than single wrong samples, so that none is
    # marked
    return (
        spike_mask
        if spike_mask.sum() <= max(3, 0.01 * finite_values.size)
        else np.zeros_like(spike_mask)
    )


# values that recorders, NetCDF and spreadsheets write for missing measurements
_FILL_VALUES = np.array(
    [
        *(-99.0, -999.0, -9999.0, -99999.0, -999999.0, -99.99, -999.99, -9999.99, -999.9, -999.25),
        *(999.0, 9999.0, 99999.0, 999999.0, 9999999.0),
        *(-128.0, -127.0, -32768.0, -32767.0, 32767.0, 32768.0, 65535.0),
        *(-2147483648.0, -2147483647.0, 2147483647.0, 4294967295.0, -9.2233720368547758e18),
        *(9.9692099683868690e36, 1e20, -1e20, 1e30, -1e30, 1e31, -1e31, 1e34, -1e34, 1e35, 1e37),
        *(3.4028234663852886e38, -3.4028234663852886e38),
        *(1.7976931348623157e308, -1.7976931348623157e308),
    ]
)
_SORTED_FILL_VALUES = np.sort(_FILL_VALUES)
# largest plausible absolute value of a quantity by SI unit
_MAX_MAGNITUDES = {
    "m": 5e7,
    "m/s": 300.0,
    "m/s^2": 1e4,
    "rad": 1e5,
    "rad/s": 1e3,
    "rad/s^2": 1e5,
    "1/s": 1e4,
    "N": 1e10,
    "N m": 1e13,
    "kg": 1e10,
    "V": 1e7,
    "A": 1e7,
    "W": 1e11,
    "-": 1e15,
}


def is_fill_value(values: np.ndarray) -> np.ndarray:
    """Return [T] bool: common fill values that are far from all other values.

    The distance must exceed the range of the other values, so that 999 m among distances from 900 m
    to 1100 m is no fill value.

    Args:
        values: column of a file [T], NaN for empty cells.
    """
    magnitudes = np.abs(values)
    # most columns have no such value, which one comparison shows
    if not (magnitudes >= 99.0).any():
        return np.zeros(values.size, dtype=bool)
    is_finite = np.isfinite(values)
    min_value = float(np.min(values, where=is_finite, initial=np.inf))
    max_value = float(np.max(values, where=is_finite, initial=-np.inf))
    # a value far from all others is the minimum or the maximum
    if not _matches_fill_value(np.array([min_value, max_value])).any():
        return np.zeros(values.size, dtype=bool)
    is_candidate = np.zeros(values.size, dtype=bool)
    large_indices = np.flatnonzero(is_finite & (magnitudes >= 99.0))
    is_candidate[large_indices] = _matches_fill_value(values[large_indices])
    other_values = values[is_finite & ~is_candidate]
    if not is_candidate.any() or not other_values.size:
        return np.zeros(values.size, dtype=bool)
    lower = float(other_values.min())
    upper = float(other_values.max())
    value_range = upper - lower
    is_far: np.ndarray = (values < lower - value_range) | (values > upper + value_range)
    return np.asarray(is_candidate & is_far)


def _matches_fill_value(values: np.ndarray) -> np.ndarray:
    """Return [K] bool: values that equal a common fill value."""
    insertion_indices = np.searchsorted(_SORTED_FILL_VALUES, values)
    is_match = np.zeros(values.size, dtype=bool)
    for offset in (-1, 0):
        # in single precision a fill value has seven digits
        nearest_fill_value = _SORTED_FILL_VALUES[
            np.clip(insertion_indices + offset, 0, _SORTED_FILL_VALUES.size - 1)
        ]
        is_match |= np.abs(values - nearest_fill_value) <= 2e-7 * np.abs(nearest_fill_value)
    return is_match


def mask_fill_values(values: np.ndarray) -> np.ndarray:
    """Return a column [T] with its fill values replaced by NaN."""
    is_fill = is_fill_value(values)
    return np.where(is_fill, np.nan, values) if is_fill.any() else values


def max_magnitude(unit: str) -> float:
    """Return the largest plausible absolute value for an SI unit; infinite for unknown units."""
    return _MAX_MAGNITUDES.get(unit, np.inf)


def is_implausible(values: np.ndarray, unit: str) -> np.ndarray:
    """Return [T] bool: values outside the plausible range of any vessel, manoeuvre or site.

    Args:
        values: channel [T], SI, NaN for missing values.
        unit: SI unit of the channel; an unknown unit has no limit.
    """
    return np.asarray(np.abs(values) > max_magnitude(unit))


_SENSOR_GROUPS = (("x", "y"), ("u", "v"), ("psi",), ("r",))
"""Groups of channels that one sensor measures.

One channel may have the same value in two successive measurements; rarely do all channels of a
group.
"""
_MIN_INTERVALS = 20
"""Smallest number of update intervals for an estimate of their median."""
INTERVAL_TOLERANCE = 0.25
"""Relative tolerance of a regular interval."""
MIN_REGULAR_SHARE = 0.9
"""Smallest share of regular intervals."""


def median_update_interval(values: np.ndarray) -> float:
    """Return the median update interval of channels [T] or [T, k] in samples; 1 if irregular."""
    has_changed = np.diff(values, axis=0) != 0.0
    intervals = np.diff(
        np.flatnonzero(has_changed if has_changed.ndim == 1 else has_changed.any(axis=1))
    )
    if intervals.size < _MIN_INTERVALS:
        return 1.0
    median_interval = nan_median(intervals)
    is_regular = (
        float((np.abs(intervals - median_interval) <= INTERVAL_TOLERANCE * median_interval).mean())
        >= MIN_REGULAR_SHARE
    )
    return median_interval if median_interval >= 2.0 and is_regular else 1.0


def mask_held_values(log: Log) -> Log:
    """Replace repeated values of motion sensors with a low update rate by NaN.

    A sensor value that is repeated until the next measurement is delayed by up to one update
    interval, and its derivative consists of spikes. Samples that are NaN instead are estimated from
    the other sensors, like the missing samples of any sparse channel.
    """
    fresh_values: dict[str, np.ndarray] = {}
    for sensor_channels in _SENSOR_GROUPS:
        names = [name for name in sensor_channels if name in log.channels]
        if not names:
            continue
        values = log.stack(tuple(names))
        # channels of one sensor are updated together
        if median_update_interval(values) > 1.0:
            is_fresh = np.append(True, (np.diff(values, axis=0) != 0.0).any(axis=1))
            fresh_values |= {name: np.where(is_fresh, log[name], np.nan) for name in names}
    return log.replace(channels={**log.channels, **fresh_values}) if fresh_values else log


_AIS_SENTINELS = {
    ("psi", "deg"): 511.0,
    ("latitude", "deg"): 91.0,
    ("longitude", "deg"): 181.0,
    ("u", "kn"): 102.3,
}
"""Channel and unit -> value that means "not available" (ITU-R M.1371, message 1)."""


def is_ais_sentinel(channel: str, unit: str, values: np.ndarray) -> np.ndarray:
    """Return which values [T] are the code of AIS for a missing value, bool [T].

    Args:
        channel: name of the channel.
        unit: unit of the values.
        values: values in this unit.
    """
    sentinel = _AIS_SENTINELS.get((channel, unit))
    if sentinel is None:
        return np.zeros(values.shape, dtype=bool)
    return np.asarray(np.abs(values - sentinel) < 1e-6)

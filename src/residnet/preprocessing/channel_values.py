"""What single channels hold beside measurements: noise, outliers, spikes, fills, held values."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from residnet.core.frames import unwrap_angle
from residnet.core.layout import SIX_DOF_LAYOUT
from residnet.core.log import Log
from residnet.core.stretches import find_runs

# standard deviations of a Gaussian in its median absolute deviation
SIGMA_OF_MAD = 1.4826
# share of the spread of a motion below which a sensor of it does not move: no unit is off so far
NEGLIGIBLE_MOTION_SHARE = 1e-3
# reason in `Log.masks`
SPIKE_REASON = "spike"
# a spike leaves the median of its neighbours by so many times the usual change from sample to
# sample, or the usual distance from that median, and returns within so many samples
_MIN_SPIKE_CHANGES, _MIN_SPIKE_DISTANCES, _MAX_SPIKE_SAMPLES = 12.0, 30.0, 2
# the least of both, in usual changes
_MIN_CHANGES_FOR_SCAN = 3.0
# or leaves the range of the whole log by so many times that range
_MIN_RANGE_EXCESS = 0.9
_MIN_SAMPLES = 20
"""Samples below which a channel has no usual change; chosen by hand."""
CACHED_SAMPLES = 8_192
"""Samples whose neighbours are compared at a time: they stay in a core's cache."""
_MAX_SUBSAMPLE, _N_SUBSAMPLE_SEGMENTS = 40_000, 40
"""Samples of a long channel that tell how far samples usually lie from their neighbours, and in how
many stretches these lie."""


def estimate_noise_std(values: np.ndarray) -> float:
    """Return the standard deviation of a channel's white noise, from third differences.

    These hardly see the motion. The differences are taken over the known samples only; 0 where
    there are fewer than 8, or where most third differences vanish.
    """
    finite_values = values[np.isfinite(values)]
    if finite_values.size < 8:
        return 0.0
    return SIGMA_OF_MAD * nan_median(np.abs(np.diff(finite_values, 3))) / math.sqrt(20.0)


def nan_quantiles(values: np.ndarray, *levels: float) -> list[float]:
    """Return quantiles of the numbers in values [T], NaN where there are none.

    They are those of numpy, which takes ten times as long for a short log.
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
    """Return the median of the numbers in values [T], NaN where there are none."""
    return nan_quantiles(values, 0.5)[0]


def nan_std(values: np.ndarray) -> float:
    """Return the standard deviation of the finite values, NaN where there are none."""
    finite_values = values[np.isfinite(values)]
    if not finite_values.size:
        return np.nan
    deviations = finite_values - finite_values.sum() / finite_values.size
    return math.sqrt(float(deviations @ deviations) / finite_values.size)


def _selection_medians(
    get_members: Callable[[slice], list[np.ndarray]], n_samples: int
) -> np.ndarray:
    """Return the medians [T] of members, each [T], given for a part of the `count` samples.

    By forgetful selection: of half of them and two more neither the least nor the largest is in
    the middle. Both go, and the next comes, until the middle is left.
    """
    medians = np.empty(n_samples)
    for start in range(0, n_samples, CACHED_SAMPLES):
        chunk = slice(start, min(start + CACHED_SAMPLES, n_samples))
        remaining = get_members(chunk)
        candidates, remaining = (
            remaining[: len(remaining) // 2 + 2],
            remaining[len(remaining) // 2 + 2 :],
        )
        while len(candidates) > 2:
            n_half = len(candidates) // 2
            for i in range(n_half):
                lower_candidate, upper_candidate = candidates[i], candidates[-1 - i]
                candidates[i], candidates[-1 - i] = (
                    np.minimum(lower_candidate, upper_candidate),
                    np.maximum(lower_candidate, upper_candidate),
                )
            # one in the middle of an odd number may be either
            for i in range(1, len(candidates) - n_half):
                lower_candidate, upper_candidate = candidates[0], candidates[i]
                candidates[0], candidates[i] = (
                    np.minimum(lower_candidate, upper_candidate),
                    np.maximum(lower_candidate, upper_candidate),
                )
            for i in range(len(candidates) - 2, n_half - 1, -1):
                lower_candidate, upper_candidate = candidates[-1], candidates[i]
                candidates[-1], candidates[i] = (
                    np.maximum(lower_candidate, upper_candidate),
                    np.minimum(lower_candidate, upper_candidate),
                )
            candidates = candidates[1:-1] + remaining[:1]
            remaining = remaining[1:]
        medians[chunk] = (
            candidates[0] if len(candidates) == 1 else 0.5 * (candidates[0] + candidates[1])
        )
    return medians


def find_hampel_outliers(
    columns: Sequence[np.ndarray], sigmas: float = 6.0, samples: int = 11
) -> list[np.ndarray]:
    """Return for each column [T], [T] bool: known values that stand out of their neighbours.

    The rule is that of the mask `Hampel`; `samples`, made odd, is the number of neighbours. Columns
    are compared side by side: several short ones take hardly longer than one.
    """
    half_window = samples // 2
    max_distance, n_neighbours = 2 * half_window, 2 * half_window + 1
    outlier_masks = [np.zeros(values.size, dtype=bool) for values in columns]
    finite_indices = [np.flatnonzero(np.isfinite(values)) for values in columns]
    usable_columns = [
        i for i, indices in enumerate(finite_indices) if indices.size > 2 * max_distance
    ]
    finite_values = [columns[i][finite_indices[i]] for i in usable_columns]
    if not finite_values:
        return outlier_masks

    def neighbours(values: np.ndarray, offset: int, chunk: slice) -> np.ndarray:
        return values[chunk.start + offset : chunk.stop + offset]

    def split_by_column(values: np.ndarray, margin: int) -> list[np.ndarray]:
        """Return the part of each column of those that stand one behind the other."""
        starts = np.cumsum(
            [0, *(column_values.size + 2 * margin for column_values in finite_values[:-1])]
        )
        return [
            values[start : start + column_values.size]
            for start, column_values in zip(starts, finite_values, strict=True)
        ]

    # how far samples lie from the straight lines between their neighbours, and how usual that is
    padded = np.concatenate(
        [
            np.pad(sample_slice, max_distance, mode="reflect", reflect_type="odd")
            for sample_slice in finite_values
        ]
    )
    interpolations = _selection_medians(
        lambda k: [
            0.5 * (neighbours(padded, i, k) + neighbours(padded, 2 * max_distance - i, k))
            for i in range(max_distance)
        ],
        padded.size - 2 * max_distance,
    )
    deviations = [
        column_values - interpolation
        for column_values, interpolation in zip(
            finite_values, split_by_column(interpolations, max_distance), strict=True
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
        # a coarse channel flickers by single steps of its resolution, a spread at the level of
        # rounding is none
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
        # what a smooth channel bends by anyhow is no outlier where it stops bending
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
    """Return rows [K] of evenly spread stretches, `most` in all; every row of no more than that.

    With a row `centre_row` the stretch nearest to it lies about it.
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
    """Return [size] bool, True inside any of the half-open ranges: the way back of `n_segments`."""
    boundary_counts = np.zeros(n_samples + 1, dtype=np.int64)
    np.add.at(boundary_counts, np.clip(starts, 0, n_samples), 1)
    np.add.at(boundary_counts, np.clip(stops, 0, n_samples), -1)
    return np.cumsum(boundary_counts[:-1]) > 0


def find_steps_above(log: Log, channel: str, limit: float) -> np.ndarray:
    """Return the indices [K] of samples at which `channel` arrives after a large step.

    Large is more than `limit` (SI; angles the short way round).
    """
    values = log[channel]
    values = unwrap_angle(values) if log.units[channel] == "rad" else values
    return np.flatnonzero(np.abs(np.diff(values)) > limit) + 1


def find_spikes(log: Log) -> dict[str, np.ndarray]:
    """Return channel -> [T] bool: single samples, or pairs, that no mass and no actuator follows.

    A measured channel has one where it leaves the median of its neighbours by many times the usual
    change or distance, and returns within two samples. Any other channel may jump; there
    it must leave the whole range of the channel by half of that range.
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
    """Return the log with its spikes bridged and marked, the log itself where it has none.

    Only channels that are needed are looked at, all where that is None.

    Measured channels are interpolated, others hold their last value. The mask `spike` keeps the
    samples from being learned from or scored.
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
    """Return [T] bool: the spikes of one channel [T]; `moved` says that a mass carries it."""
    spike_mask = np.zeros(values.size, dtype=bool)
    finite_indices = np.flatnonzero(np.isfinite(values))
    if finite_indices.size < _MIN_SAMPLES:
        return spike_mask
    finite_values = values[finite_indices]
    changes = np.abs(np.diff(finite_values))
    # of very many samples some tell what is usual
    subsample = slice(None, None, -(-finite_values.size // _MAX_SUBSAMPLE))
    lower_quantile, upper_quantile = nan_quantiles(finite_values[subsample], 0.005, 0.995)
    value_range, high_change = (
        upper_quantile - lower_quantile,
        nan_quantiles(changes[subsample], 0.99)[0],
    )
    # a glance: without one large change there is no spike
    largest = float(changes.max())
    scan_threshold = (
        min(_MIN_CHANGES_FOR_SCAN * high_change, _MIN_RANGE_EXCESS * value_range)
        if is_measured_motion
        else 0.5 * value_range
    )
    if largest <= scan_threshold or not largest:
        return spike_mask
    # what leaves the median of its neighbours makes a step, or three of them do
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

    distance, is_outlier = np.zeros(finite_values.size), np.zeros(finite_values.size, dtype=bool)
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
        # the neighbours of a spike in a steady channel leave their median by a few changes
        min_distance = min(
            _MIN_SPIKE_CHANGES * high_change,
            _MIN_SPIKE_DISTANCES * nan_quantiles(typical_distances, 0.99)[0],
        )
        # what leaves the whole range of a noisy channel is a spike too
        is_out_of_range = (
            (range_excess > _MIN_RANGE_EXCESS * value_range)
            & (distance > _MIN_RANGE_EXCESS * value_range)
            & (value_range > 0.0)
        )
        is_outlier = (
            distance > max(min_distance, _MIN_CHANGES_FOR_SCAN * high_change, 1e-6 * value_range)
        ) | is_out_of_range
    else:
        # a display that flickers between its last digits leaves its range by one step of them
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
    # many spikes are a fault of the sensor, not of single samples
    return (
        spike_mask
        if spike_mask.sum() <= max(3, 0.01 * finite_values.size)
        else np.zeros_like(spike_mask)
    )


# what recorders, NetCDF and spreadsheets write where nothing was measured
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
# largest size that any vessel, manoeuvre or site gives a quantity, by its SI unit
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
    """Return [T] bool: cells that hold a usual fill value far from all that was measured.

    Far is by more than the whole range of the other cells, so that a distance of 999 m between
    900 m and 1100 m is a distance.

    Args:
        values: a column as it stands in the file [T], NaN where empty.
    """
    magnitudes = np.abs(values)
    # most columns hold nothing of the kind: one comparison is enough for them
    if not (magnitudes >= 99.0).any():
        return np.zeros(values.size, dtype=bool)
    is_finite = np.isfinite(values)
    min_value = float(np.min(values, where=is_finite, initial=np.inf))
    max_value = float(np.max(values, where=is_finite, initial=-np.inf))
    # what is far from all else is the least or the largest
    if not _matches_fill_value(np.array([min_value, max_value])).any():
        return np.zeros(values.size, dtype=bool)
    is_candidate = np.zeros(values.size, dtype=bool)
    large_indices = np.flatnonzero(is_finite & (magnitudes >= 99.0))
    is_candidate[large_indices] = _matches_fill_value(values[large_indices])
    other_values = values[is_finite & ~is_candidate]
    if not is_candidate.any() or not other_values.size:
        return np.zeros(values.size, dtype=bool)
    lower, upper = float(other_values.min()), float(other_values.max())
    value_range = upper - lower
    is_far: np.ndarray = (values < lower - value_range) | (values > upper + value_range)
    return np.asarray(is_candidate & is_far)


def _matches_fill_value(values: np.ndarray) -> np.ndarray:
    """Return [K] bool: values that are a usual fill value."""
    insertion_indices, is_match = (
        np.searchsorted(_SORTED_FILL_VALUES, values),
        np.zeros(values.size, dtype=bool),
    )
    for offset in (-1, 0):
        # single precision keeps seven digits of a fill value
        nearest_fill_value = _SORTED_FILL_VALUES[
            np.clip(insertion_indices + offset, 0, _SORTED_FILL_VALUES.size - 1)
        ]
        is_match |= np.abs(values - nearest_fill_value) <= 2e-7 * np.abs(nearest_fill_value)
    return is_match


def mask_fill_values(values: np.ndarray) -> np.ndarray:
    """Return a column [T] with NaN in place of its fill values."""
    is_fill = is_fill_value(values)
    return np.where(is_fill, np.nan, values) if is_fill.any() else values


def max_magnitude(unit: str) -> float:
    """Return the largest size of a quantity of this SI unit; infinite where it is not known."""
    return _MAX_MAGNITUDES.get(unit, np.inf)


def is_implausible(values: np.ndarray, unit: str) -> np.ndarray:
    """Return [T] bool: values that no vessel, manoeuvre or site can have.

    Args:
        values: a channel [T], SI, NaN where missing.
        unit: its SI unit; a unit that is not known has no limit.
    """
    return np.asarray(np.abs(values) > max_magnitude(unit))


_SENSOR_GROUPS = (("x", "y"), ("u", "v"), ("psi",), ("r",))
"""Channels that come from one sensor: either may rest at a new measurement, both hardly ever do."""
_MIN_INTERVALS = 20
"""Intervals between measurements that are needed to tell their rule."""
INTERVAL_TOLERANCE, MIN_REGULAR_SHARE = 0.25, 0.9
"""So large a share of the intervals is the usual one, within this share of it."""


def median_update_interval(values: np.ndarray) -> float:
    """Return after how many samples channels [T] or [T, k] change; 1 where there is no rule."""
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
    """Return the log with NaN where slow sensors of the motion repeat their last value.

    Such values are late by up to an interval, and their derivative is spikes; left out, they are
    made from the other sensors like those of any channel that is measured at some samples only.
    """
    fresh_values: dict[str, np.ndarray] = {}
    for sensor_channels in _SENSOR_GROUPS:
        names = [name for name in sensor_channels if name in log.channels]
        if not names:
            continue
        values = log.stack(tuple(names))
        if median_update_interval(values) > 1.0:
            is_fresh = np.append(True, (np.diff(values, axis=0) != 0.0).any(axis=1))
            fresh_values |= {name: np.where(is_fresh, log[name], np.nan) for name in names}
    return log.replace(channels={**log.channels, **fresh_values}) if fresh_values else log

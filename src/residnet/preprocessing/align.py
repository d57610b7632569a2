"""Resample logs to a uniform time grid."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from pydantic import Field

from residnet.core.config import Config, Seconds
from residnet.core.errors import DataError
from residnet.core.frames import unwrap_angle
from residnet.core.log import Log
from residnet.preprocessing.masks import HARD_PREFIX

# tolerance of the sample times for a log that is already on the grid, as a share of a step
_GRID_TOLERANCE = 1e-3
# distance of a grid point from a sample, as a share of a time step, within which they coincide, so
# that rounding of the clock does not give weight to a neighbour
_SAMPLE_TOLERANCE = 1e-5
# largest number of grid points per sample; above it the clock or its unit must be wrong
_MAX_POINTS_PER_SAMPLE = 1000


class GridConfig(Config):
    """Uniform time grid that starts at the first sample of the log.

    Attributes:
        step: time between grid points in s.
        held: channels that are held until the next value (commands); all other channels are
            interpolated linearly, angles across the shorter arc.
        longest_gap: longest time step of the log that is interpolated, in s; null for three median
            time steps of the log.
    """

    step: Seconds = Field(gt=0.0)
    held: tuple[str, ...] = ()
    longest_gap: Seconds | None = Field(default=None, gt=0.0)


def align_to_grid(
    log: Log, config: GridConfig, required_channels: Collection[str] | None = None
) -> Log:
    """Return the log on the grid.

    A log that is on the grid within a thousandth of a step is not changed. If the grid is coarser
    than the log by a factor of two or more, every channel that is not held is averaged over one
    grid step around each grid point, to avoid aliasing. The average is the exact integral of the
    interpolated signal: it has zero phase, accepts any sample times, and has a null at the new
    sampling rate.

    Grid points inside a gap, or whose value depends on a NaN, become NaN and are masked as
    `hard:gap`; a hard mask splits the log. The masks of the log cover every grid point to which a
    masked sample contributes.

    Args:
        log: log with an increasing clock.
        config: settings of the grid.
        required_channels: channels whose NaN is masked; None for all channels. A channel that
            nobody uses must not exclude samples.

    Raises:
        DataError: if the log has fewer than two samples, or the grid would have more than a
            thousand points per sample.
        UsageError: if the log lacks a held channel.
    """
    if len(log) < 2:
        raise DataError(
            f"log {log.name}: {len(log)} samples, at least 2 are needed for a time grid; exclude it"
        )
    # looking a channel up raises the error of a missing one
    for name in config.held:
        log[name]
    n_points = int(np.floor((log.t[-1] - log.t[0]) / config.step + _GRID_TOLERANCE)) + 1
    if n_points > _MAX_POINTS_PER_SAMPLE * len(log):
        raise DataError(
            f"log {log.name}: a grid of {config.step:g} s from {log.t[0]:g} to {log.t[-1]:g} s has"
            f" {n_points} points for {len(log)} samples; check the unit of time, or split the log"
            " where its clock jumps"
        )
    grid = log.t[0] + config.step * np.arange(n_points)
    if n_points == len(log) and float(np.abs(log.t - grid).max()) <= _GRID_TOLERANCE * config.step:
        gridded = log
    else:
        gridded = _resample(log, config, grid)
    names = [
        name for name in gridded.channels if required_channels is None or name in required_channels
    ]
    is_missing = np.isnan(gridded.stack(names)).any(axis=1)
    if not is_missing.any():
        return gridded
    mask_reason = HARD_PREFIX + "gap"
    return gridded.replace(
        masks={
            **gridded.masks,
            mask_reason: (
                gridded.masks.get(mask_reason, np.zeros(len(gridded), dtype=bool)) | is_missing
            ),
        }
    )


def resample_at(log: Log, config: GridConfig, times: np.ndarray) -> Log:
    """Return the log at given times by the rules of `align_to_grid`.

    Args:
        log: log with an increasing clock.
        config: grid whose step is the averaging length.
        times: increasing times [G] in s on the clock of the log; before the first and after the
            last sample the result is NaN.
    """
    resampled = _resample(log, config, times)
    margin = _GRID_TOLERANCE * config.step
    is_outside = (times < log.t[0] - margin) | (times > log.t[-1] + margin)
    channels = {
        name: np.where(is_outside, np.nan, values) for name, values in resampled.channels.items()
    }
    return resampled.replace(channels=channels, masks={})


def _resample(log: Log, config: GridConfig, grid: np.ndarray) -> Log:
    """Return a log at the points of a grid [G] in s, averaged if the grid is coarser."""
    median_step = float(np.median(np.diff(log.t)))
    longest_gap = config.longest_gap if config.longest_gap is not None else 3.0 * median_step
    is_gap = np.diff(log.t) > longest_gap * (1.0 + _GRID_TOLERANCE)
    is_averaged = config.step >= 2.0 * median_step * (1.0 - _GRID_TOLERANCE)
    # the window shrinks towards the ends of the log, so that it stays centred on its point
    half_window = (
        np.minimum(
            0.5 * config.step, np.maximum(np.minimum(grid - log.t[0], log.t[-1] - grid), 0.0)
        )
        if is_averaged
        else np.zeros_like(grid)
    )
    averaging_weights = _GridWeights(log.t, grid, half_window, is_gap)
    held_weights = _GridWeights(log.t, grid, np.zeros_like(grid), is_gap)
    channel_names = tuple(log.channels)
    continuous = np.stack(
        [
            unwrap_angle(log[name]) if log.units[name] == "rad" else log[name]
            for name in channel_names
        ],
        axis=-1,
    )
    is_held = np.array([name in config.held for name in channel_names], dtype=bool)
    # a NaN would propagate through the whole running integral: it is replaced by zero, and every
    # grid point to which it contributes becomes NaN below
    values = np.where(
        is_held,
        held_weights.hold_previous(continuous),
        averaging_weights.average(np.nan_to_num(continuous)),
    )
    is_missing = np.isnan(continuous)
    values[
        np.where(
            is_held,
            held_weights.is_unreliable(is_missing),
            averaging_weights.is_unreliable(is_missing),
        )
    ] = np.nan
    channels = {
        name: _rewrap(log[name], continuous[:, i], values[:, i])
        for i, name in enumerate(channel_names)
    }
    masks = {
        reason: averaging_weights.any_weighted(mask[:, None])[:, 0]
        for reason, mask in log.masks.items()
    }
    meta = {
        **log.meta,
        "grid": {
            "step": config.step,
            "longest_gap": longest_gap,
            "averaged": bool(is_averaged),
            "samples_before": len(log),
        },
    }
    return log.replace(t=grid, channels=channels, masks=masks, meta=meta)


class _GridWeights:
    """Weights of the samples in each grid point.

    Args:
        t: sample times [T] in s.
        grid: grid points [G] in s.
        half_window: half of the averaging length of each point [G] in s; zero interpolates.
        is_gap: time steps that must not be interpolated [T - 1] bool.
    """

    def __init__(
        self, t: np.ndarray, grid: np.ndarray, half_window: np.ndarray, is_gap: np.ndarray
    ) -> None:
        self._t = t
        self._is_gap = is_gap
        self._window_start, self._start_weight = self._locate(grid - half_window)
        self._window_end, self._end_weight = self._locate(grid + half_window)
        # first and last sample with a nonzero weight
        # a window that begins exactly at the next sample gives no weight to the previous one
        self._first_weighted = self._window_start + (self._start_weight == 1.0)
        self._last_weighted = self._window_end + (self._end_weight > 0.0)

    def _locate(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the index of the sample before each time, and the fraction of the time step."""
        previous_index = np.clip(
            np.searchsorted(self._t, times, side="right") - 1, 0, self._t.size - 2
        )
        fraction = np.clip(
            (times - self._t[previous_index])
            / (self._t[previous_index + 1] - self._t[previous_index]),
            0.0,
            1.0,
        )
        return previous_index, np.where(
            fraction < _SAMPLE_TOLERANCE,
            0.0,
            np.where(fraction > 1.0 - _SAMPLE_TOLERANCE, 1.0, fraction),
        )

    def hold_previous(self, x: np.ndarray) -> np.ndarray:
        """Return the last value at or before each grid point, [G, n] from [T, n]."""
        held_values: np.ndarray = x[self._window_start + (self._start_weight == 1.0)]
        return held_values

    def average(self, values: np.ndarray) -> np.ndarray:
        """Return the mean of the linear interpolant over each window, [G, n] from [T, n]."""
        # centred values keep the digits of the running integral of positions far from the origin
        mean_value = values.mean(axis=0)
        centred_values = values - mean_value
        dt = np.diff(self._t)[:, None]
        cumulative_integral = np.concatenate(
            [
                np.zeros((1, values.shape[1])),
                np.cumsum(0.5 * dt * (centred_values[1:] + centred_values[:-1]), axis=0),
            ]
        )

        def integral(previous_index: np.ndarray, weight: np.ndarray) -> np.ndarray:
            """Return the integral of the interpolant up to a fraction of a time step."""
            weights = weight[:, None]
            left_values = centred_values[previous_index]
            right_values = centred_values[previous_index + 1]
            integral_values: np.ndarray = cumulative_integral[previous_index] + dt[
                previous_index
            ] * weights * (left_values + 0.5 * weights * (right_values - left_values))
            return integral_values

        start_weight = self._start_weight[:, None]
        interpolated = np.where(
            start_weight == 1.0,
            values[self._window_start + 1],
            values[self._window_start]
            + start_weight * (values[self._window_start + 1] - values[self._window_start]),
        )
        window_duration = (
            self._t[self._window_end] + self._end_weight * dt[self._window_end, 0]
        ) - (self._t[self._window_start] + self._start_weight * dt[self._window_start, 0])
        is_window = window_duration > 0.0
        averages = (
            integral(self._window_end, self._end_weight)
            - integral(self._window_start, self._start_weight)
        ) / np.where(is_window, window_duration, 1.0)[:, None] + mean_value
        means: np.ndarray = np.where(is_window[:, None], averages, interpolated)
        return means

    def any_weighted(self, flags: np.ndarray) -> np.ndarray:
        """Return [G, k] bool: points to which a flagged sample contributes; flags [T, k]."""
        return _any_in_ranges(flags, self._first_weighted, self._last_weighted + 1)

    def is_unreliable(self, is_missing: np.ndarray) -> np.ndarray:
        """Return [G, n] bool: points with a missing sample or a gap in their window."""
        unreliable: np.ndarray = self.any_weighted(is_missing) | _any_in_ranges(
            self._is_gap[:, None], self._first_weighted, self._last_weighted
        )
        return unreliable


def _any_in_ranges(flags: np.ndarray, starts: np.ndarray, stops: np.ndarray) -> np.ndarray:
    """Return [G, k] bool: any of flags[start:stop], for index arrays [G]."""
    cumulative_flags = np.concatenate(
        [np.zeros((1, flags.shape[1]), dtype=np.int64), np.cumsum(flags, axis=0)]
    )
    has_flag: np.ndarray = cumulative_flags[stops] > cumulative_flags[starts]
    return has_flag


def _rewrap(
    original_values: np.ndarray, unwrapped_values: np.ndarray, grid_values: np.ndarray
) -> np.ndarray:
    """Wrap resampled angles to the range of the original channel, if that was wrapped.

    Args:
        original_values: channel [T] of the log.
        unwrapped_values: the same channel unwrapped [T].
        grid_values: resampled unwrapped channel [G].
    """
    if np.array_equal(original_values, unwrapped_values, equal_nan=True):
        return grid_values
    lower_bound = 0.0 if np.nanmin(original_values) >= 0.0 else -np.pi
    return np.remainder(grid_values - lower_bound, 2.0 * np.pi) + lower_bound

"""Bring a log to a uniform time grid, without touching one that already lies on it."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from pydantic import Field

from residnet.core.config import Config, Seconds
from residnet.core.errors import DataError
from residnet.core.log import Log
from residnet.data.masks import HARD
from residnet.data.readers.base import unwrap

# share of a step within which a sample counts as lying on the grid
_ON_GRID = 1e-3
# share of a time step within which a grid point is a sample, so that rounding of the clock does not
# drag in the neighbour
_AT_SAMPLE = 1e-5
# grid points per sample beyond which the clock or its unit must be wrong
_MOST_POINTS = 1000


class GridConfig(Config):
    """A uniform grid from the log's first sample on.

    Attributes:
        step: time between grid points, s.
        held: channels whose last value holds until the next (commands); all others are interpolated
            linearly, angles the short way round.
        longest_gap: longest time step of the log that is interpolated across, s; null takes three
            times the log's usual time step.
    """

    step: Seconds = Field(gt=0.0)
    held: tuple[str, ...] = ()
    longest_gap: Seconds | None = Field(default=None, gt=0.0)


def align(log: Log, config: GridConfig, needed: Collection[str] | None = None) -> Log:
    """Return the log on the grid.

    Args:
        log: with an increasing clock.
        needed: channels without which a sample is missing; all where None. What nobody uses must
            cost no sample.

    A log that lies on the grid to a thousandth of a step keeps its times and samples exactly. Where
    the grid is coarser than the log by a factor of two or more, every channel that is not held is
    averaged over one grid step around each grid point, or motion above the new Nyquist frequency
    would fold into the samples. The average is the exact integral of the interpolated signal: zero
    phase, any sample times, a null at the new rate.

    Grid points inside a gap or whose value depends on a NaN become NaN and are masked as
    `hard:gap`; the log's own masks cover every grid point that a masked sample enters.

    Raises:
        DataError: where the log has fewer than two samples, or the grid would have more than a
            thousand points per sample.
        UsageError: where the log lacks a held channel.
    """
    if len(log) < 2:
        raise DataError(
            f"log {log.name}: {len(log)} samples, at least 2 are needed for a time grid; leave"
            " it out"
        )
    for name in config.held:
        log[name]
    count = int(np.floor((log.t[-1] - log.t[0]) / config.step + _ON_GRID)) + 1
    if count > _MOST_POINTS * len(log):
        raise DataError(
            f"log {log.name}: a grid of {config.step:g} s from {log.t[0]:g} to {log.t[-1]:g} s has"
            f" {count} points for {len(log)} samples; check the unit of time, or split the log"
            " where its clock jumps"
        )
    grid = log.t[0] + config.step * np.arange(count)
    if count == len(log) and float(np.abs(log.t - grid).max()) <= _ON_GRID * config.step:
        out = log
    else:
        out = _resampled(log, config, grid)
    names = [name for name in out.channels if needed is None or name in needed]
    missing = np.isnan(out.stack(names)).any(axis=1)
    if not missing.any():
        return out
    reason = HARD + "gap"
    return out.replace(
        masks={**out.masks, reason: out.masks.get(reason, np.zeros(len(out), dtype=bool)) | missing}
    )


def onto(log: Log, config: GridConfig, times: np.ndarray) -> Log:
    """Return the log at given times [G], increasing, in s on its clock, by the rules of `align`.

    NaN before its first sample and after its last.

    The length that is averaged over is the config's step.
    """
    out = _resampled(log, config, times)
    margin = _ON_GRID * config.step
    outside = (times < log.t[0] - margin) | (times > log.t[-1] + margin)
    channels = {name: np.where(outside, np.nan, values) for name, values in out.channels.items()}
    return out.replace(channels=channels, masks={})


def _resampled(log: Log, config: GridConfig, grid: np.ndarray) -> Log:
    usual = float(np.median(np.diff(log.t)))
    longest = config.longest_gap if config.longest_gap is not None else 3.0 * usual
    gap = np.diff(log.t) > longest * (1.0 + _ON_GRID)
    averaged = config.step >= 2.0 * usual * (1.0 - _ON_GRID)
    half = (
        np.minimum(
            0.5 * config.step, np.maximum(np.minimum(grid - log.t[0], log.t[-1] - grid), 0.0)
        )
        if averaged
        else np.zeros_like(grid)
    )
    smooth, held = _Reach(log.t, grid, half, gap), _Reach(log.t, grid, np.zeros_like(grid), gap)
    names = tuple(log.channels)
    continuous = np.stack(
        [unwrap(log[name]) if log.units[name] == "rad" else log[name] for name in names], axis=-1
    )
    is_held = np.array([name in config.held for name in names], dtype=bool)
    # a NaN would poison the whole running integral: zeros stand in for it, and every point that
    # they reach is blanked below
    values = np.where(is_held, held.previous(continuous), smooth.mean(np.nan_to_num(continuous)))
    missing = np.isnan(continuous)
    values[np.where(is_held, held.broken(missing), smooth.broken(missing))] = np.nan
    channels = {
        name: _rewrapped(log[name], continuous[:, i], values[:, i]) for i, name in enumerate(names)
    }
    masks = {reason: smooth.touched(mask[:, None])[:, 0] for reason, mask in log.masks.items()}
    meta = {
        **log.meta,
        "grid": {
            "step": config.step,
            "longest_gap": longest,
            "averaged": bool(averaged),
            "samples_before": len(log),
        },
    }
    return log.replace(t=grid, channels=channels, masks=masks, meta=meta)


class _Reach:
    """Which samples enter each point of a grid, and their weights.

    Args:
        t: sample times [T], s.
        grid: grid points [G], s.
        half: half the length [G] that a point is averaged over, s; zero interpolates.
        gap: [T - 1] bool, time steps that must not be bridged.
    """

    def __init__(self, t: np.ndarray, grid: np.ndarray, half: np.ndarray, gap: np.ndarray) -> None:
        self._t, self._gap = t, gap
        self._low, self._w_low = self._place(grid - half)
        self._high, self._w_high = self._place(grid + half)
        # first and last sample that carry weight
        self._first = self._low + (self._w_low == 1.0)
        self._last = self._high + (self._w_high > 0.0)

    def _place(self, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the index of the sample before each time, and the share of the way to the next."""
        left = np.clip(np.searchsorted(self._t, at, side="right") - 1, 0, self._t.size - 2)
        weight = np.clip((at - self._t[left]) / (self._t[left + 1] - self._t[left]), 0.0, 1.0)
        return left, np.where(
            weight < _AT_SAMPLE, 0.0, np.where(weight > 1.0 - _AT_SAMPLE, 1.0, weight)
        )

    def previous(self, x: np.ndarray) -> np.ndarray:
        """Return the last value at or before each grid point, [G, n] from [T, n]."""
        held: np.ndarray = x[self._low + (self._w_low == 1.0)]
        return held

    def mean(self, x: np.ndarray) -> np.ndarray:
        """Return the mean of the linear interpolant over each point's reach, [G, n] from [T, n]."""
        # without its mean the running integral keeps its digits for positions far from the origin
        offset = x.mean(axis=0)
        centred, dt = x - offset, np.diff(self._t)[:, None]
        area = np.concatenate(
            [np.zeros((1, x.shape[1])), np.cumsum(0.5 * dt * (centred[1:] + centred[:-1]), axis=0)]
        )

        def integral(left: np.ndarray, weight: np.ndarray) -> np.ndarray:
            w, a, b = weight[:, None], centred[left], centred[left + 1]
            integral: np.ndarray = area[left] + dt[left] * w * (a + 0.5 * w * (b - a))
            return integral

        w = self._w_low[:, None]
        point = np.where(
            w == 1.0, x[self._low + 1], x[self._low] + w * (x[self._low + 1] - x[self._low])
        )
        span = (self._t[self._high] + self._w_high * dt[self._high, 0]) - (
            self._t[self._low] + self._w_low * dt[self._low, 0]
        )
        wide = span > 0.0
        mean = (integral(self._high, self._w_high) - integral(self._low, self._w_low)) / np.where(
            wide, span, 1.0
        )[:, None] + offset
        means: np.ndarray = np.where(wide[:, None], mean, point)
        return means

    def touched(self, flags: np.ndarray) -> np.ndarray:
        """Return [G, k] bool: any flagged sample carries weight; flags [T, k]."""
        return _any_between(flags, self._first, self._last + 1)

    def broken(self, missing: np.ndarray) -> np.ndarray:
        """Return [G, n] bool: a missing sample carries weight, or the reach crosses a gap."""
        untrusted: np.ndarray = self.touched(missing) | _any_between(
            self._gap[:, None], self._first, self._last
        )
        return untrusted


def _any_between(flags: np.ndarray, first: np.ndarray, stop: np.ndarray) -> np.ndarray:
    """Return [G, k] bool: any of flags[first:stop], for index arrays [G]."""
    count = np.concatenate(
        [np.zeros((1, flags.shape[1]), dtype=np.int64), np.cumsum(flags, axis=0)]
    )
    between: np.ndarray = count[stop] > count[first]
    return between


def _rewrapped(original: np.ndarray, continuous: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the grid values [G] in the range of the original channel [T].

    Unwrapping may have left that range.
    """
    if np.array_equal(original, continuous, equal_nan=True):
        return values
    low = 0.0 if np.nanmin(original) >= 0.0 else -np.pi
    return np.remainder(values - low, 2.0 * np.pi) + low

"""Rules that exclude samples of a log from fits and scores.

A mask is stored in `Log.masks` under its reason. The reason is the kind of the rule with a prefix:

* `hard:<kind>`: the log is split at these samples; no simulation or filter crosses them.
* `<kind>`: simulations cross these samples, but they are excluded from scores and fits.
* `rate:<kind>`: only derivatives are biased; free runs are scored (`find_scored_samples`), one-step
  fits exclude the samples (`Log.usable`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Annotated, ClassVar, Literal, final

import numpy as np
from pydantic import Field

from residnet.core.config import Config, Seconds
from residnet.core.frames import unwrap_angle
from residnet.core.log import Log
from residnet.core.stretches import find_runs, number_runs
from residnet.preprocessing.channel_values import (
    SIGMA_OF_MAD,
    find_hampel_outliers,
    find_spikes,
    find_steps_above,
    mask_from_ranges,
    median_update_interval,
)

HARD_PREFIX = "hard:"
RATE_PREFIX = "rate:"


class MaskRule(Config, ABC):
    """Base class of rules that mark samples of a log."""

    prefix: ClassVar[str] = ""

    @property
    def is_hard(self) -> bool:
        """Whether the log is split at marked samples."""
        return self.prefix == HARD_PREFIX

    @property
    def reason(self) -> str:
        """Key in `Log.masks`, shared by rules of one kind."""
        return self.prefix + str(type(self).model_fields["kind"].default)

    @abstractmethod
    def apply(self, log: Log) -> np.ndarray:
        """Return [T] bool: marked samples.

        Raises:
            UsageError: if the log lacks a channel of the rule.
        """


@final
class FrozenMask(MaskRule):
    """Frozen receiver: all `channels` bit-identical over several steps.

    For a slow receiver that repeats its values, a step is its update interval. The mask begins at
    the first repeated sample and ends `after` seconds after the last one, because the filter of the
    receiver needs this time to recover.

    Attributes:
        channels: channels of the receiver.
        samples: smallest number of equal steps.
        after: duration in s that is masked after a freeze.
    """

    kind: Literal["frozen"] = "frozen"
    channels: tuple[str, ...] = Field(default=("x", "y"), min_length=1)
    samples: int = Field(default=5, ge=1)
    after: Seconds = Field(default=2.0, ge=0.0)

    def apply(self, log: Log) -> np.ndarray:
        values = log.stack(self.channels)
        starts, stops = find_runs((np.diff(values, axis=0) == 0.0).all(axis=1))
        is_long = stops - starts >= self.samples * median_update_interval(values)
        starts = starts[is_long]
        last_indices = stops[is_long]
        # half a step of margin makes the end independent of rounding in t
        mask_ends = np.searchsorted(
            log.t, log.t[last_indices] + self.after - 0.5 * _median_time_step(log.t)
        )
        return mask_from_ranges(len(log), starts, np.maximum(mask_ends, last_indices + 1))


@final
class GapMask(MaskRule):
    """Gaps: the first sample after each time step longer than `longest` is marked.

    Attributes:
        longest: longest regular time step in s.
    """

    prefix: ClassVar[str] = HARD_PREFIX
    kind: Literal["gap"] = "gap"
    longest: Seconds = Field(gt=0.0)

    def apply(self, log: Log) -> np.ndarray:
        return np.append(False, np.diff(log.t) > self.longest * (1.0 + 1e-9))


@final
class MissingValues(MaskRule):
    """Missing values (NaN) in any of `channels`.

    Attributes:
        channels: channels to check; empty for all channels.
    """

    prefix: ClassVar[str] = HARD_PREFIX
    kind: Literal["nan"] = "nan"
    channels: tuple[str, ...] = ()

    def apply(self, log: Log) -> np.ndarray:
        is_missing: np.ndarray = np.isnan(log.stack(self.channels or tuple(log.channels))).any(
            axis=1
        )
        return is_missing


@final
class JumpMask(MaskRule):
    """Jumps: differences of successive samples of a channel above `limit`.

    Differences of angles are taken across the shorter arc.

    Attributes:
        channel: channel to check.
        limit: largest regular difference of successive samples, SI.
        before: number of masked samples before a jump.
        after: number of masked samples after a jump.
    """

    kind: Literal["jump"] = "jump"
    channel: str
    limit: float = Field(gt=0.0)
    before: int = Field(default=1, ge=0)
    after: int = Field(default=1, ge=0)

    def apply(self, log: Log) -> np.ndarray:
        jump_indices = find_steps_above(log, self.channel, self.limit)
        return mask_from_ranges(len(log), jump_indices - self.before, jump_indices + self.after)


@final
class OutlierMask(MaskRule):
    """Outliers: samples many standard deviations from the moving average of their neighbours.

    Mean and standard deviation are taken over the `samples` nearest *other* samples. In a window of
    n samples that contains the sample itself, no distance can exceed (n - 1) / sqrt(n) standard
    deviations: 2.85 for the 10 samples of the source, so that its limit of 3 would never be
    exceeded. The standard deviation has a robust estimate over the complete channel as its lower
    bound, because ten samples alone would mark 2 % of normal noise as outliers.

    Source: Jervan 2020, section 5.2.

    Attributes:
        channels: channels to check.
        sigmas: distance of an outlier in standard deviations.
        samples: number of neighbours.
    """

    kind: Literal["outlier"] = "outlier"
    channels: tuple[str, ...] = Field(min_length=1)
    sigmas: float = Field(default=3.0, gt=0.0)
    samples: int = Field(default=10, ge=4)

    def apply(self, log: Log) -> np.ndarray:
        return _apply_per_channel(log, self.channels, self.find_outliers)

    def find_outliers(self, channel: np.ndarray) -> np.ndarray:
        """Return [T] bool for a channel [T]."""
        is_outlier = np.zeros(channel.size, dtype=bool)
        is_finite = np.isfinite(channel)
        values = channel[is_finite]
        if values.size <= self.samples:
            return is_outlier
        indices = np.arange(values.size)
        first_neighbours = np.clip(indices - self.samples // 2, 0, values.size - self.samples - 1)
        # near the ends the window is not centred, so that it always has the same number of
        # neighbours
        windows = np.lib.stride_tricks.sliding_window_view(values, self.samples + 1)[
            first_neighbours
        ]
        is_centre = np.arange(self.samples + 1) == (indices - first_neighbours)[:, None]
        neighbours = windows[~is_centre].reshape(values.size, self.samples)
        deviations = np.abs(values - neighbours.mean(axis=1))
        typical_deviation = SIGMA_OF_MAD * float(np.median(deviations))
        # a standard deviation at the level of rounding errors is not meaningful
        floor = 1e-9 * float(np.abs(values).max())
        neighbour_std = np.maximum(neighbours.std(axis=1, ddof=1), max(typical_deviation, floor))
        is_outlier[is_finite] = deviations > self.sigmas * neighbour_std
        return is_outlier


@final
class HampelMask(MaskRule):
    """Outliers by the Hampel filter (Pearson 2002) on a detrended channel.

    The trend is the median of the linear interpolations between pairs of neighbours, up to
    `samples` to either side. A sample is an outlier if its distance from the trend deviates from
    the running median of these distances by more than `sigmas` robust standard deviations. The
    robust standard deviation is 1.4826 times the median absolute deviation of the neighbours, at
    least that of the complete channel. A few outliers do not change a median, whereas they change
    mean and standard deviation of the rule `outlier`.

    Attributes:
        channels: channels to check.
        sigmas: distance of an outlier in robust standard deviations.
        samples: number of neighbours, made odd.
    """

    kind: Literal["hampel"] = "hampel"
    channels: tuple[str, ...] = Field(min_length=1)
    sigmas: float = Field(default=6.0, gt=0.0)
    samples: int = Field(default=11, ge=5)

    def apply(self, log: Log) -> np.ndarray:
        return _apply_per_channel(
            log,
            self.channels,
            lambda values: find_hampel_outliers([values], self.sigmas, self.samples)[0],
        )


@final
class SpikeMask(MaskRule):
    """Spikes: single samples or pairs far from all other samples.

    Every run excludes them automatically (`residnet.preprocessing.channel_values.bridge_spikes`).
    """

    kind: Literal["spike"] = "spike"

    def apply(self, log: Log) -> np.ndarray:
        spikes_by_channel = find_spikes(log)
        return np.asarray(
            np.logical_or.reduce([np.zeros(len(log), dtype=bool), *spikes_by_channel.values()])
        )


@final
class InputJumpMask(MaskRule):
    """Steps of inputs above `limit`, with a margin in time.

    A smoothed derivative spreads the response to a step over the time before it. Therefore the
    derivatives near the step are biased, although the samples themselves are valid.

    Attributes:
        channels: inputs to check.
        limit: largest regular difference of successive samples, SI.
        before: duration in s that is masked before a step.
        after: duration in s that is masked after a step.
    """

    prefix: ClassVar[str] = RATE_PREFIX
    kind: Literal["input_jump"] = "input_jump"
    channels: tuple[str, ...] = Field(min_length=1)
    limit: float = Field(gt=0.0)
    before: Seconds = Field(ge=0.0)
    after: Seconds = Field(ge=0.0)

    def apply(self, log: Log) -> np.ndarray:
        jump_indices = np.concatenate(
            [find_steps_above(log, name, self.limit) for name in self.channels]
        )
        margin = 1e-6 * _median_time_step(log.t)
        starts = np.searchsorted(log.t, log.t[jump_indices] - self.before - margin)
        stops = np.searchsorted(log.t, log.t[jump_indices] + self.after + margin, side="right")
        return mask_from_ranges(len(log), starts, stops)


MaskConfig = Annotated[
    FrozenMask
    | GapMask
    | MissingValues
    | JumpMask
    | OutlierMask
    | HampelMask
    | SpikeMask
    | InputJumpMask,
    Field(discriminator="kind"),
]
"""Masking rule, selected by its `kind`."""


def apply_masks(log: Log, rules: Sequence[MaskRule]) -> Log:
    """Return the log with the masks of all rules added to its masks.

    Rules of one kind share one mask. Rules should be applied to the log as recorded, because
    interpolation hides repeated values.

    Raises:
        UsageError: if the log lacks a channel of a rule.
    """
    masks = dict(log.masks)
    for rule in rules:
        masks[rule.reason] = rule.apply(log) | masks.get(rule.reason, False)
    return log.replace(masks=masks)


def make_hard_mask(log: Log) -> np.ndarray:
    """Return [T] bool: samples at which the log is split."""
    return _combine_masks(log, [name for name in log.masks if name.startswith(HARD_PREFIX)])


def find_scored_samples(log: Log) -> np.ndarray:
    """Return [T] bool: samples at which free runs are scored (no hard or soft mask)."""
    return ~_combine_masks(log, [name for name in log.masks if not name.startswith(RATE_PREFIX)])


def number_log_segments(log: Log) -> np.ndarray:
    """Return the segment number of each sample [T] int, from 0; -1 at hard masks."""
    return number_runs(~make_hard_mask(log))


def _combine_masks(log: Log, reasons: Sequence[str]) -> np.ndarray:
    """Return [T] bool: samples with any of these masks."""
    is_masked = np.zeros(len(log), dtype=bool)
    return np.asarray(np.logical_or.reduce([is_masked, *(log.masks[name] for name in reasons)]))


def _apply_per_channel(
    log: Log, names: Sequence[str], find_bad_samples: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """Return [T] bool: samples that a rule marks in any of the channels, with angles unwrapped."""
    channels = {name: log[name] for name in names}
    channel_masks = (
        find_bad_samples(unwrap_angle(values) if log.units[channel_name] == "rad" else values)
        for channel_name, values in channels.items()
    )
    return np.asarray(np.logical_or.reduce([np.zeros(len(log), dtype=bool), *channel_masks]))


def _median_time_step(t: np.ndarray) -> float:
    """Return the median of the time steps in s; 0 with fewer than two samples."""
    return float(np.median(np.diff(t))) if t.size > 1 else 0.0

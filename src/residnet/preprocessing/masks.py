"""Masks: which samples of a log must not be trusted, and why.

A mask is stored in `Log.masks` under its reason, the kind with a prefix that says what it forbids:

* `hard:<kind>`: the log is split there; nothing is simulated, filtered or learned across.
* `<kind>`: simulated across, but neither scored nor learned from.
* `rate:<kind>`: only the derivatives there are biased; free runs may be scored (`find_scored_samples`), one-step
fits leave the samples out (`Log.usable`).
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
UNEXPLAINED_IDLE = f"{HARD_PREFIX}dead_commands"
"""Reason of what no recorded input explains while all inputs rest (see `PrepareConfig`)."""


class MaskRule(Config, ABC):
    """A rule that marks samples of a log."""

    prefix: ClassVar[str] = ""

    @property
    def is_hard(self) -> bool:
        """Whether the log is split at marked samples."""
        return self.prefix == HARD_PREFIX

    @property
    def reason(self) -> str:
        """Key in `Log.masks`; rules of one kind share it."""
        return self.prefix + str(type(self).model_fields["kind"].default)

    @abstractmethod
    def apply(self, log: Log) -> np.ndarray:
        """Return [T] bool, True where a sample is bad.

        Raises:
            UsageError: where the log lacks a channel that the rule names.
        """


@final
class FrozenMask(MaskRule):
    """A receiver that holds its last fix: all `channels` bit-identical over several steps.

    Where a slow receiver repeats each value until its next one, a step is the time between these.

    From the first of the equal samples until `after` seconds past the last of them: the filters
    behind the receiver need that long to recover.

    Attributes:
        channels: that the receiver gives.
        samples: least number of equal steps.
        after: seconds that stay masked behind them.
    """

    kind: Literal["frozen"] = "frozen"
    channels: tuple[str, ...] = Field(default=("x", "y"), min_length=1)
    samples: int = Field(default=5, ge=1)
    after: Seconds = Field(default=2.0, ge=0.0)

    def apply(self, log: Log) -> np.ndarray:
        values = log.stack(self.channels)
        starts, stops = find_runs((np.diff(values, axis=0) == 0.0).all(axis=1))
        is_long = stops - starts >= self.samples * median_update_interval(values)
        starts, last_indices = starts[is_long], stops[is_long]
        # half a step of margin keeps `after` a whole number of samples in spite of rounding in t
        mask_ends = np.searchsorted(
            log.t, log.t[last_indices] + self.after - 0.5 * _median_time_step(log.t)
        )
        return mask_from_ranges(len(log), starts, np.maximum(mask_ends, last_indices + 1))


@final
class GapMask(MaskRule):
    """Time steps longer than `longest`; the first sample after each is the one marked.

    Attributes:
        longest: longest time step that is no gap, in s.
    """

    prefix: ClassVar[str] = HARD_PREFIX
    kind: Literal["gap"] = "gap"
    longest: Seconds = Field(gt=0.0)

    def apply(self, log: Log) -> np.ndarray:
        return np.append(False, np.diff(log.t) > self.longest * (1.0 + 1e-9))


@final
class MissingValues(MaskRule):
    """NaN in any of `channels` (all channels where empty).

    Attributes:
        channels: to look at; all where empty.
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
    """Differences of more than `limit` in `channel` (SI, per sample; angles the short way round).

    Marked are the `before` last samples ahead of the difference and the `after` first ones past it.

    Attributes:
        channel: to look at.
        limit: largest difference from sample to sample, SI.
        before: samples before the jump that are masked too.
        after: samples behind it that are masked too.
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
    """Samples many standard deviations away from the moving average of their neighbours.

    Attributes:
        channels: to look at.
        sigmas: distance in standard deviations from which on a sample is an outlier.
        samples: number of neighbours.

    Source: document 002, section 5.2.

    Average and deviation are taken over the `samples` nearest *other* samples. Over a window of n
    that holds the sample itself no distance can exceed (n - 1) / sqrt(n) standard deviations, 2.85
    for the document's 10, so that its rule of 3, taken literally, never fires. The deviation is
    kept above a robust estimate over the whole channel, because ten samples alone would call 2 % of
    normal noise outliers.
    """

    kind: Literal["outlier"] = "outlier"
    channels: tuple[str, ...] = Field(min_length=1)
    sigmas: float = Field(default=3.0, gt=0.0)
    samples: int = Field(default=10, ge=4)

    def apply(self, log: Log) -> np.ndarray:
        return _apply_per_channel(log, self.channels, self.find_outliers)

    def find_outliers(self, channel: np.ndarray) -> np.ndarray:
        """Return [T] bool for a channel [T]."""
        is_outlier, is_finite = np.zeros(channel.size, dtype=bool), np.isfinite(channel)
        values = channel[is_finite]
        if values.size <= self.samples:
            return is_outlier
        indices = np.arange(values.size)
        first_neighbours = np.clip(indices - self.samples // 2, 0, values.size - self.samples - 1)
        windows = np.lib.stride_tricks.sliding_window_view(values, self.samples + 1)[
            first_neighbours
        ]
        is_centre = np.arange(self.samples + 1) == (indices - first_neighbours)[:, None]
        neighbours = windows[~is_centre].reshape(values.size, self.samples)
        deviations = np.abs(values - neighbours.mean(axis=1))
        typical_deviation = SIGMA_OF_MAD * float(np.median(deviations))
        # a spread at the level of rounding is none
        floor = 1e-9 * float(np.abs(values).max())
        neighbour_std = np.maximum(neighbours.std(axis=1, ddof=1), max(typical_deviation, floor))
        is_outlier[is_finite] = deviations > self.sigmas * neighbour_std
        return is_outlier


@final
class HampelMask(MaskRule):
    """Samples that stand out of their neighbours by many robust standard deviations.

    This is the Hampel filter (Pearson, 2002).

    What is looked at is the distance of a sample from the median of the straight lines between its
    neighbours on either side, up to `samples` away, so that a moving channel is judged as one at
    rest; it is bad where that lies far from its running median over `samples`. The robust deviation
    is 1.4826 times the median absolute deviation of those neighbours, and at least that of the
    whole channel. A few bad samples move neither median, where they move average and deviation of
    the rule of document 002 (`outlier`).

    Attributes:
        channels: to look at.
        sigmas: distance in robust standard deviations from which on a sample is an outlier.
        samples: neighbours on either side that are looked at.
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
    """Single samples, or pairs, that leave all others and return at once.

    Every run leaves them out by itself (`residnet.preprocessing.channel_values.spike_cells`).
    """

    kind: Literal["spike"] = "spike"

    def apply(self, log: Log) -> np.ndarray:
        spikes_by_channel = find_spikes(log)
        return np.asarray(
            np.logical_or.reduce([np.zeros(len(log), dtype=bool), *spikes_by_channel.values()])
        )


@final
class InputJumpMask(MaskRule):
    """Steps of the inputs of more than `limit` per sample, with the seconds around them.

    A smoothed derivative spreads the response to a step over the time before it, so that the
    derivatives there are biased; the samples are good.

    Attributes:
        channels: inputs to look at.
        limit: largest step from sample to sample, SI.
        before: seconds before the step that are masked.
        after: seconds behind it that are masked.
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
"""Any masking rule; its `kind` says which."""


def apply_masks(log: Log, rules: Sequence[MaskRule]) -> Log:
    """Return the log with the masks of all rules added to those that it has.

    Rules of one kind share one mask.

    Masks are found best on the log as recorded: interpolation hides what is bit-identical.

    Raises:
        UsageError: where the log lacks a channel that a rule names.
    """
    masks = dict(log.masks)
    for rule in rules:
        masks[rule.reason] = rule.apply(log) | masks.get(rule.reason, False)
    return log.replace(masks=masks)


def make_hard_mask(log: Log) -> np.ndarray:
    """Return [T] bool: samples at which the log is split."""
    return _combine_masks(log, [name for name in log.masks if name.startswith(HARD_PREFIX)])


def find_scored_samples(log: Log) -> np.ndarray:
    """Return [T] bool: samples that a free run is scored on.

    Neither a hard nor a soft mask excludes them.
    """
    return ~_combine_masks(log, [name for name in log.masks if not name.startswith(RATE_PREFIX)])


def number_log_segments(log: Log) -> np.ndarray:
    """Return the number of the contiguous piece of each sample, [T] int from 0; -1 if masked."""
    return number_runs(~make_hard_mask(log))


def _combine_masks(log: Log, reasons: Sequence[str]) -> np.ndarray:
    is_masked = np.zeros(len(log), dtype=bool)
    return np.asarray(np.logical_or.reduce([is_masked, *(log.masks[name] for name in reasons)]))


def _apply_per_channel(
    log: Log, names: Sequence[str], find_bad_samples: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """Return [T] bool: samples that a rule marks in any channel, angles unwrapped."""
    channels = {name: log[name] for name in names}
    channel_masks = (
        find_bad_samples(unwrap_angle(values) if log.units[channel_name] == "rad" else values)
        for channel_name, values in channels.items()
    )
    return np.asarray(np.logical_or.reduce([np.zeros(len(log), dtype=bool), *channel_masks]))


def _median_time_step(t: np.ndarray) -> float:
    """Return the usual time step in s."""
    return float(np.median(np.diff(t))) if t.size > 1 else 0.0

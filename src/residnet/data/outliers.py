"""Samples of one channel that stand out: far from their neighbours, or after a large step."""

from __future__ import annotations

import numpy as np

from residnet.core.log import Log
from residnet.core.stretches import stretches
from residnet.data.readers.base import unwrap

# standard deviations of a Gaussian in its median absolute deviation
SIGMA_OF_MAD = 1.4826
# reason in `Log.masks`
SPIKE = "spike"
# a spike leaves the median of its neighbours by so many times the usual change from sample to
# sample, or the usual distance from that median, and returns within so many samples
_CHANGES = 12.0
_DISTANCES = 30.0
_LONGEST = 2
# the least of both, in usual changes
_GLANCE = 3.0
# or leaves the range of the whole log by so many times that range
_BEYOND = 0.9
_FEWEST = 20
_MOVED = ("x", "y", "psi", "phi", "u", "v", "r", "p")


def noise_of(values: np.ndarray) -> float:
    """Return the standard deviation of a channel's white noise, from third differences.

    These hardly see the motion. The differences are taken over the known samples only; 0 where
    there are fewer than 8, or where most third differences vanish.
    """
    known = values[np.isfinite(values)]
    if known.size < 8:
        return 0.0
    return float(SIGMA_OF_MAD * np.median(np.abs(np.diff(known, 3))) / np.sqrt(20.0))


def spikes(values: np.ndarray) -> np.ndarray:
    """Return [T] bool: samples that the mask `hampel` with its defaults leaves out."""
    return far_from_median(values, 6.0, 11)


def far_from_median(values: np.ndarray, sigmas: float, samples: int) -> np.ndarray:
    """Return [T] bool: known values [T] that stand out of their neighbours by `Hampel`'s rule.

    `samples`, made odd, is the number of neighbours.
    """
    out = np.zeros(values.size, dtype=bool)
    at, half = np.flatnonzero(np.isfinite(values)), samples // 2
    reach = 2 * half
    if at.size <= 2 * reach:
        return out
    known = values[at]
    padded = np.pad(known, reach, mode="reflect", reflect_type="odd")
    # how far a sample lies from the straight lines between its neighbours on both sides
    pairs = [
        0.5
        * (padded[reach - k : known.size + reach - k] + padded[reach + k : known.size + reach + k])
        for k in range(1, reach + 1)
    ]
    bent = known - np.median(np.stack(pairs), axis=0)
    windows = np.lib.stride_tricks.sliding_window_view(
        np.pad(bent, half, mode="reflect"), 2 * half + 1
    )
    median = np.median(windows, axis=1)
    distance = np.abs(bent - median)
    spread = SIGMA_OF_MAD * np.median(np.abs(windows - median[:, None]), axis=1)
    # a coarse channel flickers by single steps of its resolution, a spread at the level of rounding
    # is none
    resolution = 2.0 * float(np.quantile(distance[distance > 0.0], 0.1)) if distance.any() else 0.0
    floor = max(
        SIGMA_OF_MAD * float(np.median(distance)), resolution, 1e-9 * float(np.abs(known).max())
    )
    # what a smooth channel bends by anyhow is no outlier where it stops bending
    out[at] = distance > sigmas * np.maximum(np.maximum(floor, spread), np.abs(median))
    return out


def steps_above(log: Log, channel: str, limit: float) -> np.ndarray:
    """Return the indices [K] of samples at which `channel` arrives after a large step.

    Large is more than `limit` (SI; angles the short way round).
    """
    values = unwrap(log[channel]) if log.units[channel] == "rad" else log[channel]
    return np.flatnonzero(np.abs(np.diff(values)) > limit) + 1


def spike_cells(log: Log) -> dict[str, np.ndarray]:
    """Return channel -> [T] bool: single samples, or pairs, that no mass and no actuator follows.

    A measured channel has one where it leaves the median of its neighbours by many times the usual
    change or distance, and returns within two samples. Any other channel may jump; there
    it must leave the whole range of the channel by half of that range.
    """
    out = {}
    for name, values in log.channels.items():
        turns = log.units[name] == "rad"
        cells = _spikes(unwrap(values) if turns else values, name in _MOVED)
        if cells.any():
            out[name] = cells
    return out


def without_spikes(log: Log) -> Log:
    """Return the log with its spikes bridged and marked, the log itself where it has none.

    Measured channels are interpolated, others hold their last value. The mask `spike` keeps the
    samples from being learned from or scored.
    """
    cells = spike_cells(log)
    if not cells:
        return log
    channels = dict(log.channels)
    for name, bad in cells.items():
        good = np.flatnonzero(~bad & np.isfinite(log[name]))
        at = np.flatnonzero(bad)
        values = log[name].copy()
        if name in _MOVED:
            values[at] = np.interp(log.t[at], log.t[good], values[good])
        else:
            values[at] = values[good[np.maximum(np.searchsorted(good, at) - 1, 0)]]
        channels[name] = values
    marked = np.logical_or.reduce(list(cells.values()))
    before = log.masks.get(SPIKE, np.zeros(len(log), dtype=bool))
    counts = {name: int(bad.sum()) for name, bad in cells.items()}
    return log.replace(
        channels=channels,
        masks={**log.masks, SPIKE: before | marked},
        meta={**log.meta, "spikes": counts},
    )


def _spikes(values: np.ndarray, moved: bool) -> np.ndarray:
    """Return [T] bool: the spikes of one channel [T]; `moved` says that a mass carries it."""
    out = np.zeros(values.size, dtype=bool)
    at = np.flatnonzero(np.isfinite(values))
    if at.size < _FEWEST:
        return out
    known = values[at]
    span = float(np.quantile(known, 0.995) - np.quantile(known, 0.005))
    change = np.abs(np.diff(known))
    # a glance: without one large change there is no spike
    largest = float(change.max())
    glance = 0.5 * span
    if moved:
        glance = min(_GLANCE * float(np.quantile(change, 0.99)), _BEYOND * span)
    if largest <= glance or not largest:
        return out
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(known, 3, mode="edge"), 7)
    distance = np.abs(known - np.median(windows, axis=1))
    low, high = np.quantile(known, (0.005, 0.995))
    beyond = np.maximum(low - known, known - high)
    if moved:
        most = float(np.quantile(change, 0.99))
        # the neighbours of a spike in a steady channel leave their median by a few changes
        usual = max(
            min(_CHANGES * most, _DISTANCES * float(np.quantile(distance, 0.99))), _GLANCE * most
        )
        # what leaves the whole range of a noisy channel is a spike too
        whole = (beyond > _BEYOND * span) & (distance > _BEYOND * span) & (span > 0.0)
        far = (distance > max(usual, 1e-6 * span)) | whole
    else:
        far = (beyond > 0.5 * span) & (distance > 0.5 * span) if span > 0.0 else beyond < -1.0
    starts, stops = stretches(far)
    for start, stop in zip(starts, stops, strict=True):
        if stop - start <= _LONGEST and start > 0 and stop < known.size:
            out[at[start:stop]] = True
    # many spikes are a fault of the sensor, not of single samples
    return out if out.sum() <= max(3, 0.01 * known.size) else np.zeros_like(out)

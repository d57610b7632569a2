"""What single channels hold beside measurements: noise, outliers, spikes, fills, held values."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from residnet.core.arrays.paged import row_pieces
from residnet.core.log import Log
from residnet.core.stretches import stretches
from residnet.data.readers.base import unwrap

# standard deviations of a Gaussian in its median absolute deviation
SIGMA_OF_MAD = 1.4826
# share of the spread of a motion below which a sensor of it does not move: no unit is off so far
STILL = 1e-3
# reason in `Log.masks`
SPIKE = "spike"
# a spike leaves the median of its neighbours by so many times the usual change from sample to
# sample, or the usual distance from that median, and returns within so many samples
_CHANGES, _DISTANCES, _LONGEST = 12.0, 30.0, 2
# the least of both, in usual changes
_GLANCE = 3.0
# or leaves the range of the whole log by so many times that range
_BEYOND = 0.9
_FEWEST = 20
"""Samples below which a channel has no usual change; chosen by hand."""
_MOVED = ("x", "y", "psi", "phi", "u", "v", "r", "p", "w", "q", "z", "theta")


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
    bent, median = np.empty(known.size), np.empty(known.size)
    # how far a sample lies from the straight lines between its neighbours on both sides
    for at_once in row_pieces(known.size):
        around = sliding_window_view(
            padded[at_once.start : at_once.stop + 2 * reach], 2 * reach + 1
        )
        pairs = 0.5 * (around[:, :reach] + around[:, : -reach - 1 : -1])
        bent[at_once] = known[at_once] - np.median(pairs, axis=1)
    windows = sliding_window_view(np.pad(bent, half, mode="reflect"), 2 * half + 1)
    for at_once in row_pieces(known.size):
        median[at_once] = np.median(windows[at_once], axis=1)
    distance = np.abs(bent - median)
    # a coarse channel flickers by single steps of its resolution, a spread at the level of rounding
    # is none
    resolution = 2.0 * float(np.quantile(distance[distance > 0.0], 0.1)) if distance.any() else 0.0
    floor = max(
        SIGMA_OF_MAD * float(np.median(distance)), resolution, 1e-9 * float(np.abs(known).max())
    )
    # what a smooth channel bends by anyhow is no outlier where it stops bending
    far = np.flatnonzero(distance > sigmas * np.maximum(floor, np.abs(median)))
    spread = SIGMA_OF_MAD * np.median(np.abs(windows[far] - median[far, None]), axis=1)
    out[at[far]] = distance[far] > sigmas * spread
    return out


def steps_above(log: Log, channel: str, limit: float) -> np.ndarray:
    """Return the indices [K] of samples at which `channel` arrives after a large step.

    Large is more than `limit` (SI; angles the short way round).
    """
    values = log[channel]
    values = unwrap(values) if log.units[channel] == "rad" else values
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


def without_spikes(log: Log, needed: Collection[str] | None = None) -> Log:
    """Return the log with its spikes bridged and marked, the log itself where it has none.

    Only channels that are needed are looked at, all where that is None.

    Measured channels are interpolated, others hold their last value. The mask `spike` keeps the
    samples from being learned from or scored.
    """
    cells = {
        name: bad for name, bad in spike_cells(log).items() if needed is None or name in needed
    }
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


# what recorders, NetCDF and spreadsheets write where nothing was measured
_FILLS = np.array(
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
_SORTED = np.sort(_FILLS)
# largest size that any vessel, manoeuvre or site gives a quantity, by its SI unit
_LARGEST = {
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


def fills(values: np.ndarray) -> np.ndarray:
    """Return [T] bool: cells that hold a usual fill value far from all that was measured.

    Far is by more than the whole range of the other cells, so that a distance of 999 m between
    900 m and 1100 m is a distance.

    Args:
        values: a column as it stands in the file [T], NaN where empty.
    """
    known = np.isfinite(values)
    size = np.abs(values)
    # most columns hold nothing of the kind: one comparison is enough for them
    if not known.any() or float(size[known].max()) < 99.0:
        return np.zeros(values.size, dtype=bool)
    candidate = np.zeros(values.size, dtype=bool)
    large = np.flatnonzero(known & (size >= 99.0))
    # single precision keeps seven digits of a fill value
    near = np.searchsorted(_SORTED, values[large])
    for offset in (-1, 0):
        fill = _SORTED[np.clip(near + offset, 0, _SORTED.size - 1)]
        candidate[large] |= np.abs(values[large] - fill) <= 2e-7 * np.abs(fill)
    rest = values[known & ~candidate]
    if not candidate.any() or not rest.size:
        return np.zeros(values.size, dtype=bool)
    low, high = float(rest.min()), float(rest.max())
    span = high - low
    far: np.ndarray = (values < low - span) | (values > high + span)
    return np.asarray(candidate & far)


def without_fills(values: np.ndarray) -> np.ndarray:
    """Return a column [T] with NaN in place of its fill values."""
    filled = fills(values)
    return np.where(filled, np.nan, values) if filled.any() else values


def largest(unit: str) -> float:
    """Return the largest size of a quantity of this SI unit; infinite where it is not known."""
    return _LARGEST.get(unit, np.inf)


def beyond_belief(values: np.ndarray, unit: str) -> np.ndarray:
    """Return [T] bool: values that no vessel, manoeuvre or site can have.

    Args:
        values: a channel [T], SI, NaN where missing.
        unit: its SI unit; a unit that is not known has no limit.
    """
    return np.asarray(np.abs(values) > largest(unit))


_TOGETHER = (("x", "y"), ("u", "v"), ("psi",), ("r",))
"""Channels that come from one sensor: either may rest at a new measurement, both hardly ever do."""
_FEWEST_INTERVALS = 20
"""Intervals between measurements that are needed to tell their rule."""
ALIKE, REGULAR = 0.25, 0.9
"""So large a share of the intervals is the usual one, within this share of it."""


def usual_interval(values: np.ndarray) -> float:
    """Return after how many samples channels [T] or [T, k] change; 1 where there is no rule."""
    moved = np.diff(values, axis=0) != 0.0
    every = np.diff(np.flatnonzero(moved if moved.ndim == 1 else moved.any(axis=1)))
    if every.size < _FEWEST_INTERVALS:
        return 1.0
    usual = float(np.median(every))
    regular = float((np.abs(every - usual) <= ALIKE * usual).mean()) >= REGULAR
    return usual if usual >= 2.0 and regular else 1.0


def without_held(log: Log) -> Log:
    """Return the log with NaN where slow sensors of the motion repeat their last value.

    Such values are late by up to an interval, and their derivative is spikes; left out, they are
    made from the other sensors like those of any channel that is measured at some samples only.
    """
    new: dict[str, np.ndarray] = {}
    for group in _TOGETHER:
        names = [name for name in group if name in log.channels]
        if not names:
            continue
        values = log.stack(tuple(names))
        if usual_interval(values) > 1.0:
            fresh = np.append(True, (np.diff(values, axis=0) != 0.0).any(axis=1))
            new |= {name: np.where(fresh, log[name], np.nan) for name in names}
    return log.replace(channels={**log.channels, **new}) if new else log

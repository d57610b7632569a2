"""What single channels hold beside measurements: noise, outliers, spikes, fills, held values."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from residnet.core.layout import SIX
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
CACHED = 8_192
"""Samples whose neighbours are compared at a time: they stay in a core's cache."""
_FEW, _SPREAD = 40_000, 40
"""Samples of a long channel that tell how far samples usually lie from their neighbours, and in how
many stretches these lie."""


def noise_of(values: np.ndarray) -> float:
    """Return the standard deviation of a channel's white noise, from third differences.

    These hardly see the motion. The differences are taken over the known samples only; 0 where
    there are fewer than 8, or where most third differences vanish.
    """
    known = values[np.isfinite(values)]
    if known.size < 8:
        return 0.0
    return SIGMA_OF_MAD * median(np.abs(np.diff(known, 3))) / math.sqrt(20.0)


def quantiles(values: np.ndarray, *shares: float) -> list[float]:
    """Return quantiles of the numbers in values [T], NaN where there are none.

    They are those of numpy, which takes ten times as long for a short log.
    """
    known = values[~np.isnan(values)]
    if not known.size:
        return [np.nan] * len(shares)
    places = [share * (known.size - 1) for share in shares]
    between = [(math.floor(at), math.ceil(at), at % 1.0) for at in places]
    known.partition([at for low, high, _ in between for at in (low, high)])
    return [float(known[low] + part * (known[high] - known[low])) for low, high, part in between]


def median(values: np.ndarray) -> float:
    """Return the median of the numbers in values [T], NaN where there are none."""
    return quantiles(values, 0.5)[0]


def deviation(values: np.ndarray) -> float:
    """Return the standard deviation of the finite values, NaN where there are none."""
    known = values[np.isfinite(values)]
    if not known.size:
        return np.nan
    off = known - known.sum() / known.size
    return math.sqrt(float(off @ off) / known.size)


def _medians(members: Callable[[slice], list[np.ndarray]], count: int) -> np.ndarray:
    """Return the medians [T] of members, each [T], given for a part of the `count` samples.

    By forgetful selection: of half of them and two more neither the least nor the largest is in
    the middle. Both go, and the next comes, until the middle is left.
    """
    out = np.empty(count)
    for start in range(0, count, CACHED):
        part = slice(start, min(start + CACHED, count))
        rest = members(part)
        some, rest = rest[: len(rest) // 2 + 2], rest[len(rest) // 2 + 2 :]
        while len(some) > 2:
            half = len(some) // 2
            for i in range(half):
                a, b = some[i], some[-1 - i]
                some[i], some[-1 - i] = np.minimum(a, b), np.maximum(a, b)
            # one in the middle of an odd number may be either
            for i in range(1, len(some) - half):
                a, b = some[0], some[i]
                some[0], some[i] = np.minimum(a, b), np.maximum(a, b)
            for i in range(len(some) - 2, half - 1, -1):
                a, b = some[-1], some[i]
                some[-1], some[i] = np.maximum(a, b), np.minimum(a, b)
            some = some[1:-1] + rest[:1]
            rest = rest[1:]
        out[part] = some[0] if len(some) == 1 else 0.5 * (some[0] + some[1])
    return out


def far_from_medians(
    columns: Sequence[np.ndarray], sigmas: float = 6.0, samples: int = 11
) -> list[np.ndarray]:
    """Return for each column [T], [T] bool: known values that stand out of their neighbours.

    The rule is that of the mask `Hampel`; `samples`, made odd, is the number of neighbours. Columns
    are compared side by side: several short ones take hardly longer than one.
    """
    half = samples // 2
    reach, count = 2 * half, 2 * half + 1
    out = [np.zeros(values.size, dtype=bool) for values in columns]
    places = [np.flatnonzero(np.isfinite(values)) for values in columns]
    told = [i for i, at in enumerate(places) if at.size > 2 * reach]
    known = [columns[i][places[i]] for i in told]
    if not known:
        return out

    def neighbours(values: np.ndarray, i: int, k: slice) -> np.ndarray:
        return values[k.start + i : k.stop + i]

    def each(values: np.ndarray, margin: int) -> list[np.ndarray]:
        """Return the part of each column of those that stand one behind the other."""
        starts = np.cumsum([0, *(one.size + 2 * margin for one in known[:-1])])
        return [values[at : at + one.size] for at, one in zip(starts, known, strict=True)]

    # how far samples lie from the straight lines between their neighbours, and how usual that is
    padded = np.concatenate([np.pad(k, reach, mode="reflect", reflect_type="odd") for k in known])
    lines = _medians(
        lambda k: [
            0.5 * (neighbours(padded, i, k) + neighbours(padded, 2 * reach - i, k))
            for i in range(reach)
        ],
        padded.size - 2 * reach,
    )
    off = [one - line for one, line in zip(known, each(lines, reach), strict=True)]
    padded = np.concatenate([np.pad(one, half, mode="reflect") for one in off])
    medians = _medians(
        lambda k: [neighbours(padded, i, k) for i in range(count)], padded.size - 2 * half
    )
    windows = sliding_window_view(padded, count)
    for i, one, bent, middle, around in zip(
        told, known, off, each(medians, half), each(windows, half), strict=True
    ):
        distance = np.abs(bent - middle)
        some = distance[spread_rows(one.size, _FEW, _SPREAD)]
        # a coarse channel flickers by single steps of its resolution, a spread at the level of
        # rounding is none
        resolution = 2.0 * quantiles(some[some > 0.0], 0.1)[0] if some.any() else 0.0
        floor = max(SIGMA_OF_MAD * median(some), resolution, 1e-9 * float(np.abs(one).max()))
        # what a smooth channel bends by anyhow is no outlier where it stops bending
        far = np.flatnonzero(distance > sigmas * np.maximum(floor, np.abs(middle)))
        if far.size:
            usual = np.median(np.abs(around[far] - middle[far, None]), axis=1)
            out[i][places[i][far]] = distance[far] > sigmas * SIGMA_OF_MAD * usual
    return out


def spread_rows(count: int, most: int, stretches: int, about: int | None = None) -> np.ndarray:
    """Return rows [K] of evenly spread stretches, `most` in all; every row of no more than that.

    With a row `about` the stretch nearest to it lies about it.
    """
    if count <= most:
        return np.arange(count)
    size = most // stretches
    first = np.linspace(0, count - size, stretches).astype(int)
    if about is not None:
        begin = min(max(about - size // 2, 0), count - size)
        first[np.argmin(np.abs(first - begin))] = begin
    return np.unique((first[:, None] + np.arange(size)).ravel())


def covered(size: int, starts: np.ndarray, stops: np.ndarray) -> np.ndarray:
    """Return [size] bool, True inside any of the half-open ranges: the way back of `stretches`."""
    marks = np.zeros(size + 1, dtype=np.int64)
    np.add.at(marks, np.clip(starts, 0, size), 1)
    np.add.at(marks, np.clip(stops, 0, size), -1)
    return np.cumsum(marks[:-1]) > 0


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
        cells = _spikes(unwrap(values) if turns else values, name in SIX.names)
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
        if name in SIX.names:
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
    change = np.abs(np.diff(known))
    # of very many samples some tell what is usual
    some = slice(None, None, -(-known.size // _FEW))
    low, high = quantiles(known[some], 0.005, 0.995)
    span, most = high - low, quantiles(change[some], 0.99)[0]
    # a glance: without one large change there is no spike
    largest = float(change.max())
    glance = min(_GLANCE * most, _BEYOND * span) if moved else 0.5 * span
    if largest <= glance or not largest:
        return out
    # what leaves the median of its neighbours makes a step, or three of them do
    near = np.flatnonzero(change > (glance / 3.0 if known.size > _FEW else -1.0))
    seen = np.zeros(known.size, dtype=bool)
    for shift in range(-2, 4):
        seen[np.clip(near + shift, 0, known.size - 1)] = True
    of = np.flatnonzero(seen)
    padded = np.pad(known, 3, mode="edge")

    def apart(of: np.ndarray) -> np.ndarray:
        """Return the distance [K] of samples [K] from the median of seven neighbours."""
        median = _medians(lambda k: [padded[of[k] + i] for i in range(7)], of.size)
        return np.asarray(np.abs(known[of] - median))

    distance, far = np.zeros(known.size), np.zeros(known.size, dtype=bool)
    distance[of] = apart(of)
    beyond = np.maximum(low - known, known - high)
    if moved:
        usual = apart(spread_rows(known.size, _FEW, _SPREAD)) if known.size > _FEW else distance
        # the neighbours of a spike in a steady channel leave their median by a few changes
        least = min(_CHANGES * most, _DISTANCES * quantiles(usual, 0.99)[0])
        # what leaves the whole range of a noisy channel is a spike too
        whole = (beyond > _BEYOND * span) & (distance > _BEYOND * span) & (span > 0.0)
        far = (distance > max(least, _GLANCE * most, 1e-6 * span)) | whole
    else:
        # a display that flickers between its last digits leaves its range by one step of them
        room = 0.5 * span + np.min(change[change > 0.0])
        far = (np.minimum(beyond, distance) > 1.001 * room) if span > 0.0 else beyond < -1.0
    starts, stops = stretches(far)
    single = (stops - starts <= _LONGEST) & (starts > 0) & (stops < known.size)
    out[at] = covered(known.size, starts[single], stops[single])
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
    size = np.abs(values)
    # most columns hold nothing of the kind: one comparison is enough for them
    if not (size >= 99.0).any():
        return np.zeros(values.size, dtype=bool)
    known = np.isfinite(values)
    least = float(np.min(values, where=known, initial=np.inf))
    most = float(np.max(values, where=known, initial=-np.inf))
    # what is far from all else is the least or the largest
    if not _as_filled(np.array([least, most])).any():
        return np.zeros(values.size, dtype=bool)
    candidate = np.zeros(values.size, dtype=bool)
    large = np.flatnonzero(known & (size >= 99.0))
    candidate[large] = _as_filled(values[large])
    rest = values[known & ~candidate]
    if not candidate.any() or not rest.size:
        return np.zeros(values.size, dtype=bool)
    low, high = float(rest.min()), float(rest.max())
    span = high - low
    far: np.ndarray = (values < low - span) | (values > high + span)
    return np.asarray(candidate & far)


def _as_filled(values: np.ndarray) -> np.ndarray:
    """Return [K] bool: values that are a usual fill value."""
    near, out = np.searchsorted(_SORTED, values), np.zeros(values.size, dtype=bool)
    for offset in (-1, 0):
        # single precision keeps seven digits of a fill value
        fill = _SORTED[np.clip(near + offset, 0, _SORTED.size - 1)]
        out |= np.abs(values - fill) <= 2e-7 * np.abs(fill)
    return out


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
    usual = median(every)
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

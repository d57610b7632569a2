"""What several checks need to know of a log: noise, smoothed channels, robust fits, agreement.

A log under examination (`Record`) computes each of them once.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from functools import cache, cached_property
from typing import Any, NamedTuple, TypeVar

import numpy as np

from residnet.core.layout import SIX
from residnet.core.log import Log
from residnet.core.names import ACCELERATION, VELOCITY
from residnet.core.stretches import stretches as runs_of
from residnet.data.channels import (
    CACHED,
    covered,
    deviation,
    far_from_medians,
    median,
    noise_of,
    quantiles,
    spread_rows,
)
from residnet.data.derivatives import local_polynomials
from residnet.data.statistics import FEWEST, Blocks

MEASURED = frozenset((*SIX.names, *ACCELERATION))
"""Channels that a sensor or filter measures; all others drive the vessel."""
STEERING = ("delta", "tau_n", "acting_tau_n", "cmd_delta", "nozzle", "cmd_nozzle")
"""Channels of which a positive value turns the vessel."""
SECTIONS = 20
"""Parts of a log whose errors are taken as independent of each other, and of nothing shorter."""
WINDOW = 15
"""Samples of the parabola that smooths a channel."""

_LONG, _STRETCHES = 40_000, 5
"""Samples of a log beyond which statistics are of as many, and in how many stretches these lie.

By choice; `tests/data/test_relations.py` compares what they say with what all samples say.
"""
_PAUSE = 5
"""Steps between such stretches: more than a grid bridges."""
_T = TypeVar("_T")


class Record:
    """A log under examination, with what checks find out about it computed once.

    Args:
        log: with an increasing clock.
        inputs: channels that drive the vessel.
        seams: times in s at which the later of two stretches begins that are not of one moment.
        few: what `few` is, where it is known; None takes evenly spread stretches of a long log.
        bad: [T] bool, samples whose measured channels are not known; None where all are as logged.
    """

    def __init__(
        self,
        log: Log,
        inputs: Sequence[str] = (),
        seams: np.ndarray | None = None,
        few: Record | None = None,
        bad: np.ndarray | None = None,
    ) -> None:
        self.log, self.t, self.units, self.name = log, log.t, log.units, log.name
        self.inputs, self._seams, self._few = tuple(inputs), seams, few
        self._bad = bad
        self.noise = cache(lambda name: noise_of(self.few[name]))
        """Standard deviation of a channel's white noise."""
        self.std = cache(lambda name: deviation(self[name]))
        """Standard deviation of a channel."""
        self.smooth = cache(lambda name: smoothed(self.t, log[name]))
        """A channel [T] smoothed by a parabola over 15 samples, NaN bridged."""
        self._shared: dict[Hashable, Any] = {}
        self._spikes: dict[str, np.ndarray] = {}

    def __contains__(self, name: object) -> bool:
        return name in self.log.channels

    def __iter__(self) -> Iterator[str]:
        return iter(self.log.channels)

    def __getitem__(self, name: str) -> np.ndarray:
        values = self.log[name]
        if self._bad is None or name not in MEASURED:
            return values
        return np.where(self._bad, np.nan, values)

    def __len__(self) -> int:
        return len(self.log)

    def spikes(self, name: str) -> np.ndarray:
        """Return [T] bool: samples of a channel that stand far out of their neighbours."""
        if name not in self._spikes:
            # as many channels of a short log at once as stay in a core's cache
            some = [n for n in self.measured if n not in self._spikes and n != name]
            some = [name, *some[: CACHED // len(self) - 1]] if len(self) < CACHED else [name]
            found = far_from_medians([self.log[n] for n in some])
            self._spikes.update(zip(some, found, strict=True))
        return self._spikes[name]

    @cached_property
    def step(self) -> float:
        """Usual time between samples in s."""
        return median(np.diff(self.t)[:: max(len(self) // _LONG, 1)])

    @cached_property
    def measured(self) -> list[str]:
        """Channels of the motion, inputs left out."""
        return [name for name in self if name in MEASURED and name not in self.inputs]

    @cached_property
    def moving(self) -> list[str]:
        """Velocities that the log has."""
        return [name for name in VELOCITY if name in self]

    @cached_property
    def speed(self) -> float:
        """Root mean square of the speed where it is known, m/s; 0 where it is not."""
        square = self["u"] ** 2 + self["v"] ** 2 if "u" in self and "v" in self else np.zeros(1)
        return float(np.sqrt(np.nanmean(square))) if np.isfinite(square).any() else 0.0

    @cached_property
    def few(self) -> Record:
        """Stretches of a long log, evenly spread, one a short pause after the other; a short log
        itself. Statistics are told by them; what single samples do is told by all rows.
        """
        if self._few is not None:
            return self._few
        return self if self._seams is not None else self._of_rows(self.few_rows)

    @cached_property
    def few_rows(self) -> np.ndarray:
        """Rows [K] that `few` holds, all of a short log."""
        return spread_rows(len(self), _LONG, _STRETCHES)

    def near(self, at: np.ndarray) -> tuple[np.ndarray, Record]:
        """Return rows [K] and their record as `few` has them, one stretch about samples at [T].

        Of several runs of such samples it is about the longest.
        """
        starts, stops = runs_of(at)
        longest = int(np.argmax(stops - starts))
        rows = spread_rows(len(self), _LONG, _STRETCHES, int(starts[longest] + stops[longest]) // 2)
        part = self._of_rows(rows)
        return rows, part if self._bad is None else part.without(self._bad[rows])

    def _of_rows(self, rows: np.ndarray) -> Record:
        if rows.size == len(self):
            return self
        log = self.log.rows(rows)
        first = np.append(True, np.diff(rows) > 1)
        shift = np.where(first, np.diff(log.t, prepend=log.t[0]) - _PAUSE * self.step, 0.0)
        shift[0] = 0.0
        log = log.replace(t=log.t - np.cumsum(shift))
        # no increment leads from one stretch to the next
        seams = log.t[np.flatnonzero(first)[1:]]
        return Record(log, self.inputs, seams).without(first)

    def on(self, grid: Log) -> Record:
        """Return the record of the same samples on a grid."""
        return Record(grid, self.inputs, self._seams)

    def told_by(self, few: Record, log: Log) -> Record:
        """Return the record of the same samples as another log holds them, with `few` of them."""
        return Record(log, self.inputs, self._seams, few, self._bad)

    def torn(self, reach: int) -> np.ndarray:
        """Return [T] bool: samples within so many of where two stretches meet."""
        at = np.searchsorted(self.t, np.zeros(0) if self._seams is None else self._seams)
        return covered(len(self), at - reach - _PAUSE, at + reach)

    def of(self, statistic: Callable[..., _T], *about: Hashable) -> _T:
        """Return a statistic of this record, `statistic(record, *about)`, computed once."""
        key = (statistic, *about)
        if key not in self._shared:
            self._shared[key] = statistic(self, *about)
        found: _T = self._shared[key]
        return found

    def without(self, bad: np.ndarray) -> Record:
        """Return the record with NaN in the measured channels where bad [T]."""
        if not bad.any():
            return self
        if len(self) > _LONG:
            # copies of all channels of a long log would be as large again
            few = self.few.without(bad[self.few_rows])
            return Record(self.log, self.inputs, self._seams, few, bad)
        channels = {
            name: np.where(bad, np.nan, values) if name in MEASURED else values
            for name, values in self.log.channels.items()
        }
        return Record(self.log.replace(channels=channels), self.inputs, self._seams)


def bridged(t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return values [T] with straight lines where some are missing, 0 where all are."""
    known = np.isfinite(values)
    if known.all():
        return values
    return np.interp(t, t[known], values[known]) if known.any() else np.zeros(values.size)


def smoothed(t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return values [T] smoothed by a parabola over 15 samples, NaN bridged by sample."""
    filled = bridged(np.arange(t.size), values)
    return local_polynomials(filled[:, None], WINDOW, 2, 1.0)[0][:, 0]


def averaged(values: np.ndarray, samples: int) -> np.ndarray:
    """Return the moving average [T] over so many samples, NaN left out; NaN where none is known."""
    size, known = min(samples, values.size), np.isfinite(values)
    ends = size // 2, (size - 1) // 2
    sums = (np.cumsum(part) for part in (known, np.where(known, values, 0.0)))
    padded = (np.pad(np.append(0.0, part), ends, mode="edge") for part in sums)
    count, total = (part[size:] - part[:-size] for part in padded)
    return np.where(count > 0.5, total / np.maximum(count, 1.0), np.nan)


def high(values: np.ndarray, share: float = 0.95) -> float:
    """Return the size that a channel reaches, by a quantile of its absolute values."""
    size = np.abs(values)
    return float(np.nanmax(size)) if share == 1.0 else quantiles(size, share)[0]


def reversals(heading: np.ndarray, swing: float) -> int:
    """Return how often a heading [T] rad turns round after having gone `swing` rad one way."""
    fall, rise = np.maximum.accumulate(heading) - heading, heading - np.minimum.accumulate(heading)
    if min(fall.max(), rise.max()) < swing:
        return 0
    # where it goes the same way on, nothing turns
    change = np.diff(heading, prepend=heading[0], append=heading[-1])
    way = np.sign(change)
    count, going, low, high = 0, 0, float(heading[0]), float(heading[0])
    for here in heading[way[1:] * way[:-1] <= 0.0].tolist():
        if going >= 0 and high - here >= swing:
            count, going, low = count + going, -1, here
        elif going <= 0 and here - low >= swing:
            count, going, high = count - going, 1, here
        low, high = min(low, here), max(high, here)
    return count


def resolution_of(values: np.ndarray) -> float:
    """Return the least step between the values of a channel; 0 where it has no grid."""
    change = np.abs(np.diff(values))
    change = change[np.isfinite(change) & (change > 0.0)]
    if change.size < FEWEST:
        return 0.0
    least = quantiles(change, 0.01)[0]
    steps = change / least
    return least if float((np.abs(steps - np.round(steps)) < 0.02).mean()) > 0.95 else 0.0


class Fit(NamedTuple):
    """A least-squares fit: values [k], their covariance [k, k], what is left of known rows [N]."""

    values: np.ndarray
    spread: np.ndarray
    rest: np.ndarray

    @property
    def left(self) -> float:
        """Sum of squares of what is left."""
        return float(self.rest @ self.rest)

    @property
    def errors(self) -> np.ndarray:
        """Standard errors [k]."""
        return np.sqrt(np.maximum(np.diag(self.spread), 1e-300))

    @property
    def sure(self) -> float:
        """The last value in its standard errors."""
        return float(self.values[-1] / self.errors[-1])


def fit(x: np.ndarray, y: np.ndarray) -> Fit:
    """Return y [N] fitted by the columns of x [N, k], over the rows that are known.

    The covariance is a sandwich over sections: what filters leave hangs together, but not for
    longer than a twentieth of the log. A column of zeros keeps a coefficient of zero.
    """
    known = np.isfinite(x).all(axis=1) & np.isfinite(y)
    x, y = x[known], y[known]
    length = np.linalg.norm(x, axis=0)
    size = np.where(length > 0.0, length, 1.0)
    x = x / size
    inverse = np.linalg.pinv(x.T @ x, rcond=1e-10)
    values = inverse @ (x.T @ y)
    rest = y - x @ values
    total = np.concatenate((np.zeros((1, values.size)), np.cumsum(x * rest[:, None], axis=0)))
    scores = np.diff(total[_bounds(rest.size)], axis=0)
    covariance = inverse @ (scores.T @ scores) @ inverse
    return Fit(values / size, covariance / np.outer(size, size), rest)


def _bounds(count: int) -> np.ndarray:
    """Return the rows [SECTIONS + 1] at which sections meet; the first ones may hold a row more."""
    size, longer = divmod(count, SECTIONS)
    at = np.arange(SECTIONS + 1)
    return at * size + np.minimum(at, longer)


# a block covers so many samples and so many seconds at least
_BLOCK_SAMPLES, _BLOCK_SECONDS = 16, 3.0
# blocks begin so many times in the length of one
_OVERLAP = 4
# blocks of a long log that are looked at, evenly spread: more tell the same
_MOST_BLOCKS = 5_000
# over a block each velocity changes by so many standard deviations of its noise, where it can
_OVER_NOISE = 10.0


def blocks_of(log: Record, *moving: str) -> Blocks:
    """Return blocks over which some velocities change by more than their noise."""
    least = max(_BLOCK_SAMPLES, round(_BLOCK_SECONDS / log.step))
    size = min(3 * least, max(least, len(log) // 20))
    for longer in (least, 2 * least, 3 * least):
        if longer > len(log) // 20:
            break
        within = ~log.torn(longer)[longer:]
        changes = {n: (log[n][longer:] - log[n][:-longer])[within] for n in moving}
        over = [
            deviation(change) / max(log.noise(name), 1e-12)
            for name, change in changes.items()
            if np.isfinite(change).any()
        ]
        if min(over, default=_OVER_NOISE) >= _OVER_NOISE:
            size = longer
            break
    stride = max(size // _OVERLAP, (len(log) - size) // _MOST_BLOCKS, 1)
    return Blocks(log.t, np.arange(0, len(log) - size, stride), size)


def of_motion(velocity: Mapping[str, np.ndarray]) -> list[np.ndarray]:
    """Return terms of second degree in velocities."""
    columns = [*velocity.values(), *(values * np.abs(values) for values in velocity.values())]
    if "u" in velocity:
        columns += [velocity["u"] * velocity[name] for name in ("v", "r") if name in velocity]
    if "v" in velocity and "r" in velocity:
        columns.append(velocity["v"] * velocity["r"])
    return columns


def of_inputs(
    driving: Sequence[np.ndarray], u: np.ndarray | None, *, linear: bool
) -> list[np.ndarray]:
    """Return terms of second degree that hold inputs; `u` is the speed ahead."""
    if linear:
        return [*driving]
    flow = [] if u is None else [u * np.abs(u) * values for values in driving]
    return [*driving, *(values * np.abs(values) for values in driving), *flow]

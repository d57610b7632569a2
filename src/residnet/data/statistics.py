"""How one channel follows another, and equations of motion integrated over blocks of samples."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

FEWEST = 50
"""Samples below which nothing is compared."""
AT_ONCE = 40_000
"""Samples that are shifted at a time: each of some ten columns stays in a core's cache."""
_MOST_SAMPLES = 20_000
"""Samples that a lag is looked for in, evenly spread: more tell the same."""


@dataclass(frozen=True)
class Blocks:
    """Overlapping blocks of a log over which equations of motion are integrated.

    Noise then needs no derivative and averages out.

    Attributes:
        t: times of the log [T].
        first: sample at which each block begins [K].
        size: number of samples in a block.
    """

    t: np.ndarray
    first: np.ndarray
    size: int

    def change(self, values: np.ndarray, shift: ArrayLike = 0) -> np.ndarray:
        """Return the changes [K, ...] of values [T, ...] over the blocks, `shift` samples early.

        Of several shifts [S] they are [K, S, ...].
        """
        first = np.subtract.outer(self.first, shift)
        return np.asarray(values[first + self.size] - values[first])

    def clear_of(self, bad: np.ndarray, shift: ArrayLike = 0) -> np.ndarray:
        """Return the blocks [K, ...] bool that touch none of the samples bad [T, ...]."""
        count = np.zeros((len(bad) + 1, *bad.shape[1:]), dtype=int)
        np.cumsum(bad, axis=0, out=count[1:])
        first = np.subtract.outer(self.first, shift)
        return np.asarray(count[first + self.size + 1] == count[first])

    def integrals(self, table: np.ndarray) -> Callable[[ArrayLike], np.ndarray]:
        """Return the integrals of columns [T, ...] over the blocks, by shift as of `change`.

        They are NaN where a sample of the block is.
        """
        bad, total = ~np.isfinite(table), np.zeros(table.shape)
        spoilt = bool(bad.any())
        filled = np.where(bad, 0.0, table) if spoilt else table
        half = 0.5 * np.diff(self.t).reshape(-1, *(1 for _ in table.shape[1:]))
        np.cumsum(half * (filled[1:] + filled[:-1]), axis=0, out=total[1:])

        def at(shift: ArrayLike) -> np.ndarray:
            clear = self.clear_of(bad, shift) if spoilt else True
            return np.where(clear, self.change(total, shift), np.nan)

        return at


class Agreement(NamedTuple):
    """How one channel follows another.

    Attributes:
        correlation: means removed, at the lag where it is largest.
        gain: least squares through the origin at that lag.
        lag: in s, positive where the channel trails.
        spread: standard deviation of the reference.
    """

    correlation: float
    gain: float
    lag: float
    spread: float


def agreement(reference: np.ndarray, measured: np.ndarray, step: float) -> Agreement | None:
    """Return how `measured` [T] follows `reference` [T], at lags of up to 3 s.

    None where fewer than 50 samples can be compared at all lags, or either does not vary.
    """
    reach = max(round(3.0 / step), 10)
    if reference.size < 2 * reach + FEWEST:
        return None
    # the same samples for every lag, or the comparison of lags would be one of samples
    lost = np.append(0, np.cumsum(~np.isfinite(measured)))
    known = lost[2 * reach + 1 :] == lost[: -2 * reach - 1]
    at = np.flatnonzero(np.isfinite(reference[reach:-reach]) & known) + reach
    if at.size < FEWEST:
        return None
    at = at[:: -(-at.size // _MOST_SAMPLES)]
    a, lags = reference[at], np.arange(-reach, reach + 1)
    spread, std, values = float(a.std()), np.empty(lags.size), np.empty(lags.size)
    for some in np.array_split(lags, -(-lags.size * at.size // AT_ONCE)):
        there = measured[at + some[:, None]]
        std[some + reach], values[some + reach] = there.std(axis=1), there @ (a - a.mean())
    if spread == 0.0 or std.min() <= 1e-12 * np.nanmax(np.abs(measured)):
        return None
    values /= at.size * spread * std
    best = int(np.argmax(np.abs(values)))
    shift = 0.0
    if 0 < best < 2 * reach:
        before, peak, after = np.abs(values[best - 1 : best + 2])
        curvature = before - 2.0 * peak + after
        shift = 0.5 * (before - after) / curvature if curvature < 0.0 else 0.0
    gain = float(a @ measured[at + lags[best]] / (a @ a))
    return Agreement(float(values[best]), gain, (best - reach + shift) * step, spread)

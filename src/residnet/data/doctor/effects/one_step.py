"""A cheap one-step fit: the change of the velocities over a few seconds, by least squares.

Each row is the integral of the equation of motion over a block of a few seconds. Noise then needs
no derivative and averages out, so that the fit tells more of the data and less of the smoothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from residnet.core.log import Log
from residnet.core.names import VELOCITY
from residnet.data.doctor.signals import noise_of

# a block covers so many samples and so many seconds at least
_FEWEST_SAMPLES = 16
_BLOCK = 3.0
# blocks begin so many times in the length of one
_OVERLAP = 4
# beyond so many inputs each enters linearly only
_FEW_INPUTS = 4
_RIDGE = 1e-6
# over a block each velocity changes by so many standard deviations of its noise, where it can
_OVER_NOISE = 10.0


class OneStep:
    """The rows of a one-step fit to one log.

    Args:
        log: with an increasing clock.
        inputs: channels that drive the vessel.
        size: number of samples in a block; None takes what the noise asks for.

    Attributes:
        moving: the velocities that the log has.
        first: index of the sample at which each block begins [K].
        size: number of samples in a block.
        table: regressors [K, k], integrated over the blocks.
        change: of the velocities over the blocks [K, n].
    """

    def __init__(self, log: Log, inputs: Sequence[str], size: int | None = None) -> None:
        step = float(np.median(np.diff(log.t)))
        self.moving = [name for name in VELOCITY if name in log.channels]
        self.size = _block(log, self.moving, step) if size is None else size
        velocity = {name: log[name] for name in self.moving}
        first = np.arange(0, len(log) - self.size, max(self.size // _OVERLAP, 1))
        table = regressors(velocity, {name: log[name] for name in inputs}, len(log))
        table = integrals(table, log.t, first, self.size)
        change = np.stack(list(velocity.values()) or [np.zeros(len(log))], axis=-1)
        change = change[first + self.size] - change[first]
        long = log.t[first + self.size] - log.t[first] > (self.size + 3.0) * step
        known = np.isfinite(table).all(axis=1) & np.isfinite(change).all(axis=1) & ~long
        self.first, self.table, self.change = first[known], table[known], change[known]

    def __len__(self) -> int:
        return int(self.first.size)

    def apart_from(self, at: np.ndarray) -> np.ndarray:
        """Return the rows [K] bool that touch none of the samples at [T]."""
        count = np.append(0, np.cumsum(at))
        clear: np.ndarray = count[self.first + self.size + 1] == count[self.first]
        return clear

    def fit(self, rows: np.ndarray) -> np.ndarray:
        """Return the coefficients [k, n] of a ridge fit to rows [K] bool."""
        x, y = self.table[rows], self.change[rows]
        size = np.maximum(np.sqrt(np.mean(x**2, axis=0)), 1e-300)
        x = x / size
        count = max(int(rows.sum()), 1)
        gram, moments = x.T @ x / count, x.T @ y / count
        coefficients: np.ndarray = np.linalg.solve(gram + _RIDGE * np.eye(x.shape[1]), moments)
        return np.asarray(coefficients / size[:, None])

    def residual(self, fitted: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """Return what a fit leaves of each velocity's changes [n], root mean square."""
        at = np.ones(len(self), dtype=bool) if rows is None else rows
        left: np.ndarray = np.sqrt(
            np.mean((self.change[at] - self.table[at] @ fitted) ** 2, axis=0)
        )
        return left

    def apart(self, one: np.ndarray, other: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return how far the predictions of two fits lie apart [n], root mean square."""
        distance: np.ndarray = np.sqrt(np.mean((self.table[rows] @ (one - other)) ** 2, axis=0))
        return distance

    @property
    def spread(self) -> np.ndarray:
        """Standard deviation of the changes of each velocity [n]."""
        return np.asarray(np.maximum(self.change.std(axis=0), 1e-12))


def blocks_of(log: Log, moving: Sequence[str]) -> tuple[np.ndarray, int]:
    """Return the first samples [K] of overlapping blocks, and their size, for some velocities."""
    size = _block(log, moving, float(np.median(np.diff(log.t))))
    return np.arange(0, len(log) - size, max(size // _OVERLAP, 1)), size


def _block(log: Log, moving: Sequence[str], step: float) -> int:
    """Return the number of samples over which the velocities change by more than their noise."""
    least = max(_FEWEST_SAMPLES, round(_BLOCK / step))
    for factor in (1, 2, 3):
        size = factor * least
        if size > len(log) // 20:
            break
        changes = {name: log[name][size:] - log[name][:-size] for name in moving}
        least_change = [
            float(np.nanstd(change)) / max(noise_of(log[name]), 1e-12)
            for name, change in changes.items()
            if np.isfinite(change).any()
        ]
        if min(least_change, default=_OVER_NOISE) >= _OVER_NOISE:
            return size
    return min(3 * least, max(least, len(log) // 20))


def integrals(table: np.ndarray, t: np.ndarray, first: np.ndarray, size: int) -> np.ndarray:
    """Return the integrals [K, k] of columns [T, k] over blocks of `size` samples from `first` [K].

    They are NaN where a sample of the block is.
    """
    bad = ~np.isfinite(table).all(axis=1)
    filled = np.where(bad[:, None], 0.0, table)
    area = 0.5 * np.diff(t)[:, None] * (filled[1:] + filled[:-1])
    total = np.concatenate((np.zeros((1, table.shape[1])), np.cumsum(area, axis=0)))
    count = np.append(0, np.cumsum(bad))
    out: np.ndarray = np.asarray(total[first + size] - total[first])
    out[count[first + size + 1] > count[first]] = np.nan
    return out


def regressors(
    velocity: Mapping[str, np.ndarray], inputs: Mapping[str, np.ndarray], count: int
) -> np.ndarray:
    """Return a polynomial [T, k] of second degree in velocities and inputs that knows no vessel."""
    columns = [np.ones(count), *velocity.values()]
    columns += [values * np.abs(values) for values in velocity.values()]
    if "u" in velocity:
        columns += [velocity["u"] * velocity[name] for name in ("v", "r") if name in velocity]
    if "v" in velocity and "r" in velocity:
        columns.append(velocity["v"] * velocity["r"])
    driving = [values for values in inputs.values() if np.nanstd(values) > 0.0]
    columns += driving
    if len(driving) <= _FEW_INPUTS:
        columns += [values * np.abs(values) for values in driving]
        if "u" in velocity:
            columns += [velocity["u"] * np.abs(velocity["u"]) * values for values in driving]
    return np.stack(columns, axis=-1)

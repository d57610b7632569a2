"""Slow sensors whose last value is repeated, sample after sample, until the next one."""

from __future__ import annotations

import numpy as np

from residnet.core.log import Log

_TOGETHER = (("x", "y"), ("u", "v"), ("psi",), ("r",))
"""Channels that come from one sensor: either may rest at a new measurement, both hardly ever do."""
_FEWEST = 20
"""Intervals between measurements that are needed to tell their rule."""
_ALIKE, _REGULAR = 0.25, 0.9
"""So large a share of the intervals is the usual one, within this share of it."""


def usual_interval(values: np.ndarray) -> float:
    """Return after how many samples channels [T] or [T, k] change; 1 where there is no rule."""
    moved = np.diff(values, axis=0) != 0.0
    every = np.diff(np.flatnonzero(moved if moved.ndim == 1 else moved.any(axis=1)))
    if every.size < _FEWEST:
        return 1.0
    usual = float(np.median(every))
    regular = float((np.abs(every - usual) <= _ALIKE * usual).mean()) >= _REGULAR
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

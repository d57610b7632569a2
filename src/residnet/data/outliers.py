"""Samples of one channel that stand out: far from their neighbours, or after a large step."""

from __future__ import annotations

import numpy as np

from residnet.core.log import Log
from residnet.data.readers.base import unwrap

# standard deviations of a Gaussian in its median absolute deviation
SIGMA_OF_MAD = 1.4826


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

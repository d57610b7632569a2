"""What every check needs of a channel: its noise, its spikes, runs of equal samples."""

from __future__ import annotations

import numpy as np

from residnet.data.outliers import far_from_median

MEASURED = ("x", "y", "psi", "u", "v", "r", "phi", "p", "u_dot", "v_dot", "r_dot")
"""Channels that a sensor or filter measures; all others drive the vessel."""

# standard deviations of a Gaussian in its median absolute deviation
_SIGMA = 1.4826


def noise_of(values: np.ndarray) -> float:
    """Return the standard deviation of a channel's white noise, from third differences.

    These hardly see the motion.

    The differences are taken over the known samples only; 0 where there are fewer than 8, or where
    most third differences vanish.
    """
    known = values[np.isfinite(values)]
    if known.size < 8:
        return 0.0
    return float(_SIGMA * float(np.median(np.abs(np.diff(known, 3)))) / np.sqrt(20.0))


def spikes(values: np.ndarray) -> np.ndarray:
    """Return [T] bool: samples that stand far out of their neighbours.

    The rule is that of the mask `hampel` with its defaults.
    """
    return far_from_median(values, 6.0, 11)


def averaged(values: np.ndarray, samples: int) -> np.ndarray:
    """Return the moving average [T] over so many samples, NaN left out; NaN where none is known."""
    kernel = np.ones(min(samples, values.size))
    known = np.isfinite(values)
    count = np.convolve(known, kernel, mode="same")
    total = np.convolve(np.where(known, values, 0.0), kernel, mode="same")
    return np.where(count > 0.5, total / np.maximum(count, 1.0), np.nan)


def without(values: np.ndarray, bad: np.ndarray) -> np.ndarray:
    """Return the values [T] with NaN where bad [T]."""
    return np.where(bad, np.nan, values)

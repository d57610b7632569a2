"""Autoregressive residuals of unit variance, and how often an interval holds the truth."""

from __future__ import annotations

import math

import numpy as np
from scipy.signal import lfilter

from residnet.evaluation.goodness import block_bootstrap_interval, independent_confidence_interval


def autoregressive(phi: float, count: int, length: int, seed: int) -> np.ndarray:
    """[count, length], the beginning left out."""
    noise = np.random.default_rng(seed).normal(size=(count, length + 300))
    series: np.ndarray = lfilter([1.0], [1.0, -phi], noise, axis=1)
    return series[:, 300:] * math.sqrt(1 - phi**2)


def coverage(phi: float, count: int, length: int, seed: int) -> dict[str, float]:
    """Share of intervals that hold the truth: of the mean absolute residual and of the mean, by
    blocks and as if samples were independent.
    """
    series = autoregressive(phi, count, length, seed)
    truth = math.sqrt(2 / math.pi)
    held = {"mae": 0, "mean": 0, "mae independent": 0, "mean independent": 0}
    for row in series:
        for name, values, level in (("mae", np.abs(row), truth), ("mean", row, 0.0)):
            found = block_bootstrap_interval([values])
            low, high = independent_confidence_interval(values)
            held[name] += found.lower <= level <= found.upper
            held[f"{name} independent"] += low <= level <= high
    return {name: number / count for name, number in held.items()}

"""Intervals of mean errors by a block bootstrap.

Windows of one log resemble each other, so that whole blocks of them are drawn.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from scipy import stats

_LEVEL = 0.95
_RESAMPLES = 10_000
_LOGS = 5
_FEW_LOGS = 3
_LEAST_BLOCKS = 5
_WANTED_BLOCKS = 8


@dataclass(frozen=True)
class Blocks:
    """What is drawn together.

    Attributes:
        labels: number of each window's block, [W], from 0 on.
        of: `logs` where a block is all windows of a log, else `windows`: consecutive windows of one
            log.
        count: number of blocks.
    """

    labels: np.ndarray
    of: str
    count: int

    def row(self) -> dict[str, Any]:
        """Return the blocks as they stand in metrics.json."""
        return {"of": self.of, "count": self.count}


def blocks(logs: Sequence[int] | np.ndarray) -> Blocks | None:
    """Return blocks of windows from the number of the log that each comes from.

    Windows of a log are in time order.

    From five logs on a block is a log: the interval then speaks for other logs, whatever the
    windows of one have in common. Of three or four logs the mean cannot be resampled so; each is
    cut into as few equal runs of consecutive windows as make at least eight blocks, and the
    interval holds only as far as what lies between logs is small against what lies between such
    runs. None, and so no interval, where there are fewer than three logs or five blocks.
    """
    numbers = np.asarray(logs, dtype=int)
    names, sizes = np.unique(numbers, return_counts=True)
    if len(names) >= _LOGS:
        return Blocks(np.searchsorted(names, numbers), "logs", len(names))
    if len(names) < _FEW_LOGS:
        return None
    length = int(sizes.max())
    while length > 1 and sum(math.ceil(size / length) for size in sizes) < _WANTED_BLOCKS:
        length -= 1
    labels, count = np.zeros(len(numbers), dtype=int), 0
    for name, size in zip(names, sizes, strict=True):
        for run in np.array_split(np.flatnonzero(numbers == name), math.ceil(size / length)):
            labels[run] = count
            count += 1
    return Blocks(labels, "windows", count) if count >= _LEAST_BLOCKS else None


def intervals(values: np.ndarray, blocks: Blocks | None) -> list[list[float] | None]:
    """Return 95 % intervals of the means of columns [W, C] over windows, [low, high] of each.

    None where there are no blocks.

    Percentile bootstrap over blocks drawn with replacement, with a fixed seed, at levels widened
    for few blocks as Student's t is against the normal distribution (Hesterberg 2015, The American
    Statistician 69, 371-386, section 5.3): plain percentiles cover some 83 % with five blocks.
    """
    if blocks is None:
        return [None] * values.shape[1]
    sums = np.stack(
        [np.bincount(blocks.labels, column, blocks.count) for column in values.T], axis=1
    )
    draws = _draws(blocks.count)
    means = (draws @ sums) / (draws @ np.bincount(blocks.labels, minlength=blocks.count))[:, None]
    low = tail(blocks.count)
    return [
        [float(lower), float(upper)]
        for lower, upper in np.quantile(means, [low, 1 - low], axis=0).T
    ]


def tail(count: int) -> float:
    """Return the share of resampled means left out at either end, for at least 2 blocks.

    It is 0.025 for many blocks and less for few.
    """
    wide = math.sqrt(count / (count - 1)) * stats.t.ppf(0.5 + _LEVEL / 2, count - 1)
    return float(stats.norm.cdf(-wide))


@lru_cache(maxsize=16)
def _draws(count: int) -> np.ndarray:
    """How often each block is drawn, [resamples, count]."""
    return (
        np.random.default_rng(0)
        .multinomial(count, np.full(count, 1 / count), size=_RESAMPLES)
        .astype(float)
    )


def difference(
    model: np.ndarray, reference: np.ndarray, to: str, blocks: Blocks | None
) -> dict[str, Any]:
    """Return the paired difference of two models' mean errors, as in metrics.json.

    Both are over the same windows.

    Args:
        model: error of each window, [W].
        reference: error of the reference model over the same windows, [W].
        to: its name.
        blocks: what is drawn together.

    Returns:
        to; nrmse_mean, the mean of model minus reference (negative where the model is better), with
        its interval ci95 (None where there is none) and excludes_zero; ratio of the means (None
        where the reference has no error) and worse, a ratio above 1.05.
    """
    apart = model - reference
    (interval,) = intervals(apart[:, None], blocks)
    level = float(reference.mean())
    ratio = float(model.mean()) / level if level > 0 else None
    return {
        "to": to,
        "nrmse_mean": float(apart.mean()),
        "ci95": interval,
        "excludes_zero": interval is not None and (interval[0] > 0 or interval[1] < 0),
        "ratio": ratio,
        "worse": ratio is not None and ratio > 1.05,
    }

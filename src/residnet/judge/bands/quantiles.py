"""Weighted quantiles of scores from few logs, with a correction for how few they are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

_PER_LOG = 5.0
"""Independent scores that a log holds at most, as far as it has so many runs."""


def run_weights(names: Sequence[str]) -> np.ndarray:
    """Return the weight of each run [W]; those of a log weigh the root of their number together.

    Long logs would otherwise speak for the short ones, whose manoeuvres are often the livelier.
    """
    _, place, count = np.unique(names, return_inverse=True, return_counts=True)
    weight = 1.0 / np.sqrt(count[place])
    return np.asarray(weight / weight.sum())


def quantile(scores: np.ndarray, weight: np.ndarray, level: float) -> np.ndarray:
    """Return the smallest score [...] that at least a share `level` of the weight lies below.

    Args:
        scores: [W, ...]; NaN counts nowhere.
        weight: of each run [W].
        level: between 0 and 1.
    """
    seen = np.isfinite(scores)
    order = np.argsort(np.where(seen, scores, np.inf), axis=0)
    ranked = np.take_along_axis(np.where(seen, scores, np.inf), order, axis=0)
    shaped = weight.reshape(-1, *(1 for _ in scores.shape[1:]))
    share = np.take_along_axis(np.where(seen, shaped, 0.0), order, axis=0)
    below = np.cumsum(share, axis=0)
    below /= np.maximum(below[-1:], 1e-300)
    first = (below >= min(level, 1.0) - 1e-9).argmax(axis=0)
    found = np.take_along_axis(ranked, first[None], axis=0)[0]
    return np.asarray(np.where(seen.any(axis=0), found, np.nan))


def independent(
    inside: np.ndarray, weight: np.ndarray, names: Sequence[str], level: float
) -> float:
    """Return how many independent scores the runs hold, from how logs differ in their coverage.

    Args:
        inside: share of each run's samples that a quantile holds [W]; NaN where nothing is scored.
        weight: of each run [W].
        names: of its log.
        level: of the quantile.
    """
    _, place = np.unique(names, return_inverse=True)
    count = int(place.max()) + 1
    known = np.isfinite(inside)
    total = np.bincount(place, weight * known, count)
    held = np.bincount(place, weight * np.where(known, inside, 0.0), count)
    kept = total > 0
    own, share = held[kept] / total[kept], total[kept] / total.sum()
    if len(own) < 2:
        return 1.0
    mean = float((share * own).sum())
    variance = float((share**2 * (own - mean) ** 2).sum()) * len(own) / (len(own) - 1)
    number = level * (1.0 - level) / max(variance, 1e-12)
    most = min(_PER_LOG * len(own), int(known.sum()))
    return float(np.clip(number, 1.0, most))


def corrected(level: float, number: float) -> float:
    """Return the level whose quantile of so many scores holds a new score at `level`.

    Source: split conformal prediction, the smallest of the (n + 1) level-th scores of n.
    """
    return min(level * (1.0 + 1.0 / number), 1.0)

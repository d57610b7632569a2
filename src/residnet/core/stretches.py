"""Contiguous stretches of samples: the one place that finds where they begin and end."""

from __future__ import annotations

import numpy as np


def stretches(labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first index [S] and the index past the last [S] of every stretch.

    Args:
        labels: of each sample [T]. Of bool, a stretch is a run of True; of int, a run of one and
            the same number, where negative numbers belong to no stretch.
    """
    numbers = np.where(labels, 0, -1) if labels.dtype == bool else labels
    if numbers.size == 0:
        return np.zeros(0, dtype=int), np.zeros(0, dtype=int)
    bounds = np.concatenate(([0], np.flatnonzero(np.diff(numbers)) + 1, [numbers.size]))
    inside = numbers[bounds[:-1]] >= 0
    return bounds[:-1][inside], bounds[1:][inside]


def stretch_numbers(labels: np.ndarray) -> np.ndarray:
    """Return the number of each sample's stretch [T], counted from 0; -1 where it is in none.

    Args:
        labels: of each sample, as for `stretches`.
    """
    starts, stops = stretches(labels)
    numbers = np.full(labels.size, -1)
    numbers[_inside(labels)] = np.repeat(np.arange(starts.size), stops - starts)
    return numbers


def stretch_bounds(labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where each sample's stretch begins [T] and the index past its end [T].

    A sample that is in no stretch has its own index for both.

    Args:
        labels: of each sample, as for `stretches`.
    """
    starts, stops = stretches(labels)
    begins, ends, inside = np.arange(labels.size), np.arange(labels.size), _inside(labels)
    begins[inside] = np.repeat(starts, stops - starts)
    ends[inside] = np.repeat(stops, stops - starts)
    return begins, ends


def _inside(labels: np.ndarray) -> np.ndarray:
    return labels if labels.dtype == bool else labels >= 0

"""Contiguous stretches of samples: the one place that finds where they begin and end."""

from __future__ import annotations

import numpy as np


def find_runs(labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first index [S] and the index past the last [S] of every stretch.

    Args:
        labels: of each sample [T]. Of bool, a stretch is a run of True; of int, a run of one and
            the same number, where negative numbers belong to no stretch.
    """
    run_labels = np.where(labels, 0, -1) if labels.dtype == bool else labels
    if run_labels.size == 0:
        return np.zeros(0, dtype=int), np.zeros(0, dtype=int)
    boundaries = np.concatenate(([0], np.flatnonzero(np.diff(run_labels)) + 1, [run_labels.size]))
    is_run = run_labels[boundaries[:-1]] >= 0
    return boundaries[:-1][is_run], boundaries[1:][is_run]


def number_runs(labels: np.ndarray) -> np.ndarray:
    """Return the number of each sample's stretch [T], counted from 0; -1 where it is in none.

    Args:
        labels: of each sample, as for `find_runs`.
    """
    starts, stops = find_runs(labels)
    run_numbers = np.full(labels.size, -1)
    run_numbers[_is_in_run(labels)] = np.repeat(np.arange(starts.size), stops - starts)
    return run_numbers


def find_run_bounds(labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where each sample's stretch begins [T] and the index past its end [T].

    A sample that is in no stretch has its own index for both.

    Args:
        labels: of each sample, as for `find_runs`.
    """
    starts, stops = find_runs(labels)
    run_starts, run_ends, is_in_run = (
        np.arange(labels.size),
        np.arange(labels.size),
        _is_in_run(labels),
    )
    run_starts[is_in_run] = np.repeat(starts, stops - starts)
    run_ends[is_in_run] = np.repeat(stops, stops - starts)
    return run_starts, run_ends


def _is_in_run(labels: np.ndarray) -> np.ndarray:
    return labels if labels.dtype == bool else labels >= 0

"""Runs: contiguous stretches of equally labelled samples."""

from __future__ import annotations

import numpy as np


def find_runs(labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the start index [S] and the end index (exclusive) [S] of every run.

    Args:
        labels: label of each sample [T]. For bool, a run is a sequence of True; for int, a
            sequence of one number, where negative numbers belong to no run.
    """
    run_labels = np.where(labels, 0, -1) if labels.dtype == bool else labels
    if run_labels.size == 0:
        return np.zeros(0, dtype=int), np.zeros(0, dtype=int)
    boundaries = np.concatenate(([0], np.flatnonzero(np.diff(run_labels)) + 1, [run_labels.size]))
    is_run = run_labels[boundaries[:-1]] >= 0
    return boundaries[:-1][is_run], boundaries[1:][is_run]


def number_runs(labels: np.ndarray) -> np.ndarray:
    """Return the number of the run of each sample [T], counted from 0; -1 outside of runs.

    Args:
        labels: label of each sample, as for `find_runs`.
    """
    starts, stops = find_runs(labels)
    run_numbers = np.full(labels.size, -1)
    run_numbers[_is_in_run(labels)] = np.repeat(np.arange(starts.size), stops - starts)
    return run_numbers


def find_run_bounds(labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return start [T] and end (exclusive) [T] of the run of each sample.

    For a sample outside of runs both are its own index.

    Args:
        labels: label of each sample, as for `find_runs`.
    """
    starts, stops = find_runs(labels)
    is_in_run = _is_in_run(labels)
    run_starts = np.arange(labels.size)
    run_ends = np.arange(labels.size)
    run_starts[is_in_run] = np.repeat(starts, stops - starts)
    run_ends[is_in_run] = np.repeat(stops, stops - starts)
    return run_starts, run_ends


def _is_in_run(labels: np.ndarray) -> np.ndarray:
    return labels if labels.dtype == bool else labels >= 0

"""What innovations of clean logs are like: what a model has always got wrong, and their scatter."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from residnet.identification.monitoring.changes import Change
from residnet.identification.monitoring.windows import SEEN

_SHRINK = 0.1
"""Share of the diagonal in the covariance of innovations."""
BELIEVED = 15.0
"""Standard deviation of what a model has always got wrong, in the causes' own small sizes."""


def always_wrong(error: np.ndarray, effects: np.ndarray, causes: Sequence[Change]) -> np.ndarray:
    """Return what a model has always got wrong: a size [Q, 4] of each cause for each channel.

    Channels may disagree: a model whose form is wrong has no single set of sizes that mends it.

    Args:
        error: innovations [B, n] of clean logs.
        effects: of a unit of each change [B, C, n], the causes first.
        causes: Q of them.
    """
    count, channels = len(causes), len(SEEN)
    # sensors are taken to be right: how they are wrong looks like the motion itself
    believed = np.array([0.0 if one.sensor else one.size * BELIEVED for one in causes])
    out = np.zeros((count, channels))
    for channel in range(channels):
        e = error[:, channel::channels].ravel()
        a = effects[:, :count, channel::channels].swapaxes(1, 2).reshape(len(e), count) * believed
        matrix = a.T @ a + np.mean(e**2) * np.eye(count)
        out[:, channel] = believed * np.linalg.solve(matrix, a.T @ e)
    return out


def run_away(
    error: np.ndarray, effects: np.ndarray, causes: Sequence[Change], limit: np.ndarray
) -> np.ndarray:
    """Return which windows [B] tell nothing, because the free run or a changed one ran away.

    Args:
        error: innovations [B, n].
        effects: of a unit of each change [B, C, n].
        causes: the C changes.
        limit: largest innovation of each channel [4] that a vessel can have.
    """
    most = np.tile(limit, error.shape[1] // len(limit))
    size = np.array([change.size for change in causes])[:, None]
    # comparisons with what is no number are false
    sound = (np.abs(error) <= most).all(axis=1)
    return np.asarray(~(sound & (np.abs(effects * size) <= most).all(axis=(1, 2))))


def whitening(error: np.ndarray, parts: int) -> np.ndarray:
    """Return the matrix [n, n] that makes innovations [B, parts n] of clean logs uncorrelated."""
    # windows that ran away were made nothing of
    error = error[(error != 0.0).any(axis=1)]
    error = error.reshape(len(error) * parts, -1)
    second = error.T @ error / len(error)
    covariance = (1.0 - _SHRINK) * second + _SHRINK * np.diag(np.diag(second))
    found: np.ndarray = np.linalg.inv(np.linalg.cholesky(covariance + 1e-18 * np.eye(len(second))))
    return found

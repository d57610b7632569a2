"""What innovations of clean logs are like: what a model has always got wrong, and their scatter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from residnet.identification.monitoring.changes import Change
from residnet.identification.monitoring.windows import SEEN

_SHRINK = 0.1
"""Share of the diagonal in the covariance of innovations."""
BELIEVED = 15.0
"""Standard deviation of what a model has always got wrong, in the causes' own small sizes."""


@dataclass(frozen=True)
class Sums:
    """Scores [Q] and information [Q, Q] of a number of windows, and squares of innovations [n]."""

    score: np.ndarray
    information: np.ndarray
    squares: np.ndarray
    count: int

    def __add__(self, other: Sums) -> Sums:
        return Sums(
            self.score + other.score,
            self.information + other.information,
            self.squares + other.squares,
            self.count + other.count,
        )


def weighed(
    found: Sequence[tuple[np.ndarray, np.ndarray]],
    whiten: Sequence[np.ndarray],
    belief: np.ndarray,
) -> Sums:
    """Return the sums over windows that were looked at as a whole, then in parts.

    A window that no change of a size thought possible explains tells of a manoeuvre that the model
    does not know. It counts by the inverse of what it leaves unexplained.

    Args:
        found: innovations [B, parts n] and effects [B, C, parts n] for each look.
        whiten: matrix [n, n] of each look.
        belief: precision of the sizes of the changes [C, C].
    """
    looks, number = [], 0
    for (error, effects), matrix in zip(found, whiten, strict=True):
        size, (windows, count, values) = len(matrix), effects.shape
        e = (error.reshape(windows, -1, size) @ matrix.T).reshape(windows, values)
        a = (effects.reshape(windows, count, -1, size) @ matrix.T).reshape(effects.shape)
        looks.append((np.einsum("bqn,bn->bq", a, e), a @ a.swapaxes(1, 2), e**2))
        number += values
    score = np.sum([one for one, _, _ in looks], axis=0)
    information = np.sum([one for _, one, _ in looks], axis=0)
    squares = np.sum([one.sum(axis=1) for _, _, one in looks], axis=0)
    own = np.linalg.solve(information + belief, score[..., None])[..., 0]
    left = (squares - (score * own).sum(axis=1)) / number
    weight = 1.0 / np.maximum(left, 1.0)
    return Sums(
        weight @ score,
        np.tensordot(weight, information, 1),
        looks[0][2].sum(axis=0),
        len(looks[0][2]),
    )


def apart_from(sums: Sums, count: int, belief: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return scores [Q] and information [Q, Q] once what follows has taken what it can explain.

    Args:
        sums: of Q changes, then of what surrounds the vessel.
        count: Q.
        belief: precision of the sizes of what surrounds the vessel.
    """
    matrix = sums.information
    own = np.linalg.solve(matrix[count:, count:] + belief, matrix[count:, :count])
    score = sums.score[:count] - own.T @ sums.score[count:]
    information = matrix[:count, :count] - matrix[:count, count:] @ own
    return score, information + 1e-300 * np.eye(count)


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

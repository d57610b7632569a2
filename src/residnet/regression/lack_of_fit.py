"""Lack of fit of an equation: functions of the channels that explain its residual.

The target and flexible probe functions are projected on the orthogonal complement of all candidate
terms. A family of probes has a lack of fit if it predicts the remaining residual in blocks of
samples that were not used to estimate it (block cross-validation, which is valid for correlated
noise; Roberts et al. 2017). An F test would need the number of independent samples, which cannot be
estimated from a residual that depends on smooth channels.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, pairwise
from typing import Final

import numpy as np

_SINGLE_DEGREE: Final = 8
"""Maximum degree of the Legendre polynomials of one channel."""
_PAIR_DEGREE: Final = 4
"""Maximum degree in each channel of the products of Legendre polynomials of two channels."""
_N_BLOCKS: Final = 8
"""Number of blocks of successive samples of the cross-validation."""
_MIN_IMPROVED_BLOCKS: Final = 6
"""Minimum number of blocks that a family must predict better than zero."""
_MIN_SHARE: Final = 0.05
"""Minimum share of the residual mean square that a family must predict to be reported."""
_MIN_RELATIVE_ERROR: Final = 1e-6
"""RMS of the residual over that of the target below which it consists of rounding errors."""
_MAX_ROWS: Final = 4000
"""Maximum number of rows of the test, decimated evenly."""
_MAX_FAMILIES: Final = 3
"""Maximum number of families that are reported for a target."""
_SPAN_TOLERANCE: Final = 1e-6
"""Singular value of unit probes projected on the complement of the candidates, below which a
direction counts as a linear combination of candidates.
"""


def select_test_rows(n_rows: int) -> slice:
    """Return the rows of the test, at most `_MAX_ROWS` evenly spaced ones of all rows."""
    return slice(None, None, -(-max(n_rows, 1) // _MAX_ROWS))


def probe_families(
    features: np.ndarray, names: Sequence[str]
) -> tuple[list[tuple[str, ...]], list[np.ndarray]]:
    """Return families of probe functions of one and of two channels.

    Args:
        features: channels [N, F].
        names: names of the channels.

    Returns:
        The channels of each family, and its probes [N, P].
    """
    low = features.min(axis=0)
    high = features.max(axis=0)
    is_excited = high > low
    polynomials = {}
    for j in np.flatnonzero(is_excited).tolist():
        scaled = (2.0 * features[:, j] - low[j] - high[j]) / (high[j] - low[j])
        polynomials[names[j]] = np.polynomial.legendre.legvander(scaled, _SINGLE_DEGREE)[:, 1:]
    families: list[tuple[str, ...]] = [(name,) for name in polynomials]
    probes = list(polynomials.values())
    for first, second in combinations(polynomials, 2):
        products = (
            polynomials[first][:, :_PAIR_DEGREE, None] * polynomials[second][:, None, :_PAIR_DEGREE]
        )
        families.append((first, second))
        probes.append(products.reshape(len(features), -1))
    return families, probes


def estimate_lack_of_fit(
    x: np.ndarray, y: np.ndarray, families: Sequence[tuple[str, ...]], probes: Sequence[np.ndarray]
) -> dict[str, float]:
    """Return the families of functions that explain the residual of all candidates together.

    Families are added one by one, functions of one channel first, until none predicts the
    remaining residual.

    Args:
        x: all candidate terms [N, J].
        y: target [N].
        families: channels of each family.
        probes: probe functions [N, P] of each family.

    Returns:
        Family (for example "u" or "u, n") -> share of the mean square of the residual of all
        candidates that the family predicts by cross-validation. Empty if there is no lack of fit,
        or if there are too few samples to test it.
    """
    rows = select_test_rows(len(y))
    target = y[rows]
    norms = np.linalg.norm(x[rows], axis=0)
    candidates = x[rows][:, norms > 0] / norms[norms > 0]
    # with nearly as many candidates as rows, the candidates fit the noise
    if len(target) < 2 * candidates.shape[1] + _N_BLOCKS * 2 * _PAIR_DEGREE**2:
        return {}
    left_vectors, singular_values, _ = np.linalg.svd(candidates, full_matrices=False)
    basis = left_vectors[:, singular_values > 1e-10 * singular_values.max(initial=1e-300)]
    residual = _project_out(basis, target)
    initial_energy = float(residual @ residual)
    if initial_energy <= _MIN_RELATIVE_ERROR**2 * float(target @ target):
        return {}
    remaining = [_orthonormal_probes(basis, columns[rows]) for columns in probes]
    shares: dict[str, float] = {}
    for n_channels in (1, 2):
        indices = [i for i, family in enumerate(families) if len(family) == n_channels]
        while indices and len(shares) < _MAX_FAMILIES:
            gains = [_cross_validated_gain(remaining[i], residual) for i in indices]
            best = int(np.argmax(gains))
            if gains[best] < _MIN_SHARE * initial_energy:
                break
            chosen_index = indices.pop(best)
            shares[", ".join(families[chosen_index])] = round(gains[best] / initial_energy, 3)
            # the next family must explain what this family does not
            residual = _project_out(remaining[chosen_index], residual)
            remaining = [
                _orthonormal_probes(remaining[chosen_index], columns)
                if i != chosen_index
                else columns
                for i, columns in enumerate(remaining)
            ]
    return shares


def _project_out(basis: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the components of columns [N, ...] orthogonal to an orthonormal basis [N, R]."""
    # the second projection removes the rounding errors of the first
    for _ in range(2):
        columns = columns - basis @ (basis.T @ columns)
    return columns


def _orthonormal_probes(basis: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis [N, P] of probe columns orthogonal to `basis`."""
    norms = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    orthogonal = _project_out(basis, columns / norms)
    left_vectors, singular_values, _ = np.linalg.svd(orthogonal, full_matrices=False)
    return np.asarray(left_vectors[:, singular_values > _SPAN_TOLERANCE])


def _cross_validated_gain(columns: np.ndarray, residual: np.ndarray) -> float:
    """Return the decrease of the squared error when columns predict the residual of a block.

    Each block of successive rows is predicted from the other blocks. The gain is zero if the
    columns improve too few blocks.
    """
    if columns.shape[1] == 0:
        return 0.0
    edges = np.linspace(0, len(residual), _N_BLOCKS + 1).astype(int)
    gram = columns.T @ columns
    projection = columns.T @ residual
    gains = []
    for start, stop in pairwise(edges):
        block = columns[start:stop]
        block_residual = residual[start:stop]
        # normal equations of the other blocks; the probes are orthonormal, so they are well scaled
        coefficients = np.linalg.lstsq(
            gram - block.T @ block, projection - block.T @ block_residual, rcond=1e-6
        )[0]
        error = block_residual - block @ coefficients
        gains.append(float(block_residual @ block_residual - error @ error))
    n_improved = sum(gain > 0 for gain in gains)
    return sum(gains) if n_improved >= _MIN_IMPROVED_BLOCKS else 0.0

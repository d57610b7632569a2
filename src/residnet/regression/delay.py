"""Time delay of inputs by a least-squares profile over shifts (document 000 section 5.3.4).

All shifts come from the same correlations.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from residnet.core.errors import FitError

_DEPENDENT = 1e-10
"""Share of the largest eigenvalue up to which one is what rounding leaves."""
_TINY = 1e-300
"""Least size that a column is divided by."""


class DelayProfile(NamedTuple):
    """The residual sums of squares by shift [S + 1], and the shift of the least one in samples."""

    rss: np.ndarray
    shift: int


def delay_profile(
    held: np.ndarray, delayed: np.ndarray, y: np.ndarray, stretch: np.ndarray, longest: int
) -> DelayProfile:
    """Return the errors of y(t) = sum_j c_j held_j(t) delayed_j(t - s) for shifts 0 ... longest.

    All shifts are judged on the same samples, those with a past of `longest`. The moments of all
    shifts are correlations of held_i held_j with delayed_i delayed_j, taken by FFT: no shift costs
    a regression over the samples.

    Args:
        held: the part of each term that is not delayed [N, J].
        delayed: the part that is, ones where there is none [N, J].
        y: target [N].
        stretch: number of the unbroken stretch that each sample belongs to, ascending [N].
        longest: longest shift, in samples.

    Raises:
        FitError: with fewer samples that have a past than terms.
    """
    n, j = held.shape
    has_past = np.concatenate(
        (np.zeros(min(longest, n), dtype=bool), stretch[longest:] == stretch[: max(n - longest, 0)])
    )
    count = int(has_past.sum())
    if count <= j:
        raise FitError(
            f"delay: {count} samples have a past of {longest} samples, {j} terms need more; give"
            " longer logs or a shorter delay"
        )
    scale = np.maximum(np.abs(held).max(axis=0) * np.abs(delayed).max(axis=0), _TINY)
    held = held / scale * has_past[:, None]
    first, second = np.triu_indices(j)
    # pairs of terms, then each term with the target
    now = np.concatenate((held[:, first] * held[:, second], held * y[:, None]), axis=1)
    past = np.concatenate((delayed[:, first] * delayed[:, second], delayed), axis=1)
    moments = _correlations(now, past, longest)
    gram = np.zeros((longest + 1, j, j))
    gram[:, first, second] = gram[:, second, first] = moments[:, : first.size]
    cross = moments[:, first.size :]
    size = np.sqrt(np.maximum(gram.diagonal(axis1=1, axis2=2), _TINY))
    gram = gram / size[:, :, None] / size[:, None, :]
    cross = cross / size
    # candidates may be collinear: what rounding cannot tell apart shares its part
    values, vectors = np.linalg.eigh(gram)
    along = np.einsum("sij,si->sj", vectors, cross)
    kept = values > _DEPENDENT * values[:, -1:]
    explained = np.where(kept, np.square(along) / np.where(kept, values, 1.0), 0.0).sum(axis=1)
    energy = float(np.square(y[has_past]).sum())
    rss = np.maximum(energy - explained, 0.0)
    return DelayProfile(rss, int(rss.argmin()))


def _correlations(now: np.ndarray, past: np.ndarray, longest: int) -> np.ndarray:
    """Return sum_t now(t) past(t - s) for s = 0 ... longest, [longest + 1, P]."""
    size = 1 << (len(now) + longest).bit_length()
    return np.fft.irfft(
        np.fft.rfft(now, size, axis=0) * np.conj(np.fft.rfft(past, size, axis=0)), size, axis=0
    )[: longest + 1]

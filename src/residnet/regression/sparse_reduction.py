"""The reduction of a sparse regression to one QR factor.

A QR factor keeps what its square, the Gram matrix, loses: candidates such as u, u cos(delta) and
u |u| differ in the eighth digit on a log of small nozzle angles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from residnet.core.errors import FitError
from residnet.regression.equation_rows import correlation_time

_DEPENDENT = 1e-12
"""Share of a column's length that must be left beside simpler columns; below it rounding decides.
"""
_TINY = 1e-300
"""Length of a column from which it counts as excited, and least divisor of a condition number."""
_NAMED = 1e-6
"""Least share of a simpler column in a dependent one at which it is named."""


@dataclass(frozen=True)
class Reduced:
    """The candidates and targets in the coordinates of one QR factorisation.

    Attributes:
        names: the J candidates that the data tell apart, simplest first.
        degree: degree of each, ascending, [J].
        scale: length of each column before it was scaled to one, [J].
        r: columns of unit length in the new coordinates [J + K, J].
        y: targets in the same coordinates [J + K, K].
        samples: as many independent rows as the correlated ones are worth for each target, [K].
        rank: number of candidates that are independent, J.
        condition: condition number of the scaled candidates.
        unexcited: candidates that are zero in all samples.
        dependent: candidate -> how simpler ones make it up on these data, for example {"u|u|":
            {"u^2": 1.0}}.
    """

    names: tuple[str, ...]
    degree: np.ndarray
    scale: np.ndarray
    r: np.ndarray
    y: np.ndarray
    samples: np.ndarray
    rank: int
    condition: float
    unexcited: tuple[str, ...]
    dependent: dict[str, dict[str, float]]


def reduce(
    x: np.ndarray,
    y: np.ndarray,
    names: Sequence[str],
    degree: Sequence[int],
    effort: Sequence[float] = (),
) -> Reduced:
    """Return candidates and targets by one QR factorisation.

    Columns that simpler ones make up are set aside.

    Args:
        x: candidate columns [N, J].
        y: targets [N, K].
        names: of the columns.
        degree: of the columns: the stages of the search.
        effort: how complicated each column is, within its degree; the order given where empty.

    Raises:
        FitError: with values that are not finite, no candidate that is excited, or fewer samples
            than candidates.
    """
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        bad = [
            name for name, good in zip(names, np.isfinite(x).all(axis=0), strict=True) if not good
        ]
        what = f"term '{bad[0]}'" if bad else "the target"
        raise FitError(
            f"sparse regression: {what} is not finite in all samples; mask those or leave the"
            " term out"
        )
    order = np.lexsort(
        (np.asarray(effort) if len(effort) else np.arange(x.shape[1]), np.asarray(degree))
    )
    length = np.linalg.norm(x, axis=0)[order]
    excited = order[length > _TINY]
    if not excited.size:
        raise FitError(
            "sparse regression: every candidate term is zero in all samples; the data excite"
            " nothing"
        )
    if x.shape[0] <= excited.size + y.shape[1]:
        raise FitError(
            f"sparse regression: {x.shape[0]} samples do not determine {excited.size} candidates;"
            " give longer logs or fewer candidates"
        )
    scale = np.linalg.norm(x[:, excited], axis=0)
    full = triangle(np.concatenate((x[:, excited] / scale, y), axis=1))
    whole = Reduced(
        names=tuple(names[i] for i in excited),
        degree=np.asarray(degree)[excited],
        scale=scale,
        r=full[:, : excited.size],
        y=full[:, excited.size :],
        samples=np.full(y.shape[1], float(x.shape[0])),
        rank=excited.size,
        condition=np.inf,
        unexcited=tuple(names[i] for i in order[length <= _TINY]),
        dependent={},
    )
    out = coarser(whole, _DEPENDENT)
    columns = [excited[whole.names.index(name)] for name in out.names]
    best = np.linalg.solve(out.r[: out.rank], out.y[: out.rank]) / out.scale[:, None]
    return replace(out, samples=x.shape[0] / correlation_time(y - x[:, columns] @ best))


def coarser(reduced: Reduced, resolution: float) -> Reduced:
    """Return the same without the candidates that hardly differ from simpler ones.

    They differ by no more than a share of their length.
    """
    kept, dependent = _independent(reduced.r, reduced.names, reduced.scale, resolution)
    rows = triangle(np.concatenate((reduced.r[:, kept], reduced.y), axis=1))
    singular = np.linalg.svd(rows[:, : len(kept)], compute_uv=False)
    return replace(
        reduced,
        names=tuple(reduced.names[i] for i in kept),
        degree=reduced.degree[kept],
        scale=reduced.scale[kept],
        r=rows[:, : len(kept)],
        y=rows[:, len(kept) :],
        rank=len(kept),
        condition=float(singular[0] / max(singular[-1], _TINY)),
        dependent=reduced.dependent | dependent,
    )


def triangle(x: np.ndarray) -> np.ndarray:
    """Return R of the QR factorisation of columns [N, J]: [J, J]."""
    return np.asarray(np.linalg.qr(x, mode="r"))


def _independent(
    r: np.ndarray, names: Sequence[str], scale: np.ndarray, least: float
) -> tuple[list[int], dict[str, dict[str, float]]]:
    """Return the columns that simpler ones do not make up, and what makes up the others."""
    kept = list(range(len(names)))
    while True:
        beside = np.abs(np.diagonal(triangle(r[:, kept])))
        lost = [kept[i] for i in np.flatnonzero(beside <= least)]
        if not lost:
            break
        kept = [i for i in kept if i not in lost]
    gone = [i for i in range(len(names)) if i not in kept]
    dependent: dict[str, dict[str, float]] = {}
    for i in gone:
        before = [k for k in kept if k < i]
        share = np.linalg.lstsq(r[:, before], r[:, i], rcond=None)[0]
        parts = {
            names[k]: float(s * scale[i] / scale[k])
            for k, s in zip(before, share, strict=True)
            if abs(s) > max(_NAMED, least)
        }
        dependent[names[i]] = parts
    return kept, dependent

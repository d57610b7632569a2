"""Sparse regression: the few candidate columns, out of many, that make up a target.

They do so exactly, or as well as the data can tell.

Everything works on one QR factorisation of [candidates | targets]: columns that the data cannot
tell from simpler ones are set aside, then orthogonal forward regression, backward elimination and
swaps search the rest (`residnet.regression.sparse_search`). A QR factor keeps what its square, the
Gram matrix, loses: candidates such as u, u cos(delta) and u |u| differ in the eighth digit on a log
of small nozzle angles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydantic import Field

from residnet.core.config import Config
from residnet.core.errors import FitError
from residnet.regression.equation_rows import correlation_time
from residnet.regression.sparse_search import Criterion, Search, coefficients, swap_table

_DEPENDENT = 1e-12
"""Share of a column's length that must be left beside simpler columns; below it rounding decides.
"""
_NOISY = 1e-9
"""Unexplained share of a target from which data count as noisy."""
_EVIDENCE = 6.0
"""Difference of the criterion above which one model is strongly preferred to another (Kass and
Raftery 1995).
"""


class SearchConfig(Config):
    """The extent of a sparse search.

    Attributes:
        max_terms: most terms of an equation on the way of the search; the result usually has fewer.
        gamma: weight of the number of candidates in the extended BIC (Chen and Chen 2008), n
            ln(RSS) + k ln(n) + 2 gamma ln(J over k); 0 is BIC.
        precision: error relative to the target below which a fit counts as exact.
        swaps: most terms that are taken out at once, for as many others or one less.
        resolution: share of its length by which a term must differ from simpler ones where the data
            are noisy (or the unexplained share of the target, if that is less). u|u| differs from
            u^2 by noise alone on a vessel that is at rest for a moment and never goes astern.
    """

    max_terms: int = Field(default=30, ge=1, le=80)
    gamma: float = Field(default=1.0, ge=0.0, le=1.0)
    precision: float = Field(default=1e-13, ge=1e-15, lt=1.0)
    swaps: int = Field(default=3, ge=1, le=3)
    resolution: float = Field(default=1e-2, ge=0.0, lt=1.0)


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


@dataclass(frozen=True)
class Equation:
    """A target as a sum of few terms.

    Attributes:
        terms: names, simplest first.
        values: coefficients.
        errors: standard errors of the coefficients.
        share: RMS error over RMS of the target.
        exact: whether the error is at the precision of the arithmetic.
        criterion: extended BIC.
        searched: degree of the candidates that were searched.
        alternatives: term -> other candidates that could stand in its place as far as these data
            can tell.
        undecided: candidates left out whose coefficient could, within two standard errors, make up
            a twentieth of the target: {name: that share}.
    """

    terms: tuple[str, ...]
    values: np.ndarray
    errors: np.ndarray
    share: float
    exact: bool
    criterion: float
    searched: int
    alternatives: dict[str, list[str]]
    undecided: dict[str, float]

    def summary(self, within: Reduced) -> dict[str, Any]:
        """Return what the data say about the equation, for fit.json.

        It holds among the candidates that were searched.
        """
        return {
            "error_share": self.share,
            "exact": self.exact,
            "candidates": within.rank,
            "condition": within.condition,
            "same_as_simpler": within.dependent,
            "cannot_tell_apart": self.alternatives,
            "undecided": self.undecided,
        }


NOTHING = Equation((), np.zeros(0), np.zeros(0), 1.0, False, 0.0, 0, {}, {})
"""The equation without terms."""


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
    excited = order[length > 1e-300]
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
        unexcited=tuple(names[i] for i in order[length <= 1e-300]),
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
        condition=float(singular[0] / max(singular[-1], 1e-300)),
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
            if abs(s) > max(1e-6, least)
        }
        dependent[names[i]] = parts
    return kept, dependent


def find(reduced: Reduced, target: int, config: SearchConfig) -> tuple[Equation, Reduced]:
    """Return the equation of one target, and the candidates that it was searched in.

    These are fewer where noise hides what sets some apart.

    Args:
        reduced: candidates and targets.
        target: which target.
        config: how far the search goes.
    """
    fine = _search(reduced, target, config)
    limit = min(config.resolution, fine.share)
    if fine.share <= _NOISY:
        return fine, reduced
    coarse = coarser(reduced, limit)
    return (
        (fine, reduced)
        if coarse.rank == reduced.rank
        else (_search(coarse, target, config), coarse)
    )


def _search(reduced: Reduced, target: int, config: SearchConfig) -> Equation:
    """Return the best equation.

    Degrees are searched in turn, simplest first, until one explains the target exactly; otherwise
    the criterion, which knows how many candidates each had to choose from, decides between them.
    """
    y = reduced.y[:, target]
    energy = float(y @ y)
    if energy <= 1e-300:
        return Equation((), np.zeros(0), np.zeros(0), 0.0, True, -np.inf, 0, {}, {})
    best: tuple[float, list[int], Search, int] | None = None
    for stage in np.unique(reduced.degree).tolist():
        width = int((reduced.degree <= stage).sum())
        rule = Criterion(
            float(reduced.samples[target]), width, config.gamma, energy, config.precision
        )
        search = Search(reduced.r[:, :width], y, rule, config.max_terms)
        value, chosen = search.start()
        if best is None or value < best[0]:
            best = (value, chosen, search, stage)
        if rule.exact(search.rss(best[1])):
            break
    assert best is not None
    _, chosen, search, stage = best
    return _told(reduced, target, search, search.refine(chosen, config.swaps), stage)


def _told(reduced: Reduced, target: int, search: Search, chosen: list[int], stage: int) -> Equation:
    """Return the equation of the chosen columns, with what stands beside it."""
    chosen = sorted(chosen)
    y, rule = reduced.y[:, target], search.rule
    rss = search.rss(chosen)
    exact = rule.exact(rss)
    value, inverse = coefficients(reduced.r[:, chosen], y)
    spread = np.sqrt(rss / max(rule.samples - len(chosen), 1.0))
    errors = spread * np.sqrt(np.square(inverse).sum(axis=1))
    names = np.array(reduced.names, dtype=object)
    return Equation(
        terms=tuple(names[chosen]),
        values=value / reduced.scale[chosen],
        errors=errors / reduced.scale[chosen],
        share=float(np.sqrt(rss / rule.energy)),
        exact=exact,
        criterion=float(rule.value(rss, len(chosen))),
        searched=int(stage),
        alternatives=_alternatives(search, chosen, names),
        undecided={} if exact else _undecided(search, chosen, names, spread),
    )


def _alternatives(search: Search, chosen: list[int], names: np.ndarray) -> dict[str, list[str]]:
    """Return by term the candidates between which and it the data do not decide."""
    limit = search.rule.value(search.rss(chosen), len(chosen)) + _EVIDENCE
    table = search.rule.value(swap_table(search.r, search.y, chosen), len(chosen))
    out: dict[str, list[str]] = {}
    for place, row in zip(chosen, table, strict=True):
        near = [int(j) for j in np.flatnonzero(row <= limit + _EVIDENCE) if j not in chosen]
        # the table loses digits by cancellation where a fit is exact
        same = [j for j in near if search.value([*(i for i in chosen if i != place), j]) <= limit]
        if same:
            out[str(names[place])] = [str(names[j]) for j in same]
    return out


def _undecided(
    search: Search, chosen: list[int], names: np.ndarray, spread: float
) -> dict[str, float]:
    """Return the candidates whose coefficient the data leave so open that they could matter.

    Each has the share of the target within two standard errors.
    """
    left = search.left_over(chosen)
    length = np.linalg.norm(left.columns, axis=0)
    free = np.flatnonzero(length > 1e-9)
    free = free[~np.isin(free, chosen)]
    reach = (
        (np.abs(left.columns[:, free].T @ left.target) / length[free] + 2.0 * spread)
        / length[free]
        / np.sqrt(search.rule.energy)
    )
    return {str(names[j]): round(float(s), 3) for j, s in zip(free, reach, strict=True) if s > 0.05}

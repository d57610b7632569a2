"""Sparse regression: the few candidate columns, out of many, that make up a target.

They do so exactly, or as well as the data can tell.

Everything works on one QR factorisation of [candidates | targets]: columns that the data cannot
tell from simpler ones are set aside, then orthogonal forward regression, backward elimination and
swaps search the rest (`residnet.regression.sparse_search`). A QR factor keeps what its square, the
Gram matrix, loses: candidates such as u, u cos(delta) and u |u| differ in the eighth digit on a log
of small nozzle angles.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import Field

from residnet.core.config import Config
from residnet.regression.sparse_reduction import Reduced, coarser
from residnet.regression.sparse_search import Criterion, Search, coefficients, swap_table

_TINY = 1e-300
"""Energy of a target up to which it counts as zero."""
_ALIKE = 1e-9
"""Length of a unit column beside the chosen ones up to which it is made up of them."""
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
        resolution: share of its length by which a term must differ from simpler ones to need no
            further evidence where the data are noisy (or the unexplained share of the target, if
            that is less). A term that differs by less is taken where the criterion strongly prefers
            an equation with it. u|u| differs from u^2 by noise alone on a vessel that is at rest
            for a moment and never goes astern.
    """

    max_terms: int = Field(default=30, ge=1, le=80)
    gamma: float = Field(default=1.0, ge=0.0, le=1.0)
    precision: float = Field(default=1e-13, ge=1e-15, lt=1.0)
    swaps: int = Field(default=3, ge=1, le=3)
    resolution: float = Field(default=1e-2, ge=0.0, lt=1.0)


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
    if coarse.rank == reduced.rank:
        return fine, reduced
    simple = _search(coarse, target, config)
    # what the coarse search found is another start of the fine one
    again = _from(reduced, target, config, simple)
    best = min(fine, again, key=lambda equation: equation.criterion)
    preferred = simple.criterion <= best.criterion + _EVIDENCE
    return (simple, coarse) if preferred else (best, reduced)


def _from(reduced: Reduced, target: int, config: SearchConfig, start: Equation) -> Equation:
    """Return the best equation that swaps lead to from the terms of another."""
    stage = int(reduced.degree.max())
    search = Search(
        reduced.r,
        reduced.y[:, target],
        _rule(reduced, target, reduced.rank, config),
        config.max_terms,
    )
    chosen = [reduced.names.index(term) for term in start.terms]
    return _equation(
        reduced, target, search, search.trimmed(search.refine(chosen, config.swaps)), stage
    )


def _rule(reduced: Reduced, target: int, width: int, config: SearchConfig) -> Criterion:
    """Return the criterion of a search among the first `width` candidates."""
    y = reduced.y[:, target]
    samples = float(reduced.samples[target])
    return Criterion(samples, width, config.gamma, float(y @ y), config.precision)


def _search(reduced: Reduced, target: int, config: SearchConfig) -> Equation:
    """Return the best equation.

    Degrees are searched in turn, simplest first, until one explains the target exactly; otherwise
    the criterion, which knows how many candidates each had to choose from, decides between them.
    """
    y = reduced.y[:, target]
    energy = float(y @ y)
    if energy <= _TINY:
        return Equation((), np.zeros(0), np.zeros(0), 0.0, True, -np.inf, 0, {}, {})
    best: tuple[float, list[int], Search, int] | None = None
    for stage in np.unique(reduced.degree).tolist():
        width = int((reduced.degree <= stage).sum())
        rule = _rule(reduced, target, width, config)
        search = Search(reduced.r[:, :width], y, rule, config.max_terms)
        value, chosen = search.start()
        if best is None or value < best[0]:
            best = (value, chosen, search, stage)
        if rule.exact(search.rss(best[1])):
            break
    assert best is not None
    _, chosen, search, stage = best
    return _equation(
        reduced, target, search, search.trimmed(search.refine(chosen, config.swaps)), stage
    )


def _equation(
    reduced: Reduced, target: int, search: Search, chosen: list[int], stage: int
) -> Equation:
    """Return the equation of the chosen columns, with what stands beside it."""
    chosen = sorted(chosen)
    y, rule = reduced.y[:, target], search.rule
    rss = search.rss(chosen)
    exact = rule.exact(rss)
    value, inverse = coefficients(reduced.r[:, chosen], y)
    std = np.sqrt(rss / max(rule.samples - len(chosen), 1.0))
    errors = std * np.sqrt(np.square(inverse).sum(axis=1))
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
        undecided={} if exact else _undecided(search, chosen, names, std),
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
    search: Search, chosen: list[int], names: np.ndarray, std: float
) -> dict[str, float]:
    """Return the candidates whose coefficient the data leave so open that they could matter.

    Each has the share of the target within two standard errors.
    """
    left = search.left_over(chosen)
    length = np.linalg.norm(left.columns, axis=0)
    free = np.flatnonzero(length > _ALIKE)
    free = free[~np.isin(free, chosen)]
    reach = (
        (np.abs(left.columns[:, free].T @ left.target) / length[free] + 2.0 * std)
        / length[free]
        / np.sqrt(search.rule.energy)
    )
    return {str(names[j]): round(float(s), 3) for j, s in zip(free, reach, strict=True) if s > 0.05}

"""Sparse regression: the few candidate columns, out of many, that make up a target.

They do so exactly, or as well as the data can tell.

Everything works on one QR factorisation of [candidates | targets]: columns that the data cannot
tell from simpler ones are set aside, then several orthogonal forward regressions side by side
search the rest, and what there is no evidence for is trimmed. A QR factor keeps what its square,
the Gram matrix, loses: candidates such as u, u cos(delta) and u |u| differ in the eighth digit on a
log of small nozzle angles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np
import scipy
import torch
from pydantic import Field
from torch import Tensor

from residnet.core.config import Config
from residnet.core.errors import FitError
from residnet.regression.equation_rows import correlation_time
from residnet.regression.estimator import Coefficient, Data, Estimator, Solution, whole

_DEPENDENT = 1e-12
"""Share of a column's length that must be left beside simpler columns; below it rounding decides.
"""
_TINY = 1e-300
"""Length of a column or target from which it counts, and least divisor of a condition number."""
_NAMED = 1e-6
"""Least share of a simpler column in a dependent one at which it is named."""
_ALIKE = 1e-11
"""Length of a unit column beside the chosen ones below which it adds nothing that rounding does
not.
"""
_MADE_UP = 1e-9
"""Length of a unit column beside the chosen ones up to which it is made up of them."""
_NOISY = 1e-9
"""Unexplained share of a target from which data count as noisy."""
_POSITIVE = 3.0
"""Difference of the criterion from which one term more counts as evident: between positive and
strong evidence (Kass and Raftery 1995).
"""
_EVIDENCE = 6.0
"""Difference of the criterion above which one model is strongly preferred to another (ibid.)."""
_BEAM = 12
"""Sets of columns of one size that are followed side by side: of 30 random problems with nine
correlated columns 6 miss the best of all subsets once, 12 never.
"""
_PATIENCE = 6
"""Sizes without a gain of the criterion after which the search ends: an exact equation may gain
nothing before its last term (a mass-spring-damper's three, the jets' from steps; 2 misses both).
"""


class SearchConfig(Config):
    """The extent of a sparse search.

    Attributes:
        max_terms: most terms of an equation on the way of the search; the result usually has fewer.
        gamma: weight of the number of candidates in the extended BIC (Chen and Chen 2008), n
            ln(RSS) + k ln(n) + 2 gamma ln(J over k); 0 is BIC.
        precision: error relative to the target below which a fit counts as exact.
        resolution: share of its length by which a term must differ from simpler ones to need no
            further evidence where the data are noisy (or the unexplained share of the target, if
            that is less). A term that differs by less is taken where the criterion strongly prefers
            an equation with it. u|u| differs from u^2 by noise alone on a vessel that is at rest
            for a moment and never goes astern.
    """

    max_terms: int = Field(default=30, ge=1, le=80)
    gamma: float = Field(default=1.0, ge=0.0, le=1.0)
    precision: float = Field(default=1e-13, ge=1e-15, lt=1.0)
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
    full = _triangle(np.concatenate((x[:, excited] / scale, y), axis=1))
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
    kept = list(range(len(reduced.names)))
    while True:
        beside = np.abs(np.diagonal(_triangle(reduced.r[:, kept])))
        lost = [kept[i] for i in np.flatnonzero(beside <= resolution)]
        if not lost:
            break
        kept = [i for i in kept if i not in lost]
    q, triangle = np.linalg.qr(reduced.r[:, kept])
    dependent: dict[str, dict[str, float]] = {}
    for i in sorted({*range(len(reduced.names))} - {*kept}):
        before = [k for k in kept if k < i]
        share = scipy.linalg.solve_triangular(
            triangle[: len(before), : len(before)], q[:, : len(before)].T @ reduced.r[:, i]
        )
        parts = {
            reduced.names[k]: float(s * reduced.scale[i] / reduced.scale[k])
            for k, s in zip(before, share, strict=True)
            if abs(s) > max(_NAMED, resolution)
        }
        dependent[reduced.names[i]] = parts
    rows = _triangle(np.concatenate((reduced.r[:, kept], reduced.y), axis=1))
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


def _triangle(x: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.qr(x, mode="r"))


def coefficients(r: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return least-squares coefficients [p] of columns [R, p], and their triangle's inverse.

    The rows of the inverse [p, p] give standard errors.
    """
    q, triangle = np.linalg.qr(r)
    inverse = np.linalg.inv(triangle) if triangle.size else triangle
    return inverse @ (q.T @ y), inverse


@final
class Search:
    """A search of one target [R] in columns of unit length [R, J], by the extended BIC.

    Args:
        samples: as many independent rows as the correlated ones are worth.
    """

    def __init__(self, r: np.ndarray, y: np.ndarray, samples: float, config: SearchConfig) -> None:
        self.r, self.y, self.samples, self.config = r, y, samples, config
        self.energy = float(y @ y)
        self.max_terms = min(config.max_terms, r.shape[1])

    def criterion(self, rss: np.ndarray | float, terms: int) -> np.ndarray:
        """Return the criterion of models with `terms` terms and residual sums of squares `rss`.

        An error below `precision` of the target is no better than none.
        """
        share = np.maximum(np.asarray(rss), 0.0) / self.energy + self.config.precision**2
        room, gammaln = max(self.r.shape[1], terms), scipy.special.gammaln
        ways = gammaln(room + 1) - gammaln(terms + 1) - gammaln(room - terms + 1)
        fit, size = self.samples * np.log(share), terms * np.log(self.samples)
        return np.asarray(fit + size + 2.0 * self.config.gamma * ways)

    def exact(self, rss: float) -> bool:
        """Return whether a fit is as good as arithmetic allows."""
        return rss <= (2.0 * self.config.precision) ** 2 * self.energy

    def rss(self, chosen: Sequence[int]) -> float:
        """Return the residual sum of squares of the chosen columns."""
        left = self.beside(chosen)[1]
        return float(left @ left)

    def value(self, chosen: Sequence[int]) -> float:
        """Return the criterion of the chosen columns."""
        return float(self.criterion(self.rss(chosen), len(chosen)))

    def beside(
        self, chosen: Sequence[int], columns: np.ndarray | None = None
    ) -> tuple[np.ndarray | None, np.ndarray]:
        """Return what is left of columns [R, C] and of the target [R] beside chosen columns."""
        q = np.linalg.qr(self.r[:, list(chosen)])[0]
        target = self.y
        # twice: what the first projection rounded away
        for _ in range(2):
            target = target - q @ (q.T @ target)
            columns = None if columns is None else columns - q @ (q.T @ columns)
        return columns, target

    def best(self) -> tuple[float, list[int]]:
        """Return the best criterion on several ways forward side by side, and its columns.

        Each size keeps the best sets of the size before with one column more. A single way takes a
        column that stands for two true ones and seldom finds back.
        """
        best: tuple[float, list[int]] = (float(self.criterion(self.energy, 0)), [])
        sets, idle = np.zeros((1, 0), dtype=int), 0
        while sets.shape[1] < self.max_terms and idle < _PATIENCE:
            left = added_one(self.r, self.y, sets)
            order = np.argsort(left, axis=None)[: 4 * _BEAM]
            order = order[np.isfinite(left.ravel()[order])]
            if not order.size:
                break
            rows, added = np.unravel_index(order, left.shape)
            grown = np.sort(np.concatenate((sets[rows], added[:, None]), axis=1), axis=1)
            _, first = np.unique(grown, axis=0, return_index=True)
            sets = grown[np.sort(first)[:_BEAM]]
            leader = sets[0].tolist()
            rss = self.rss(leader)
            value, idle = float(self.criterion(rss, len(leader))), idle + 1
            if value < best[0]:
                best, idle = (value, leader), 0
            if self.exact(rss):
                break
        return best

    def trimmed(self, chosen: list[int]) -> list[int]:
        """Return the columns without those, least useful first, for which there is no evidence.

        Among many candidates one target in some dozens has a column that fits its noise well enough
        for the criterion alone. Of an exact fit what it does not need goes.
        """
        chosen, value = list(chosen), self.value(chosen)
        while chosen:
            estimate, inverse = coefficients(self.r[:, chosen], self.y)
            least = int((np.square(estimate) / np.square(inverse).sum(axis=1)).argmin())
            fewer = chosen[:least] + chosen[least + 1 :]
            without = self.value(fewer)
            evidence = 0.0 if self.exact(self.rss(chosen)) else _POSITIVE
            if without > value + evidence:
                break
            chosen, value = fewer, without
        return chosen


def added_one(r: np.ndarray, y: np.ndarray, sets: np.ndarray) -> np.ndarray:
    """Return sums of squares [M, J] that each column leaves when added to sets of columns [M, p].

    They are infinite where it adds nothing.
    """
    columns, target = np.repeat(r[None], len(sets), axis=0), np.repeat(y[None], len(sets), axis=0)
    if sets.shape[1]:
        q = np.linalg.qr(r.T[sets].transpose(0, 2, 1))[0]
        turned = q.transpose(0, 2, 1)
        columns = r - q @ (turned @ r)
        for _ in range(2):
            target = target - (q @ (turned @ target[..., None]))[..., 0]
    square = np.square(columns).sum(axis=1)
    usable = square > _ALIKE**2
    np.put_along_axis(usable, sets, False, axis=1)
    along = (target[:, None, :] @ columns)[:, 0]
    gains = np.square(along) / np.where(usable, square, 1.0)
    return np.where(usable, np.square(target).sum(axis=1)[:, None] - gains, np.inf)


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


NOTHING = Equation((), np.zeros(0), np.zeros(0), 1.0, False, 0.0, {}, {})
"""The equation without terms."""


def find(reduced: Reduced, target: int, config: SearchConfig) -> tuple[Equation, Reduced]:
    """Return the equation of one target, and the candidates that it was searched in.

    These are fewer where noise hides what sets some apart.
    """
    fine = _search(reduced, target, config)
    if fine.share <= _NOISY:
        return fine, reduced
    coarse = coarser(reduced, min(config.resolution, fine.share))
    if coarse.rank == reduced.rank:
        return fine, reduced
    simple = _search(coarse, target, config)
    preferred = simple.criterion <= fine.criterion + _EVIDENCE
    return (simple, coarse) if preferred else (fine, reduced)


def _search(reduced: Reduced, target: int, config: SearchConfig) -> Equation:
    """Return the best equation.

    Degrees are searched in turn, simplest first, until one explains the target exactly; otherwise
    the criterion, which knows how many candidates each had to choose from, decides between them.
    """
    y = reduced.y[:, target]
    if float(y @ y) <= _TINY:
        return Equation((), np.zeros(0), np.zeros(0), 0.0, True, -np.inf, {}, {})
    best: tuple[float, list[int], Search] | None = None
    for stage in np.unique(reduced.degree).tolist():
        search = _prepared(reduced, target, config, int((reduced.degree <= stage).sum()))
        value, chosen = search.best()
        if best is None or value < best[0]:
            best = (value, chosen, search)
        if search.exact(search.rss(best[1])):
            break
    assert best is not None
    _, chosen, search = best
    return equation_of(reduced, search, search.trimmed(chosen))


def _prepared(reduced: Reduced, target: int, config: SearchConfig, width: int) -> Search:
    """Return the search among the first `width` candidates."""
    samples = float(reduced.samples[target])
    return Search(reduced.r[:, :width], reduced.y[:, target], samples, config)


def everything(reduced: Reduced, target: int) -> Equation:
    """Return all candidates that the data tell apart, by least squares."""
    search = _prepared(reduced, target, SearchConfig(), reduced.rank)
    return equation_of(reduced, search, list(range(reduced.rank)))


def equation_of(reduced: Reduced, search: Search, chosen: list[int]) -> Equation:
    """Return the equation of the chosen columns, with what stands beside it."""
    chosen = sorted(chosen)
    rss = search.rss(chosen)
    exact = search.exact(rss)
    value, inverse = coefficients(search.r[:, chosen], search.y)
    std = np.sqrt(rss / max(search.samples - len(chosen), 1.0))
    errors = std * np.sqrt(np.square(inverse).sum(axis=1))
    names = np.array(reduced.names, dtype=object)
    return Equation(
        terms=tuple(names[chosen]),
        values=value / reduced.scale[chosen],
        errors=errors / reduced.scale[chosen],
        share=float(np.sqrt(rss / search.energy)),
        exact=exact,
        criterion=float(search.criterion(rss, len(chosen))),
        alternatives=_alternatives(search, chosen, names),
        undecided={} if exact else _undecided(search, chosen, names, std),
    )


def _alternatives(search: Search, chosen: list[int], names: np.ndarray) -> dict[str, list[str]]:
    """Return by term the candidates between which and it the data do not decide."""
    if not chosen:
        return {}
    limit = search.value(chosen) + _EVIDENCE
    kept = [[c for c in chosen if c != gone] for gone in chosen]
    sets = np.array(kept, dtype=int).reshape(len(chosen), -1)
    table = search.criterion(added_one(search.r, search.y, sets), len(chosen))
    out: dict[str, list[str]] = {}
    for place, others, row in zip(chosen, kept, table, strict=True):
        near = [int(j) for j in np.flatnonzero(row <= limit + _EVIDENCE) if j not in chosen]
        # the table loses digits by cancellation where a fit is exact
        if same := [str(names[j]) for j in near if search.value([*others, j]) <= limit]:
            out[str(names[place])] = same
    return out


def _undecided(
    search: Search, chosen: list[int], names: np.ndarray, std: float
) -> dict[str, float]:
    """Return the candidates whose coefficient the data leave so open that they could matter.

    Each has the share of the target within two standard errors.
    """
    columns, target = search.beside(chosen, search.r)
    assert columns is not None
    length = np.linalg.norm(columns, axis=0)
    free = np.flatnonzero(length > _MADE_UP)
    free = free[~np.isin(free, chosen)]
    along = np.abs(columns[:, free].T @ target) / length[free]
    reach = (along + 2.0 * std) / length[free] / np.sqrt(search.energy)
    return {str(names[j]): round(float(s), 3) for j, s in zip(free, reach, strict=True) if s > 0.05}


@final
class SparseRegression(Estimator):
    """Sparse regression without intercept, its length by the extended BIC.

    The notes of a solution have, under `equations`, what the data say about each output.

    Args:
        degrees: degree of each candidate, [J]: the stages of the search; one stage where empty.
        efforts: how complicated each candidate is within its degree, [J]; the order given where
            empty.
        allowed: which candidates each output may have, [J, n] bool; None for all.
        gammas: weights of the number of candidates in the extended BIC with which `fit` offers
            alternatives, and no terms at all; none where empty.
    """

    def __init__(
        self,
        search: SearchConfig | None = None,
        *,
        degrees: Sequence[int] = (),
        efforts: Sequence[float] = (),
        allowed: Tensor | None = None,
        gammas: Sequence[float] = (),
    ) -> None:
        self.search = search or SearchConfig()
        self.degrees = tuple(degrees)
        self.efforts = tuple(efforts)
        self.allowed = allowed
        self.gammas = tuple(gammas)

    def solve(self, data: Data) -> list[Solution]:
        """Return the solution of the extended BIC, then the alternatives that differ from it.

        Groups do not matter.
        """
        _, y, _, names, outputs = data
        reduced = self._reduced(whole(data.x).numpy(), y.numpy(), names)
        preferred = self._solution(reduced, self.search, names, outputs)
        if not self.gammas:
            return [preferred]
        solutions = [preferred]
        for gamma in self.gammas:
            if gamma != self.search.gamma:
                search = self.search.model_copy(update={"gamma": gamma})
                other = self._solution(reduced, search, names, outputs)
                if not torch.equal(other.coefficients, preferred.coefficients):
                    solutions.append(other)
        nothing = {
            output: NOTHING.summary(part) for output, part in zip(outputs, reduced, strict=True)
        }
        notes = preferred.notes | {"parameters": 0, "coefficients": [], "equations": nothing}
        state = {"coefficients": torch.zeros_like(preferred.coefficients)}
        return [*solutions, Solution({"kept": [0] * len(outputs)}, state, notes=notes)]

    def _reduced(self, x: np.ndarray, y: np.ndarray, names: Sequence[str]) -> list[Reduced]:
        """Return the regression of each output, reduced to its QR factor; one for all if it can."""
        degrees = self.degrees or (1,) * len(names)
        every = torch.ones(len(names), y.shape[1], dtype=torch.bool)
        found: dict[tuple[int, ...], Reduced] = {}
        out = []
        for mask in (every if self.allowed is None else self.allowed).T:
            columns = tuple(mask.nonzero()[:, 0].tolist())
            if columns not in found:
                efforts = [self.efforts[j] for j in columns] if self.efforts else ()
                chosen = [names[j] for j in columns], [degrees[j] for j in columns], efforts
                found[columns] = reduce(x[:, columns], y, *chosen)
            out.append(found[columns])
        return out

    def _solution(
        self,
        reduced: Sequence[Reduced],
        search: SearchConfig,
        names: Sequence[str],
        outputs: Sequence[str],
    ) -> Solution:
        found = [find(part, output, search) for output, part in enumerate(reduced)]
        coefficients = torch.zeros(len(names), len(outputs), dtype=torch.float64)
        table: list[Coefficient] = []
        for k, (output, (equation, _)) in enumerate(zip(outputs, found, strict=True)):
            for term, value, error in zip(
                equation.terms, equation.values.tolist(), equation.errors.tolist(), strict=True
            ):
                coefficients[names.index(term), k] = value
                table.append(Coefficient(output, term, value, error))
        unexcited = dict.fromkeys(term for part in reduced for term in part.unexcited)
        notes: dict[str, Any] = {
            "terms": len(names),
            "parameters": len(table),
            "coefficients": [coefficient_row(entry) for entry in table],
            "unexcited": list(unexcited),
            "equations": {
                output: equation.summary(within)
                for output, (equation, within) in zip(outputs, found, strict=True)
            },
        }
        choice = {"kept": [len(equation.terms) for equation, _ in found], "gamma": search.gamma}
        return Solution(choice, {"coefficients": coefficients}, tuple(table), notes)


def coefficient_row(entry: Coefficient) -> dict[str, Any]:
    """Return a coefficient as it stands in the notes of a fit."""
    return {
        "axis": entry.axis,
        "term": entry.term,
        "value": entry.value,
        "standard_error": entry.error,
    }

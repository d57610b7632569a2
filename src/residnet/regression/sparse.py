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
from residnet.regression.equation_rows import effective_correlation_length
from residnet.regression.estimator import Coefficient, Estimator, EstimatorData, Solution, to_dense

_DEPENDENCE_TOLERANCE = 1e-12
"""Share of a column's length that must be left beside simpler columns; below it rounding decides.
"""
_MIN_NORM = 1e-300
"""Length of a column or target from which it counts, and least divisor of a condition number."""
_MIN_REPORTED_SHARE = 1e-6
"""Least share of a simpler column in a dependent one at which it is named."""
_DUPLICATE_TOLERANCE = 1e-11
"""Length of a unit column beside the chosen ones below which it adds nothing that rounding does
not.
"""
_SPAN_TOLERANCE = 1e-9
"""Length of a unit column beside the chosen ones up to which it is made up of them."""
_NOISE_SHARE = 1e-9
"""Unexplained share of a target from which data count as noisy."""
_POSITIVE_EVIDENCE = 3.0
"""Difference of the criterion from which one term more counts as evident: between positive and
strong evidence (Kass and Raftery 1995).
"""
_STRONG_EVIDENCE = 6.0
"""Difference of the criterion above which one model is strongly preferred to another (ibid.)."""
_BEAM_WIDTH = 12
"""Sets of columns of one size that are followed side by side: of 30 random problems with nine
correlated columns 6 miss the best of all subsets once, 12 never.
"""
_MAX_SIZES_WITHOUT_GAIN = 6
"""Sizes without a gain of the criterion after which the search ends: an exact equation may gain
nothing before its last term (a mass-spring-damper's three, the jets' from steps; 2 misses both).
"""


class SparseSearchConfig(Config):
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
class ReducedProblem:
    """The candidates and targets in the coordinates of one QR factorisation.

    Attributes:
        names: the J candidates that the data tell apart, simplest first.
        degree: degree of each, ascending, [J].
        scale: length of each column before it was scaled to one, [J].
        r: columns of unit length in the new coordinates [J + K, J].
        y: targets in the same coordinates [J + K, K].
        independent_samples: as many independent rows as the correlated ones are worth for each target, [K].
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
    independent_samples: np.ndarray
    rank: int
    condition: float
    unexcited: tuple[str, ...]
    dependent: dict[str, dict[str, float]]


def reduce_problem(
    x: np.ndarray,
    y: np.ndarray,
    names: Sequence[str],
    degree: Sequence[int],
    complexity: Sequence[float] = (),
) -> ReducedProblem:
    """Return candidates and targets by one QR factorisation.

    Columns that simpler ones make up are set aside.

    Args:
        x: candidate columns [N, J].
        y: targets [N, K].
        degree: of the columns: the stages of the search.
        complexity: how complicated each column is, within its degree; the order given where empty.

    Raises:
        FitError: with values that are not finite, no candidate that is excited, or fewer samples
            than candidates.
    """
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        non_finite = [
            name
            for name, is_finite in zip(names, np.isfinite(x).all(axis=0), strict=True)
            if not is_finite
        ]
        subject = f"term '{non_finite[0]}'" if non_finite else "the target"
        raise FitError(
            f"sparse regression: {subject} is not finite in all samples; mask those or leave the"
            " term out"
        )
    order = np.lexsort(
        (np.asarray(complexity) if len(complexity) else np.arange(x.shape[1]), np.asarray(degree))
    )
    column_norm = np.linalg.norm(x, axis=0)[order]
    excited = order[column_norm > _MIN_NORM]
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
    r_factor = _r_factor(np.concatenate((x[:, excited] / scale, y), axis=1))
    all_candidates = ReducedProblem(
        names=tuple(names[i] for i in excited),
        degree=np.asarray(degree)[excited],
        scale=scale,
        r=r_factor[:, : excited.size],
        y=r_factor[:, excited.size :],
        independent_samples=np.full(y.shape[1], float(x.shape[0])),
        rank=excited.size,
        condition=np.inf,
        unexcited=tuple(names[i] for i in order[column_norm <= _MIN_NORM]),
        dependent={},
    )
    distinct = merge_similar_columns(all_candidates, _DEPENDENCE_TOLERANCE)
    columns = [excited[all_candidates.names.index(name)] for name in distinct.names]
    coefficients = (
        np.linalg.solve(distinct.r[: distinct.rank], distinct.y[: distinct.rank])
        / distinct.scale[:, None]
    )
    return replace(
        distinct,
        independent_samples=x.shape[0]
        / effective_correlation_length(y - x[:, columns] @ coefficients),
    )


def merge_similar_columns(reduced: ReducedProblem, resolution: float) -> ReducedProblem:
    """Return the same without the candidates that hardly differ from simpler ones.

    They differ by no more than a share of their length.
    """
    retained = list(range(len(reduced.names)))
    while True:
        orthogonal_norms = np.abs(np.diagonal(_r_factor(reduced.r[:, retained])))
        dependent_columns = [retained[i] for i in np.flatnonzero(orthogonal_norms <= resolution)]
        if not dependent_columns:
            break
        retained = [i for i in retained if i not in dependent_columns]
    q, r_retained = np.linalg.qr(reduced.r[:, retained])
    dependent: dict[str, dict[str, float]] = {}
    for i in sorted({*range(len(reduced.names))} - {*retained}):
        simpler = [k for k in retained if k < i]
        weights = scipy.linalg.solve_triangular(
            r_retained[: len(simpler), : len(simpler)], q[:, : len(simpler)].T @ reduced.r[:, i]
        )
        components = {
            reduced.names[k]: float(weight * reduced.scale[i] / reduced.scale[k])
            for k, weight in zip(simpler, weights, strict=True)
            if abs(weight) > max(_MIN_REPORTED_SHARE, resolution)
        }
        dependent[reduced.names[i]] = components
    r_factor = _r_factor(np.concatenate((reduced.r[:, retained], reduced.y), axis=1))
    singular_values = np.linalg.svd(r_factor[:, : len(retained)], compute_uv=False)
    return replace(
        reduced,
        names=tuple(reduced.names[i] for i in retained),
        degree=reduced.degree[retained],
        scale=reduced.scale[retained],
        r=r_factor[:, : len(retained)],
        y=r_factor[:, len(retained) :],
        rank=len(retained),
        condition=float(singular_values[0] / max(singular_values[-1], _MIN_NORM)),
        dependent=reduced.dependent | dependent,
    )


def _r_factor(x: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.qr(x, mode="r"))


def solve_least_squares(r: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return least-squares coefficients [p] of columns [R, p], and their triangle's inverse.

    The rows of the inverse [p, p] give standard errors.
    """
    q, r_factor = np.linalg.qr(r)
    r_inverse = np.linalg.inv(r_factor) if r_factor.size else r_factor
    return r_inverse @ (q.T @ y), r_inverse


@final
class ForwardSearch:
    """A search of one target [R] in columns of unit length [R, J], by the extended BIC.

    Args:
        independent_samples: as many independent rows as the correlated ones are worth.
    """

    def __init__(
        self, r: np.ndarray, y: np.ndarray, independent_samples: float, config: SparseSearchConfig
    ) -> None:
        self.r, self.y, self.independent_samples, self.config = r, y, independent_samples, config
        self.target_energy = float(y @ y)
        self.max_terms = min(config.max_terms, r.shape[1])

    def criterion(self, rss: np.ndarray | float, n_terms: int) -> np.ndarray:
        """Return the criterion of models with `n_terms` terms and residual sums of squares `rss`.

        An error below `precision` of the target is no better than none.
        """
        relative_rss = (
            np.maximum(np.asarray(rss), 0.0) / self.target_energy + self.config.precision**2
        )
        n_candidates, gammaln = max(self.r.shape[1], n_terms), scipy.special.gammaln
        log_combinations = (
            gammaln(n_candidates + 1) - gammaln(n_terms + 1) - gammaln(n_candidates - n_terms + 1)
        )
        goodness_of_fit, size_penalty = (
            self.independent_samples * np.log(relative_rss),
            n_terms * np.log(self.independent_samples),
        )
        return np.asarray(
            goodness_of_fit + size_penalty + 2.0 * self.config.gamma * log_combinations
        )

    def is_exact(self, rss: float) -> bool:
        """Return whether a fit is as good as arithmetic allows."""
        return rss <= (2.0 * self.config.precision) ** 2 * self.target_energy

    def rss(self, subset: Sequence[int]) -> float:
        """Return the residual sum of squares of the chosen columns."""
        residual = self.project_out(subset)[1]
        return float(residual @ residual)

    def criterion_of(self, subset: Sequence[int]) -> float:
        """Return the criterion of the chosen columns."""
        return float(self.criterion(self.rss(subset), len(subset)))

    def project_out(
        self, subset: Sequence[int], other_columns: np.ndarray | None = None
    ) -> tuple[np.ndarray | None, np.ndarray]:
        """Return what is left of columns [R, C] and of the target [R] beside chosen columns."""
        q = np.linalg.qr(self.r[:, list(subset)])[0]
        target = self.y
        # twice: what the first projection rounded away
        for _ in range(2):
            target = target - q @ (q.T @ target)
            other_columns = (
                None if other_columns is None else other_columns - q @ (q.T @ other_columns)
            )
        return other_columns, target

    def beam_search(self) -> tuple[float, list[int]]:
        """Return the best criterion on several ways forward side by side, and its columns.

        Each size keeps the best sets of the size before with one column more. A single way takes a
        column that stands for two true ones and seldom finds back.
        """
        best_subset: tuple[float, list[int]] = (float(self.criterion(self.target_energy, 0)), [])
        subsets, sizes_without_gain = np.zeros((1, 0), dtype=int), 0
        while subsets.shape[1] < self.max_terms and sizes_without_gain < _MAX_SIZES_WITHOUT_GAIN:
            rss_table = rss_with_one_added(self.r, self.y, subsets)
            order = np.argsort(rss_table, axis=None)[: 4 * _BEAM_WIDTH]
            order = order[np.isfinite(rss_table.ravel()[order])]
            if not order.size:
                break
            rows, added_column = np.unravel_index(order, rss_table.shape)
            extended = np.sort(
                np.concatenate((subsets[rows], added_column[:, None]), axis=1), axis=1
            )
            _, unique_index = np.unique(extended, axis=0, return_index=True)
            subsets = extended[np.sort(unique_index)[:_BEAM_WIDTH]]
            leading_set = subsets[0].tolist()
            rss = self.rss(leading_set)
            criterion_value, sizes_without_gain = (
                float(self.criterion(rss, len(leading_set))),
                sizes_without_gain + 1,
            )
            if criterion_value < best_subset[0]:
                best_subset, sizes_without_gain = (criterion_value, leading_set), 0
            if self.is_exact(rss):
                break
        return best_subset

    def backward_eliminate(self, subset: list[int]) -> list[int]:
        """Return the columns without those, least useful first, for which there is no evidence.

        Among many candidates one target in some dozens has a column that fits its noise well enough
        for the criterion alone. Of an exact fit what it does not need goes.
        """
        subset, criterion_value = list(subset), self.criterion_of(subset)
        while subset:
            estimate, inverse = solve_least_squares(self.r[:, subset], self.y)
            weakest = int((np.square(estimate) / np.square(inverse).sum(axis=1)).argmin())
            reduced_subset = subset[:weakest] + subset[weakest + 1 :]
            reduced_criterion = self.criterion_of(reduced_subset)
            required_evidence = 0.0 if self.is_exact(self.rss(subset)) else _POSITIVE_EVIDENCE
            if reduced_criterion > criterion_value + required_evidence:
                break
            subset, criterion_value = reduced_subset, reduced_criterion
        return subset


def rss_with_one_added(r: np.ndarray, y: np.ndarray, subsets: np.ndarray) -> np.ndarray:
    """Return sums of squares [M, J] that each column leaves when added to sets of columns [M, p].

    They are infinite where it adds nothing.
    """
    columns, target = (
        np.repeat(r[None], len(subsets), axis=0),
        np.repeat(y[None], len(subsets), axis=0),
    )
    if subsets.shape[1]:
        q = np.linalg.qr(r.T[subsets].transpose(0, 2, 1))[0]
        q_transposed = q.transpose(0, 2, 1)
        columns = r - q @ (q_transposed @ r)
        for _ in range(2):
            target = target - (q @ (q_transposed @ target[..., None]))[..., 0]
    column_energy = np.square(columns).sum(axis=1)
    usable = column_energy > _DUPLICATE_TOLERANCE**2
    np.put_along_axis(usable, subsets, False, axis=1)
    projection = (target[:, None, :] @ columns)[:, 0]
    rss_decrease = np.square(projection) / np.where(usable, column_energy, 1.0)
    return np.where(usable, np.square(target).sum(axis=1)[:, None] - rss_decrease, np.inf)


@dataclass(frozen=True)
class SparseEquation:
    """A target as a sum of few terms.

    Attributes:
        terms: names, simplest first.
        values: coefficients.
        standard_errors: standard errors of the coefficients.
        relative_error: RMS error over RMS of the target.
        is_exact: whether the error is at the precision of the arithmetic.
        criterion: extended BIC.
        alternatives: term -> other candidates that could stand in its place as far as these data
            can tell.
        undecided: candidates left out whose coefficient could, within two standard errors, make up
            a twentieth of the target: {name: that share}.
    """

    terms: tuple[str, ...]
    values: np.ndarray
    standard_errors: np.ndarray
    relative_error: float
    is_exact: bool
    criterion: float
    alternatives: dict[str, list[str]]
    undecided: dict[str, float]

    def summary(self, problem: ReducedProblem) -> dict[str, Any]:
        """Return what the data say about the equation, for fit.json.

        It holds among the candidates that were searched.
        """
        return {
            "error_share": self.relative_error,
            "exact": self.is_exact,
            "candidates": problem.rank,
            "condition": problem.condition,
            "same_as_simpler": problem.dependent,
            "cannot_tell_apart": self.alternatives,
            "undecided": self.undecided,
        }


EMPTY_EQUATION = SparseEquation((), np.zeros(0), np.zeros(0), 1.0, False, 0.0, {}, {})
"""The equation without terms."""


def find_equation(
    reduced: ReducedProblem, output_index: int, config: SparseSearchConfig
) -> tuple[SparseEquation, ReducedProblem]:
    """Return the equation of one target, and the candidates that it was searched in.

    These are fewer where noise hides what sets some apart.
    """
    full_equation = _search_by_degree(reduced, output_index, config)
    if full_equation.relative_error <= _NOISE_SHARE:
        return full_equation, reduced
    coarse_problem = merge_similar_columns(
        reduced, min(config.resolution, full_equation.relative_error)
    )
    if coarse_problem.rank == reduced.rank:
        return full_equation, reduced
    coarse_equation = _search_by_degree(coarse_problem, output_index, config)
    prefers_coarse = coarse_equation.criterion <= full_equation.criterion + _STRONG_EVIDENCE
    return (coarse_equation, coarse_problem) if prefers_coarse else (full_equation, reduced)


def _search_by_degree(
    reduced: ReducedProblem, output_index: int, config: SparseSearchConfig
) -> SparseEquation:
    """Return the best equation.

    Degrees are searched in turn, simplest first, until one explains the target exactly; otherwise
    the criterion, which knows how many candidates each had to choose from, decides between them.
    """
    target_column = reduced.y[:, output_index]
    if float(target_column @ target_column) <= _MIN_NORM:
        return SparseEquation((), np.zeros(0), np.zeros(0), 0.0, True, -np.inf, {}, {})
    best_candidate: tuple[float, list[int], ForwardSearch] | None = None
    for max_degree in np.unique(reduced.degree).tolist():
        search = _make_search(
            reduced, output_index, config, int((reduced.degree <= max_degree).sum())
        )
        criterion_value, subset = search.beam_search()
        if best_candidate is None or criterion_value < best_candidate[0]:
            best_candidate = (criterion_value, subset, search)
        if search.is_exact(search.rss(best_candidate[1])):
            break
    assert best_candidate is not None
    _, subset, search = best_candidate
    return build_equation(reduced, search, search.backward_eliminate(subset))


def _make_search(
    reduced: ReducedProblem, output_index: int, config: SparseSearchConfig, n_candidates: int
) -> ForwardSearch:
    """Return the search among the first `n_candidates` candidates."""
    independent_samples = float(reduced.independent_samples[output_index])
    return ForwardSearch(
        reduced.r[:, :n_candidates], reduced.y[:, output_index], independent_samples, config
    )


def fit_all_candidates(reduced: ReducedProblem, output_index: int) -> SparseEquation:
    """Return all candidates that the data tell apart, by least squares."""
    search = _make_search(reduced, output_index, SparseSearchConfig(), reduced.rank)
    return build_equation(reduced, search, list(range(reduced.rank)))


def build_equation(
    reduced: ReducedProblem, search: ForwardSearch, subset: list[int]
) -> SparseEquation:
    """Return the equation of the chosen columns, with what stands beside it."""
    subset = sorted(subset)
    rss = search.rss(subset)
    is_exact = search.is_exact(rss)
    coefficient_values, r_inverse = solve_least_squares(search.r[:, subset], search.y)
    residual_std = np.sqrt(rss / max(search.independent_samples - len(subset), 1.0))
    standard_errors = residual_std * np.sqrt(np.square(r_inverse).sum(axis=1))
    names = np.array(reduced.names, dtype=object)
    return SparseEquation(
        terms=tuple(names[subset]),
        values=coefficient_values / reduced.scale[subset],
        standard_errors=standard_errors / reduced.scale[subset],
        relative_error=float(np.sqrt(rss / search.target_energy)),
        is_exact=is_exact,
        criterion=float(search.criterion(rss, len(subset))),
        alternatives=_equivalent_terms(search, subset, names),
        undecided={} if is_exact else _undecided_terms(search, subset, names, residual_std),
    )


def _equivalent_terms(
    search: ForwardSearch, subset: list[int], names: np.ndarray
) -> dict[str, list[str]]:
    """Return by term the candidates between which and it the data do not decide."""
    if not subset:
        return {}
    criterion_limit = search.criterion_of(subset) + _STRONG_EVIDENCE
    reduced_subsets = [[column for column in subset if column != removed] for removed in subset]
    subsets = np.array(reduced_subsets, dtype=int).reshape(len(subset), -1)
    criterion_table = search.criterion(rss_with_one_added(search.r, search.y, subsets), len(subset))
    alternatives: dict[str, list[str]] = {}
    for column_index, reduced_subset, criterion_row in zip(
        subset, reduced_subsets, criterion_table, strict=True
    ):
        candidates = [
            int(j)
            for j in np.flatnonzero(criterion_row <= criterion_limit + _STRONG_EVIDENCE)
            if j not in subset
        ]
        # the table loses digits by cancellation where a fit is exact
        if equivalent := [
            str(names[j])
            for j in candidates
            if search.criterion_of([*reduced_subset, j]) <= criterion_limit
        ]:
            alternatives[str(names[column_index])] = equivalent
    return alternatives


def _undecided_terms(
    search: ForwardSearch, subset: list[int], names: np.ndarray, residual_std: float
) -> dict[str, float]:
    """Return the candidates whose coefficient the data leave so open that they could matter.

    Each has the share of the target within two standard errors.
    """
    columns, target = search.project_out(subset, search.r)
    assert columns is not None
    orthogonal_norms = np.linalg.norm(columns, axis=0)
    free_columns = np.flatnonzero(orthogonal_norms > _SPAN_TOLERANCE)
    free_columns = free_columns[~np.isin(free_columns, subset)]
    projection = np.abs(columns[:, free_columns].T @ target) / orthogonal_norms[free_columns]
    upper_share = (
        (projection + 2.0 * residual_std)
        / orthogonal_norms[free_columns]
        / np.sqrt(search.target_energy)
    )
    return {
        str(names[j]): round(float(share), 3)
        for j, share in zip(free_columns, upper_share, strict=True)
        if share > 0.05
    }


@final
class SparseRegression(Estimator):
    """Sparse regression without intercept, its length by the extended BIC.

    The notes of a solution have, under `equations`, what the data say about each output.

    Args:
        degrees: degree of each candidate, [J]: the stages of the search; one stage where empty.
        complexities: how complicated each candidate is within its degree, [J]; the order given where
            empty.
        allowed_terms: which candidates each output may have, [J, n] bool; None for all.
        gammas: weights of the number of candidates in the extended BIC with which `goodness_of_fit` offers
            alternatives, and no terms at all; none where empty.
    """

    def __init__(
        self,
        search: SparseSearchConfig | None = None,
        *,
        degrees: Sequence[int] = (),
        complexities: Sequence[float] = (),
        allowed_terms: Tensor | None = None,
        gammas: Sequence[float] = (),
    ) -> None:
        self.search = search or SparseSearchConfig()
        self.degrees = tuple(degrees)
        self.complexities = tuple(complexities)
        self.allowed_terms = allowed_terms
        self.gammas = tuple(gammas)

    def _solve(self, data: EstimatorData) -> list[Solution]:
        """Return the solution of the extended BIC, then the alternatives that differ from it.

        Groups do not matter.
        """
        _, y, _, names, outputs = data
        problems = self._reduce_outputs(to_dense(data.x).numpy(), y.numpy(), names)
        preferred = self._build_solution(problems, self.search, names, outputs)
        if not self.gammas:
            return [preferred]
        solutions = [preferred]
        for gamma in self.gammas:
            if gamma != self.search.gamma:
                search = self.search.model_copy(update={"gamma": gamma})
                alternative = self._build_solution(problems, search, names, outputs)
                if not torch.equal(alternative.coefficients, preferred.coefficients):
                    solutions.append(alternative)
        empty_summaries = {
            output: EMPTY_EQUATION.summary(problem)
            for output, problem in zip(outputs, problems, strict=True)
        }
        notes = preferred.notes | {
            "parameters": 0,
            "coefficients": [],
            "equations": empty_summaries,
        }
        state = {"coefficients": torch.zeros_like(preferred.coefficients)}
        return [*solutions, Solution({"kept": [0] * len(outputs)}, state, notes=notes)]

    def _reduce_outputs(
        self, x: np.ndarray, y: np.ndarray, names: Sequence[str]
    ) -> list[ReducedProblem]:
        """Return the regression of each output, reduced to its QR factor; one for all if it can."""
        degrees = self.degrees or (1,) * len(names)
        all_allowed = torch.ones(len(names), y.shape[1], dtype=torch.bool)
        cache: dict[tuple[int, ...], ReducedProblem] = {}
        problems = []
        for mask in (all_allowed if self.allowed_terms is None else self.allowed_terms).T:
            columns = tuple(mask.nonzero()[:, 0].tolist())
            if columns not in cache:
                complexities = [self.complexities[j] for j in columns] if self.complexities else ()
                reduce_arguments = (
                    [names[j] for j in columns],
                    [degrees[j] for j in columns],
                    complexities,
                )
                cache[columns] = reduce_problem(x[:, columns], y, *reduce_arguments)
            problems.append(cache[columns])
        return problems

    def _build_solution(
        self,
        problems: Sequence[ReducedProblem],
        config: SparseSearchConfig,
        names: Sequence[str],
        outputs: Sequence[str],
    ) -> Solution:
        equations = [
            find_equation(problem, output, config) for output, problem in enumerate(problems)
        ]
        coefficients = torch.zeros(len(names), len(outputs), dtype=torch.float64)
        coefficients_table: list[Coefficient] = []
        for output_index, (output, (equation, _)) in enumerate(
            zip(outputs, equations, strict=True)
        ):
            for term, value, standard_error in zip(
                equation.terms,
                equation.values.tolist(),
                equation.standard_errors.tolist(),
                strict=True,
            ):
                coefficients[names.index(term), output_index] = value
                coefficients_table.append(Coefficient(output, term, value, standard_error))
        unexcited = dict.fromkeys(term for problem in problems for term in problem.unexcited)
        notes: dict[str, Any] = {
            "terms": len(names),
            "parameters": len(coefficients_table),
            "coefficients": [
                coefficient_to_dict(coefficient) for coefficient in coefficients_table
            ],
            "unexcited": list(unexcited),
            "equations": {
                output: equation.summary(problem)
                for output, (equation, problem) in zip(outputs, equations, strict=True)
            },
        }
        hyperparameters = {
            "kept": [len(equation.terms) for equation, _ in equations],
            "gamma": config.gamma,
        }
        return Solution(
            hyperparameters, {"coefficients": coefficients}, tuple(coefficients_table), notes
        )


def coefficient_to_dict(coefficient: Coefficient) -> dict[str, Any]:
    """Return a coefficient as it stands in the notes of a fit."""
    return {
        "axis": coefficient.axis,
        "term": coefficient.term,
        "value": coefficient.value,
        "standard_error": coefficient.standard_error,
    }

"""Sparse regression: select the few candidate terms that explain a target.

The method works on a QR factorisation of [candidates | targets] in three steps. Candidates that
are linearly dependent on simpler ones are removed. A beam search adds terms by orthogonal forward
regression and scores the models by the extended BIC. Backward elimination removes the terms without
evidence. The Gram matrix would lose half of the significant digits, and candidates such as u,
u cos(delta) and u |u| differ in the eighth digit on a log of small nozzle angles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np
import scipy
import torch
from torch import Tensor

from residnet.core.errors import FitError
from residnet.regression.equation_rows import effective_correlation_length
from residnet.regression.estimator import Coefficient, Estimator, EstimatorData, Solution, to_dense
from residnet.regression.sparse_config import SparseSearchConfig

_DEPENDENCE_TOLERANCE = 1e-12
"""Norm of the component of a unit column orthogonal to simpler columns, below which the column
counts as linearly dependent on them.
"""
_MIN_NORM = 1e-300
"""Norm below which a column or target counts as zero; lower bound of a denominator."""
_MIN_REPORTED_SHARE = 1e-6
"""Minimum weight of a simpler column that is reported as a component of a dependent column."""
_DUPLICATE_TOLERANCE = 1e-11
"""Norm of the component of a unit column orthogonal to a subset, below which the component is a
rounding error.
"""
_SPAN_TOLERANCE = 1e-9
"""Norm of the component of a unit column orthogonal to a subset, below which the share of the
column is not estimated.
"""
_NOISE_SHARE = 1e-9
"""Relative error of the best equation above which the data count as noisy."""
_POSITIVE_EVIDENCE = 3.0
"""Increase of the BIC by removal of a term, up to which backward elimination removes the term.

It lies between positive and strong evidence (Kass and Raftery 1995).
"""
_STRONG_EVIDENCE = 6.0
"""Difference of the BIC that is strong evidence for a model (Kass and Raftery 1995)."""
_BEAM_WIDTH = 12
"""Number of subsets of one size in the beam search.

On 30 random problems with nine correlated columns, a width of 6 missed the best of all subsets
once and a width of 12 never.
"""
_MAX_SIZES_WITHOUT_GAIN = 6
"""Number of consecutive sizes without a decrease of the criterion, after which the search ends.

The criterion of an exact equation may decrease at its last term only. With 2, the search misses the
three terms of a mass-spring-damper and the equations of water jets from steps.
"""


@dataclass(frozen=True)
class ReducedProblem:
    """A regression of K targets on J candidates, reduced to the R factor of its columns.

    Attributes:
        names: names of the linearly independent candidates, simplest first.
        degree: degree of each candidate, ascending, [J].
        scale: norm of each column before scaling to unit norm, [J].
        r: unit columns in the coordinates of the QR factorisation of [columns | targets]
            [J + K, J]. Inner products, and hence least squares, are those of the N samples.
        y: targets in the same coordinates [J + K, K].
        n_independent_samples: effective number of independent samples of each target, [K].
        rank: number of linearly independent candidates J.
        condition: condition number of the unit columns.
        unexcited: names of candidates that are zero in all samples.
        dependent: removed candidate -> simpler candidates and their weights on these data, for
            example {"u|u|": {"u^2": 1.0}}.
    """

    names: tuple[str, ...]
    degree: np.ndarray
    scale: np.ndarray
    r: np.ndarray
    y: np.ndarray
    n_independent_samples: np.ndarray
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
    """Reduce a regression by QR factorisation and remove linearly dependent candidates.

    Args:
        x: candidate columns [N, J].
        y: targets [N, K].
        names: names of the candidates.
        degree: degree of each candidate, by which the stages of the search are ordered.
        complexity: sort key of the candidates within a degree; their order if empty.

    Raises:
        FitError: if values are not finite, all candidates are zero, or there are fewer samples than
            candidates.
    """
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        non_finite = [
            name
            for name, is_finite in zip(names, np.isfinite(x).all(axis=0), strict=True)
            if not is_finite
        ]
        subject = f"term '{non_finite[0]}'" if non_finite else "the target"
        raise FitError(
            f"sparse regression: {subject} is not finite in all samples; mask these samples or"
            " remove the term"
        )
    order = np.lexsort(
        (np.asarray(complexity) if len(complexity) else np.arange(x.shape[1]), np.asarray(degree))
    )
    column_norm = np.linalg.norm(x, axis=0)[order]
    excited = order[column_norm > _MIN_NORM]
    if not excited.size:
        raise FitError(
            "sparse regression: every candidate term is zero in all samples; give data that"
            " excite the terms"
        )
    if x.shape[0] <= excited.size + y.shape[1]:
        raise FitError(
            f"sparse regression: {x.shape[0]} samples do not determine {excited.size} candidates;"
            " give longer logs or fewer candidates"
        )
    # unit columns make the diagonal of the R factor comparable between candidates
    scale = np.linalg.norm(x[:, excited], axis=0)
    r_factor = _r_factor(np.concatenate((x[:, excited] / scale, y), axis=1))
    all_candidates = ReducedProblem(
        names=tuple(names[i] for i in excited),
        degree=np.asarray(degree)[excited],
        scale=scale,
        r=r_factor[:, : excited.size],
        y=r_factor[:, excited.size :],
        n_independent_samples=np.full(y.shape[1], float(x.shape[0])),
        rank=excited.size,
        condition=np.inf,
        unexcited=tuple(names[i] for i in order[column_norm <= _MIN_NORM]),
        dependent={},
    )
    # the autocorrelation of the residuals of the full model estimates how many samples are
    # independent
    distinct = merge_similar_columns(all_candidates, _DEPENDENCE_TOLERANCE)
    columns = [excited[all_candidates.names.index(name)] for name in distinct.names]
    coefficients = (
        np.linalg.solve(distinct.r[: distinct.rank], distinct.y[: distinct.rank])
        / distinct.scale[:, None]
    )
    return replace(
        distinct,
        n_independent_samples=x.shape[0]
        / effective_correlation_length(y - x[:, columns] @ coefficients),
    )


def merge_similar_columns(reduced: ReducedProblem, resolution: float) -> ReducedProblem:
    """Return the problem without the candidates that are nearly dependent on simpler ones.

    Args:
        reduced: problem with unit columns.
        resolution: norm after projection on simpler columns, up to which a column is removed.
    """
    # a removed column no longer hides others, so repeat until every column is distinct
    retained = list(range(len(reduced.names)))
    while True:
        orthogonal_norms = np.abs(np.diagonal(_r_factor(reduced.r[:, retained])))
        dependent_columns = [retained[i] for i in np.flatnonzero(orthogonal_norms <= resolution)]
        if not dependent_columns:
            break
        retained = [i for i in retained if i not in dependent_columns]
    # write the removed columns as combinations of simpler ones
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
    """Return the upper triangular R of x = Q R; Q is not computed."""
    return np.asarray(np.linalg.qr(x, mode="r"))


def solve_least_squares(r: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the least-squares coefficients [p] of columns [R, p] and the inverse R factor [p, p].

    The norms of the rows of the inverse are proportional to the standard errors.
    """
    q, r_factor = np.linalg.qr(r)
    r_inverse = np.linalg.inv(r_factor) if r_factor.size else r_factor
    return r_inverse @ (q.T @ y), r_inverse


@final
class ForwardSearch:
    """Search for a sparse equation of a target by the extended BIC.

    Args:
        r: candidate columns of unit norm [R, J].
        y: target [R].
        n_independent_samples: effective number of independent samples.
        config: settings of the search.
    """

    def __init__(
        self, r: np.ndarray, y: np.ndarray, n_independent_samples: float, config: SparseSearchConfig
    ) -> None:
        self.r = r
        self.y = y
        self.n_independent_samples = n_independent_samples
        self.config = config
        self.target_energy = float(y @ y)
        self.max_terms = min(config.max_terms, r.shape[1])

    def criterion(self, rss: np.ndarray | float, n_terms: int) -> np.ndarray:
        """Return the extended BIC of models with `n_terms` terms and residual sums `rss`.

        Errors below `precision` of the target count as equal.
        """
        # the precision bounds the logarithm of an exact fit
        relative_rss = (
            np.maximum(np.asarray(rss), 0.0) / self.target_energy + self.config.precision**2
        )
        n_candidates = max(self.r.shape[1], n_terms)
        gammaln = scipy.special.gammaln
        log_combinations = (
            gammaln(n_candidates + 1) - gammaln(n_terms + 1) - gammaln(n_candidates - n_terms + 1)
        )
        goodness_of_fit = self.n_independent_samples * np.log(relative_rss)
        size_penalty = n_terms * np.log(self.n_independent_samples)
        return np.asarray(
            goodness_of_fit + size_penalty + 2.0 * self.config.gamma * log_combinations
        )

    def is_exact(self, rss: float) -> bool:
        """Return whether a residual sum of squares is at the level of rounding errors."""
        return rss <= (2.0 * self.config.precision) ** 2 * self.target_energy

    def rss(self, subset: Sequence[int]) -> float:
        """Return the residual sum of squares of a subset of columns."""
        residual = self.project_out(subset)[1]
        return float(residual @ residual)

    def criterion_of(self, subset: Sequence[int]) -> float:
        """Return the extended BIC of a subset of columns."""
        return float(self.criterion(self.rss(subset), len(subset)))

    def project_out(
        self, subset: Sequence[int], other_columns: np.ndarray | None = None
    ) -> tuple[np.ndarray | None, np.ndarray]:
        """Return the components of columns [R, C] and of the target [R] orthogonal to a subset."""
        q = np.linalg.qr(self.r[:, list(subset)])[0]
        target = self.y
        # the second projection removes the rounding errors of the first
        for _ in range(2):
            target = target - q @ (q.T @ target)
            other_columns = (
                None if other_columns is None else other_columns - q @ (q.T @ other_columns)
            )
        return other_columns, target

    def beam_search(self) -> tuple[float, list[int]]:
        """Search forward with a beam; return the best criterion and its subset of columns.

        At each size the search keeps the best extensions of the subsets by one column. Greedy
        forward selection often picks a column that replaces two true ones and cannot recover.
        """
        best_criterion = float(self.criterion(self.target_energy, 0))
        best_subset: list[int] = []
        subsets = np.zeros((1, 0), dtype=int)
        sizes_without_gain = 0
        while subsets.shape[1] < self.max_terms and sizes_without_gain < _MAX_SIZES_WITHOUT_GAIN:
            # the best extensions of all subsets, without duplicates
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
            best_of_size = subsets[0].tolist()
            rss = self.rss(best_of_size)
            criterion_value = float(self.criterion(rss, len(best_of_size)))
            sizes_without_gain = sizes_without_gain + 1
            if criterion_value < best_criterion:
                best_criterion = criterion_value
                best_subset = best_of_size
                sizes_without_gain = 0
            if self.is_exact(rss):
                break
        return best_criterion, best_subset

    def backward_eliminate(self, subset: list[int]) -> list[int]:
        """Remove the least significant columns while the criterion increases by too little.

        With many candidates the criterion alone accepts a column that fits only noise, in about one
        of several dozen targets. From an exact fit, all columns are removed without which the fit
        remains exact.
        """
        subset = list(subset)
        criterion_value = self.criterion_of(subset)
        while subset:
            estimate, inverse = solve_least_squares(self.r[:, subset], self.y)
            # the smallest t statistic: its removal increases the RSS least
            weakest = int((np.square(estimate) / np.square(inverse).sum(axis=1)).argmin())
            reduced_subset = subset[:weakest] + subset[weakest + 1 :]
            reduced_criterion = self.criterion_of(reduced_subset)
            required_evidence = 0.0 if self.is_exact(self.rss(subset)) else _POSITIVE_EVIDENCE
            if reduced_criterion > criterion_value + required_evidence:
                break
            subset = reduced_subset
            criterion_value = reduced_criterion
        return subset


def rss_with_one_added(r: np.ndarray, y: np.ndarray, subsets: np.ndarray) -> np.ndarray:
    """Return the residual sums of squares [M, J] of M subsets, each extended by each column.

    Args:
        r: columns of unit norm [R, J].
        y: target [R].
        subsets: indices of the columns of M subsets [M, p].

    Returns:
        The sums; infinite for a column in the span of the subset.
    """
    columns = np.repeat(r[None], len(subsets), axis=0)
    target = np.repeat(y[None], len(subsets), axis=0)
    if subsets.shape[1]:
        q = np.linalg.qr(r.T[subsets].transpose(0, 2, 1))[0]
        q_transposed = q.transpose(0, 2, 1)
        # for each extension only the component orthogonal to the subset reduces the error
        # (orthogonal forward regression)
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
    """A sparse equation of a target.

    Attributes:
        terms: names of the terms, simplest first.
        values: coefficients.
        standard_errors: standard errors of the coefficients.
        relative_error: RMS error divided by the RMS of the target.
        is_exact: whether the error is at the level of rounding errors.
        criterion: extended BIC.
        alternatives: term -> candidates that could replace it, because the BIC is no strong
            evidence against the replacement.
        undecided: candidate -> upper bound (two standard errors) of its share of the target, for
            candidates outside the equation whose bound exceeds 5 %.
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
        """Return the diagnostics of the equation for fit.json.

        Args:
            problem: candidates of the search that selected the equation.
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
"""Equation without terms."""


def find_equation(
    reduced: ReducedProblem, output_index: int, config: SparseSearchConfig
) -> tuple[SparseEquation, ReducedProblem]:
    """Search the equation of one target; return it with the candidates of the search.

    On noisy data, candidates that differ by less than the noise are merged first. The equation of
    all candidates is returned only if the criterion strongly prefers it.
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
    """Search among the candidates up to each degree in turn and return the best equation.

    The search ends at the first degree with an exact equation. Otherwise the criterion, which
    accounts for the number of candidates, decides between the degrees.
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
    """Build the search among the `n_candidates` simplest candidates."""
    n_independent_samples = float(reduced.n_independent_samples[output_index])
    return ForwardSearch(
        reduced.r[:, :n_candidates], reduced.y[:, output_index], n_independent_samples, config
    )


def fit_all_candidates(reduced: ReducedProblem, output_index: int) -> SparseEquation:
    """Fit the equation of all linearly independent candidates by least squares."""
    search = _make_search(reduced, output_index, SparseSearchConfig(), reduced.rank)
    return build_equation(reduced, search, list(range(reduced.rank)))


def build_equation(
    reduced: ReducedProblem, search: ForwardSearch, subset: list[int]
) -> SparseEquation:
    """Fit the equation of a subset of columns and compute its diagnostics."""
    subset = sorted(subset)
    rss = search.rss(subset)
    is_exact = search.is_exact(rss)
    coefficient_values, r_inverse = solve_least_squares(search.r[:, subset], search.y)
    residual_std = np.sqrt(rss / max(search.n_independent_samples - len(subset), 1.0))
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
    """Return `SparseEquation.alternatives` of the equation of a subset of columns."""
    if not subset:
        return {}
    # replace each term by every other candidate, and keep those with a similar criterion
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
        # the table has cancellation errors if a fit is exact, so compute the criterion again
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
    """Return candidates outside a subset that could contribute more than 5 % of the target.

    The value is the upper bound of the share, two standard errors above the estimate.
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
    """Sparse regression without intercept; the extended BIC selects the terms.

    The notes of a solution have the diagnostics of each output under `equations`.

    Args:
        search: settings of the search.
        degrees: degree of each candidate, [J], by which the search proceeds; one degree if empty.
        complexities: sort key of the candidates within a degree, [J]; their order if empty.
        allowed_terms: which candidates each output may have, [J, n] bool; None for all.
        gammas: weights of the extended BIC with which `fit` returns alternatives, followed by the
            solution without terms; no alternatives if empty.
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

        The groups of the samples are not used.
        """
        names = data.names
        outputs = data.outputs
        problems = self._reduce_outputs(to_dense(data.x).numpy(), data.y.numpy(), names)
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
        """Reduce the regression of each output; outputs of equal candidates share a problem."""
        degrees = self.degrees or (1,) * len(names)
        all_allowed = torch.ones(len(names), y.shape[1], dtype=torch.bool)
        cache: dict[tuple[int, ...], ReducedProblem] = {}
        problems = []
        for mask in (all_allowed if self.allowed_terms is None else self.allowed_terms).T:
            columns = tuple(mask.nonzero()[:, 0].tolist())
            if columns not in cache:
                complexities = [self.complexities[j] for j in columns] if self.complexities else ()
                cache[columns] = reduce_problem(
                    x[:, columns],
                    y,
                    [names[j] for j in columns],
                    [degrees[j] for j in columns],
                    complexities,
                )
            problems.append(cache[columns])
        return problems

    def _build_solution(
        self,
        problems: Sequence[ReducedProblem],
        config: SparseSearchConfig,
        names: Sequence[str],
        outputs: Sequence[str],
    ) -> Solution:
        """Select the terms of each output and return the equations as one solution."""
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
    """Return a coefficient as a dictionary for the notes of a fit."""
    return {
        "axis": coefficient.axis,
        "term": coefficient.term,
        "value": coefficient.value,
        "standard_error": coefficient.standard_error,
    }

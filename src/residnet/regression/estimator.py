"""Interface of the estimators, which compute coefficients from arrays as scikit-learn does.

The regressors of long logs are evaluated in chunks of rows, so that they need not fit in memory.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, final

import torch
from torch import Tensor

from residnet.core.arrays import paged
from residnet.core.arrays.paged import iterate_row_chunks, release_pages
from residnet.core.errors import FitError
from residnet.regression.folds import count_default_folds, require_folds


class Ratio(NamedTuple):
    """A parameter that is a ratio of two coefficients of one output.

    Attributes:
        sign: factor of the ratio, 1 or -1.
        numerator: term whose coefficient is the numerator; None for a numerator of 1.
        denominator: term whose coefficient is the denominator.
    """

    sign: float
    numerator: str | None
    denominator: str

    def evaluate(self, coefficients: Mapping[str, float]) -> float:
        """Compute the parameter from the coefficients of its output, given by term."""
        numerator_value = 1.0 if self.numerator is None else coefficients[self.numerator]
        return self.sign * numerator_value / coefficients[self.denominator]


@dataclass(frozen=True)
class Coefficient:
    """An identified coefficient or parameter with its standard error.

    Attributes:
        axis: name of the output, such as u_dot.
        term: regressor of that output, or the name of a parameter computed from coefficients.
        value: estimate.
        standard_error: standard error of the estimate.
        ratio: formula of a parameter computed from coefficients; None for a coefficient.
    """

    axis: str
    term: str
    value: float
    standard_error: float
    ratio: Ratio | None = None


@dataclass(frozen=True)
class Solution:
    """A solution of a fit; an estimator with several candidate complexities returns several.

    Attributes:
        hyperparameters: settings of this solution, for example {"ridge": 1e-4}; empty if the
            estimator has a single solution.
        state: arrays by name. A linear solution y = x coefficients + intercept has `coefficients`
            [J, n] and optionally `intercept` [n]. The solution of a module has the names of its
            state_dict.
        table: coefficients with names and standard errors; empty if they are not estimated.
        notes: further results of the fit, serialisable as JSON.
        neighbours: computes the solutions with neighbouring hyperparameters, which are tried if
            free runs prefer this solution; None if the estimator offers no neighbours.
        covariance: covariance of the coefficients of each output [n, J, J]; None if unknown.
    """

    hyperparameters: dict[str, Any]
    state: dict[str, Tensor]
    table: tuple[Coefficient, ...] = ()
    notes: dict[str, Any] = field(default_factory=dict)
    neighbours: Callable[[], Sequence[Solution]] | None = None
    covariance: Tensor | None = None

    @property
    def coefficients(self) -> Tensor:
        """Return the coefficients [J, n] of a linear solution."""
        return self.state["coefficients"]

    @property
    def intercept(self) -> Tensor:
        """Return the intercept [n] of a linear solution; zeros for a solution without intercept."""
        zero = self.coefficients.new_zeros(self.coefficients.shape[1])
        return self.state.get("intercept", zero)

    @property
    def standard_errors(self) -> Tensor:
        """Return the standard errors of the coefficients [J, n].

        Raises:
            ValueError: if the estimator computed no covariance.
        """
        if self.covariance is None:
            raise ValueError("this solution has no standard errors")
        # rounding may leave a variance that is zero slightly negative
        return self.covariance.diagonal(dim1=1, dim2=2).clamp(min=0).sqrt().T

    def predict(self, x: Tensor) -> Tensor:
        """Return the outputs [N, n] of a linear solution at inputs [N, J]."""
        return x @ self.coefficients + self.intercept


@final
class ChunkedRegressors:
    """A matrix of regressors [N, J] whose rows are evaluated chunk by chunk on iteration.

    Args:
        evaluate: function from channels [M, nz] to all regressors [M, J'].
        channels: channels [N, nz].
        columns: indices of the J columns of this matrix among the J' regressors.
    """

    def __init__(
        self, evaluate: Callable[[Tensor], Tensor], channels: Tensor, columns: Sequence[int]
    ) -> None:
        self.evaluate = evaluate
        self.channels = channels
        self.columns = list(columns)
        self.shape = (channels.shape[0], len(self.columns))

    def __len__(self) -> int:
        return self.shape[0]

    def select_columns(self, columns: Sequence[int]) -> ChunkedRegressors:
        """Return a matrix of some columns, given by their indices in this matrix."""
        return ChunkedRegressors(self.evaluate, self.channels, [self.columns[j] for j in columns])

    def __iter__(self) -> Iterator[tuple[slice, Tensor]]:
        """Yield slices of rows and the regressors of these rows."""
        for rows in iterate_row_chunks(len(self)):
            yield rows, self.evaluate(self.channels[rows])[:, self.columns]
            release_pages()


Regressors = Tensor | ChunkedRegressors


def evaluate_regressors(
    evaluate: Callable[[Tensor], Tensor], channels: Tensor, columns: Sequence[int]
) -> Regressors:
    """Evaluate regressors at channels [N, nz]: as a tensor, or in chunks if N is large."""
    if len(channels) > paged.MAX_SAMPLES_IN_MEMORY:
        return ChunkedRegressors(evaluate, channels, columns)
    values = evaluate(channels)
    # selection by a list copies the matrix, which is avoided if all columns are used
    return values if list(columns) == list(range(values.shape[1])) else values[:, list(columns)]


def iterate_chunks(x: Regressors) -> Iterator[tuple[slice, Tensor]]:
    """Yield slices of rows and the regressors of these rows."""
    if isinstance(x, ChunkedRegressors):
        yield from x
    else:
        for rows in iterate_row_chunks(len(x)):
            yield rows, x[rows]


def select_columns(x: Regressors, columns: Sequence[int]) -> Regressors:
    """Return the columns of these indices."""
    return x.select_columns(columns) if isinstance(x, ChunkedRegressors) else x[:, list(columns)]


def to_dense(x: Regressors) -> Tensor:
    """Return all regressors [N, J] as one tensor, for methods that cannot work in chunks."""
    return torch.cat([chunk for _, chunk in x]) if isinstance(x, ChunkedRegressors) else x


class EstimatorData(NamedTuple):
    """Training data of an estimator: finite arrays with named columns.

    Attributes:
        x: inputs [N, J], float64; evaluated in chunks if N is large.
        y: outputs [N, n], float64.
        groups: group number of each sample [N]; None if the samples have no groups.
        names: names of the columns of x.
        outputs: names of the columns of y.
    """

    x: Regressors
    y: Tensor
    groups: Tensor | None
    names: tuple[str, ...]
    outputs: tuple[str, ...]


class Estimator(ABC):
    """Estimator of y from x: the constructor stores the settings, `fit` takes the data."""

    @final
    def fit(
        self,
        x: Regressors,
        y: Tensor,
        groups: Tensor | None = None,
        *,
        names: Sequence[str] = (),
        outputs: Sequence[str] = (),
    ) -> list[Solution]:
        """Fit the data and return the solutions, the preferred one first.

        If the settings request alternatives, solutions of other complexities follow. The caller
        selects among them by a criterion of its own, such as the error of free runs.

        Args:
            x: inputs [N, J], float64; evaluated in chunks if N is large.
            y: outputs [N, n], float64.
            groups: group number of each sample [N]. Cross-validation never splits the samples of a
                group, such as a manoeuvre. None if the samples have no groups.
            names: names of the columns of x; `x0`, `x1` and so on if empty.
            outputs: names of the columns of y; `y0`, `y1` and so on if empty.

        Raises:
            FitError: if the data are not finite or do not determine the coefficients.
        """
        input_names = default_column_names(x, names, "x")
        output_names = default_column_names(y, outputs, "y")
        validate_data(x, y, input_names, output_names)
        return self._solve(EstimatorData(x, y, groups, input_names, output_names))

    @abstractmethod
    def _solve(self, data: EstimatorData) -> list[Solution]:
        """Return the solutions for validated data, the preferred one first."""


def default_column_names(values: Regressors, names: Sequence[str], prefix: str) -> tuple[str, ...]:
    """Return the names of columns; the prefix and the column number if `names` is empty."""
    return tuple(names) or tuple(f"{prefix}{j}" for j in range(values.shape[1]))


def require_finite(
    values: Tensor, names: Sequence[str], subject: str, first_sample: int = 0
) -> None:
    """Check that all values [N, J] are finite.

    Args:
        values: values [N, J].
        names: names of the columns.
        subject: noun for a column in the error message.
        first_sample: number of the first sample of `values` in the whole record.

    Raises:
        FitError: if a value is not finite; the message names its column and sample.
    """
    is_invalid = ~torch.isfinite(values)
    if bool(is_invalid.any()):
        row, column = (int(index[0]) for index in is_invalid.nonzero(as_tuple=True))
        raise FitError(
            f"{subject} '{names[column]}' is not finite at sample {first_sample + row};"
            " mask or repair the log"
        )


def validate_data(x: Regressors, y: Tensor, names: Sequence[str], outputs: Sequence[str]) -> None:
    """Check that inputs [N, J] and outputs [N, n] are finite, not empty and of equal length.

    Raises:
        FitError: if a check fails.
    """
    if len(x) != len(y):
        raise FitError(
            f"{len(x)} samples of the inputs, but {len(y)} of the outputs; give equal numbers"
        )
    if len(x) == 0 or x.shape[1] == 0:
        raise FitError(
            f"a regression needs samples and regressors, but the data have {len(x)} samples of"
            f" {x.shape[1]} regressors"
        )
    names = default_column_names(x, names, "x")
    outputs = default_column_names(y, outputs, "y")
    for rows, chunk in iterate_chunks(x):
        require_finite(chunk, names, "basis function", rows.start)
    for rows in iterate_row_chunks(len(y)):
        require_finite(y[rows], outputs, "output", rows.start)


def require_overdetermined(x: Regressors, subject: str) -> None:
    """Check that there are more samples than columns.

    Args:
        x: inputs [N, J].
        subject: plural noun for the columns in the error message.

    Raises:
        FitError: if there are not.
    """
    if len(x) <= x.shape[1]:
        raise FitError(
            f"{len(x)} samples do not determine {x.shape[1]} {subject};"
            " give more data or fewer terms"
        )


def default_fold_count(groups: Tensor) -> int | None:
    """Return the default number of folds for samples with these group numbers [N]."""
    return count_default_folds(torch.unique(groups).numel())


def assign_group_folds(groups: Tensor | None, n_folds: int | None) -> Tensor:
    """Return the fold of each sample [N]; the groups are assigned to the folds in turn.

    Args:
        groups: group number of each sample [N].
        n_folds: number of folds; None for a fold per group.

    Raises:
        FitError: if there are fewer groups than folds, or fewer than two.
    """
    unique_groups = torch.zeros(0) if groups is None else torch.unique(groups)
    require_folds(unique_groups.numel(), n_folds)
    assert groups is not None
    return torch.searchsorted(unique_groups, groups) % (n_folds or unique_groups.numel())

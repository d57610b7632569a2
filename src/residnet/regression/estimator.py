"""The interface of estimators, from arrays to coefficients, in the habit of scikit-learn.

Regressors of many samples come in pieces, computed where they are needed instead of all at once.
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


class Ratio(NamedTuple):
    """A parameter that is a ratio of two coefficients of one output.

    Attributes:
        sign: factor of the ratio, 1 or -1.
        numerator: term of the coefficient above; None stands for 1.
        denominator: term of the coefficient below.
    """

    sign: float
    numerator: str | None
    denominator: str

    def evaluate(self, coefficients: Mapping[str, float]) -> float:
        """Return the parameter, from the coefficients of its output by term."""
        numerator_value = 1.0 if self.numerator is None else coefficients[self.numerator]
        return self.sign * numerator_value / coefficients[self.denominator]


@dataclass(frozen=True)
class Coefficient:
    """One identified number with its standard error.

    Attributes:
        axis: name of the output, such as u_dot.
        term: regressor of that output, or the name of a parameter that follows from coefficients.
        value: value of the coefficient of `term`, or of the parameter.
        standard_error: its standard error.
        ratio: how a parameter follows from coefficients; None for a coefficient.
    """

    axis: str
    term: str
    value: float
    standard_error: float
    ratio: Ratio | None = None


@dataclass(frozen=True)
class Solution:
    """One solution of a fit; a fit with a complexity to choose has several.

    Attributes:
        hyperparameters: what sets it apart, for example {"ridge": 1e-4}; empty where there is nothing to
            choose.
        state: arrays by name. A linear solution y = x coefficients + intercept has `coefficients`
            [J, n] and, where it has one, `intercept` [n]; other kinds say what they have. Fitted to
            a module they are names of its state_dict.
        table: the coefficients with names and standard errors, where the fit knows them.
        notes: what else there is to say about the fit, in terms of JSON.
        neighbours: makes the solutions next to this one, to be tried where free runs find this one
            best; None where there are none.
        covariance: covariance of the coefficients of each output [n, J, J], where the fit knows it.
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
        """Return the intercept [n] of a linear solution, zeros where it has none."""
        zero = self.coefficients.new_zeros(self.coefficients.shape[1])
        return self.state.get("intercept", zero)

    @property
    def standard_errors(self) -> Tensor:
        """Return the standard errors of the coefficients [J, n].

        Raises:
            ValueError: where the fit knows none.
        """
        if self.covariance is None:
            raise ValueError("this solution has no standard errors")
        return self.covariance.diagonal(dim1=1, dim2=2).clamp(min=0).sqrt().T

    def predict(self, x: Tensor) -> Tensor:
        """Return the outputs [N, n] of a linear solution at inputs [N, J]."""
        return x @ self.coefficients + self.intercept


@final
class ChunkedRegressors:
    """A matrix of regressors [N, J] whose rows are computed where they are needed.

    Args:
        evaluate: gives regressors [M, J] at channels [M, nz].
        channels: channels [N, nz].
        columns: which of the regressors are meant, J of them.
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
        """Return some of the regressors, by their place among these."""
        return ChunkedRegressors(self.evaluate, self.channels, [self.columns[j] for j in columns])

    def __iter__(self) -> Iterator[tuple[slice, Tensor]]:
        """Yield rows and the regressors there."""
        for rows in iterate_row_chunks(len(self)):
            yield rows, self.evaluate(self.channels[rows])[:, self.columns]
            release_pages()


Regressors = Tensor | ChunkedRegressors


def evaluate_regressors(
    evaluate: Callable[[Tensor], Tensor], channels: Tensor, columns: Sequence[int]
) -> Regressors:
    """Return regressors at channels [N, nz]: a tensor, or pieces where there are many samples."""
    if len(channels) > paged.MAX_SAMPLES_IN_MEMORY:
        return ChunkedRegressors(evaluate, channels, columns)
    values = evaluate(channels)
    return values if list(columns) == list(range(values.shape[1])) else values[:, list(columns)]


def iterate_chunks(x: Regressors) -> Iterator[tuple[slice, Tensor]]:
    """Yield rows and the regressors there."""
    if isinstance(x, ChunkedRegressors):
        yield from x
    else:
        for rows in iterate_row_chunks(len(x)):
            yield rows, x[rows]


def select_columns(x: Regressors, columns: Sequence[int]) -> Regressors:
    """Return some columns of regressors."""
    return x.select_columns(columns) if isinstance(x, ChunkedRegressors) else x[:, list(columns)]


def to_dense(x: Regressors) -> Tensor:
    """Return all regressors [N, J] in memory, for methods that need them at once."""
    return torch.cat([chunk for _, chunk in x]) if isinstance(x, ChunkedRegressors) else x


class EstimatorData(NamedTuple):
    """What an estimator learns from; finite, with names for every column.

    Attributes:
        x: inputs [N, J], float64; pieces of them where there are many samples.
        y: outputs [N, n], float64.
        groups: number of the group of each sample [N]; None where nothing is known of groups.
        names: of the columns of x.
        outputs: names of the columns of y.
    """

    x: Regressors
    y: Tensor
    groups: Tensor | None
    names: tuple[str, ...]
    outputs: tuple[str, ...]


class Estimator(ABC):
    """An estimator of y from x: the constructor only stores settings, `fit` takes the data."""

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
        """Return the solutions, first the one that the estimator itself prefers.

        Where the settings ask for alternatives, the solutions of other complexities follow, for a
        criterion that the estimator does not know, such as the error of free runs.

        Args:
            x: inputs [N, J], float64; pieces of them where there are many samples.
            y: outputs [N, n], float64.
            groups: number of the group of each sample [N]. Samples of one group, such as a
                manoeuvre, belong together: cross-validation never splits them. None where nothing
                is known of groups.
            names: names of the columns of x; `x0`, `x1` and so on where empty.
            outputs: names of the columns of y; `y0`, `y1` and so on where empty.

        Raises:
            FitError: where the data are not finite, or do not determine the coefficients.
        """
        column_labels = default_column_names(x, names, "x"), default_column_names(y, outputs, "y")
        validate_data(x, y, *column_labels)
        return self._solve(EstimatorData(x, y, groups, *column_labels))

    @abstractmethod
    def _solve(self, data: EstimatorData) -> list[Solution]:
        """Return the solutions of checked data, as `fit` does."""


def default_column_names(values: Regressors, names: Sequence[str], prefix: str) -> tuple[str, ...]:
    """Return the names of columns, numbered ones where none are given."""
    return tuple(names) or tuple(f"{prefix}{j}" for j in range(values.shape[1]))


def require_finite(
    values: Tensor, names: Sequence[str], subject: str, first_sample: int = 0
) -> None:
    """Check that all values [N, J] are finite; `first_sample` is the number of the first sample.

    Raises:
        FitError: naming the column and the first sample that is not.
    """
    is_invalid = ~torch.isfinite(values)
    if bool(is_invalid.any()):
        row, column = (int(index[0]) for index in is_invalid.nonzero(as_tuple=True))
        raise FitError(
            f"{subject} '{names[column]}' is not finite at sample {first_sample + row}; mask or repair the"
            " log"
        )


def validate_data(x: Regressors, y: Tensor, names: Sequence[str], outputs: Sequence[str]) -> None:
    """Check that inputs [N, J] and outputs [N, n] are finite and that there are any.

    Raises:
        FitError: where they are not, or where their numbers of samples differ.
    """
    if len(x) != len(y):
        raise FitError(f"{len(x)} samples of the inputs, but {len(y)} of the outputs; give pairs")
    if len(x) == 0 or x.shape[1] == 0:
        raise FitError(
            f"a regression needs samples and regressors, given {len(x)} samples of"
            f" {x.shape[1]} regressors"
        )
    names, outputs = default_column_names(x, names, "x"), default_column_names(y, outputs, "y")
    for rows, chunk in iterate_chunks(x):
        require_finite(chunk, names, "basis function", rows.start)
    for rows in iterate_row_chunks(len(y)):
        require_finite(y[rows], outputs, "output", rows.start)


def require_overdetermined(x: Regressors, subject: str) -> None:
    """Check that there are more samples than columns, which are `subject`.

    Raises:
        FitError: where there are not.
    """
    if len(x) <= x.shape[1]:
        raise FitError(
            f"{len(x)} samples do not determine {x.shape[1]} {subject}; give more data or fewer terms"
        )


DEFAULT_FOLDS = 5
"""Folds of a cross-validation where nobody asks for another number."""


def default_fold_count(groups: Tensor) -> int | None:
    """Return five, or the number of groups [N] where there are fewer; None for a single group."""
    n_groups = torch.unique(groups).numel()
    return min(DEFAULT_FOLDS, n_groups) if n_groups > 1 else None


def assign_group_folds(groups: Tensor | None, n_folds: int | None) -> Tensor:
    """Return the fold of each sample [N], groups dealt out in turn; every group is a fold for None.

    Raises:
        FitError: with fewer groups than folds, or fewer than two.
    """
    unique_groups = torch.unique(groups) if groups is not None else torch.zeros(0)
    if groups is None or (n_folds is None and unique_groups.numel() < 2):
        raise FitError(
            "one run or segment only: nothing is left to cross-validate on; give more runs, or a"
            " fixed order or penalty"
        )
    if n_folds is not None and unique_groups.numel() < n_folds:
        raise FitError(
            f"{n_folds} folds need as many manoeuvres, the training data have {unique_groups.numel()};"
            " lower `n_folds`"
        )
    return torch.searchsorted(unique_groups, groups) % (n_folds or unique_groups.numel())

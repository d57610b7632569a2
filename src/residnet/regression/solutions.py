"""What an estimator hands back: its numbers, what they mean, and what sets solutions apart."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

from torch import Tensor


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

    def of(self, coefficients: Mapping[str, float]) -> float:
        """Return the parameter, from the coefficients of its output by term."""
        above = 1.0 if self.numerator is None else coefficients[self.numerator]
        return self.sign * above / coefficients[self.denominator]


@dataclass(frozen=True)
class Coefficient:
    """One identified number with its standard error.

    Attributes:
        axis: name of the output, such as u_dot.
        term: regressor of that output, or the name of a parameter that follows from coefficients.
        value: value of the coefficient of `term`, or of the parameter.
        error: its standard error.
        ratio: how a parameter follows from coefficients; None for a coefficient.
    """

    axis: str
    term: str
    value: float
    error: float
    ratio: Ratio | None = None


@dataclass(frozen=True)
class Solution:
    """One solution of a fit; a fit with a complexity to choose has several.

    Attributes:
        choice: what sets it apart, for example {"ridge": 1e-4}; empty where there is nothing to
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

    choice: dict[str, Any]
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
    def errors(self) -> Tensor:
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

    def prefixed(self, prefix: str) -> Solution:
        """Return the solution for a module that holds the fitted one under the name `prefix`."""
        make = self.neighbours
        return replace(
            self,
            state={f"{prefix}.{name}": value for name, value in self.state.items()},
            neighbours=None if make is None else lambda: [near.prefixed(prefix) for near in make()],
        )

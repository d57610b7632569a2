"""What a closed-form fit hands back: its numbers, what they mean, and what sets them apart from
other solutions of the same fit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from torch import Tensor


class Ratio(NamedTuple):
    """A parameter that is a ratio of two coefficients of one axis: sign * numerator / denominator;
    no numerator stands for 1.
    """

    sign: float
    numerator: str | None
    denominator: str

    def of(self, coefficients: Mapping[str, float]) -> float:
        """The parameter, from the coefficients of its axis by term."""
        above = 1.0 if self.numerator is None else coefficients[self.numerator]
        return self.sign * above / coefficients[self.denominator]


@dataclass(frozen=True)
class Coefficient:
    """One identified number with its standard error.

    Attributes:
        axis: u_dot, v_dot or r_dot.
        term: regressor of that axis, or the name of a parameter that follows from coefficients.
        value: of the coefficient of `term`, or of the parameter.
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
    """One solution of a closed-form fit; a fit with a complexity to choose has several.

    Attributes:
        choice: what sets it apart, for example {"ridge": 1e-4}; empty where there is nothing to
            choose.
        state: numbers of the module that was fitted, by name, as in its state_dict.
        table: the same with names and standard errors, where the fit knows them.
        notes: what else there is to say about the fit.
        neighbours: solutions near this one, made when free runs find it best, to be tried next;
            None where there are none.
    """

    choice: dict[str, Any]
    state: dict[str, Tensor]
    table: tuple[Coefficient, ...] = ()
    notes: dict[str, Any] = field(default_factory=dict)
    neighbours: Callable[[], Sequence[Solution]] | None = None

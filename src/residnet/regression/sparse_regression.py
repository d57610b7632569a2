"""Sparse regression of several outputs: a few terms of each, out of many candidates."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

import numpy as np
import torch
from torch import Tensor

from residnet.regression.estimator import Estimator, column_names, require_pairs
from residnet.regression.pieces import Regressors, whole
from residnet.regression.solutions import Coefficient, Solution
from residnet.regression.sparse import NOTHING, Equation, SearchConfig, find
from residnet.regression.sparse_reduction import Reduced, reduce


@final
class SparseRegression(Estimator):
    """Sparse regression without intercept, its length by the extended BIC.

    The notes of a solution have, under `equations`, what the data say about each output.

    Args:
        search: how far the search goes.
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

    def fit(
        self,
        x: Regressors,
        y: Tensor,
        groups: Tensor | None = None,
        *,
        names: Sequence[str] = (),
        outputs: Sequence[str] = (),
    ) -> list[Solution]:
        """Return the solution of the extended BIC, then the alternatives that differ from it.

        Groups do not matter. See `Estimator.fit`.

        Raises:
            FitError: where the samples do not tell the candidates apart.
        """
        x = whole(x)
        names, outputs = column_names(x, names, "x"), column_names(y, outputs, "y")
        require_pairs(x, y)
        reduced = self._reduced(x.numpy(), y.numpy(), names)
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
        if self.allowed is None:
            return [reduce(x, y, names, degrees, self.efforts)] * y.shape[1]
        out = []
        for output in range(y.shape[1]):
            columns = self.allowed[:, output].nonzero()[:, 0].tolist()
            efforts = [self.efforts[j] for j in columns] if self.efforts else ()
            chosen = [names[j] for j in columns], [degrees[j] for j in columns], efforts
            out.append(reduce(x[:, columns], y, *chosen))
        return out

    def _solution(
        self,
        reduced: Sequence[Reduced],
        search: SearchConfig,
        names: Sequence[str],
        outputs: Sequence[str],
    ) -> Solution:
        """Return the solution of one search."""
        found = [find(part, output, search) for output, part in enumerate(reduced)]
        coefficients = torch.zeros(len(names), len(outputs), dtype=torch.float64)
        table: list[Coefficient] = []
        for k, (output, (equation, _)) in enumerate(zip(outputs, found, strict=True)):
            for entry in equation_table(output, equation):
                coefficients[names.index(entry.term), k] = entry.value
                table.append(entry)
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


def equation_table(output: str, equation: Equation) -> list[Coefficient]:
    """Return the coefficients of an equation with their standard errors."""
    numbers = zip(equation.terms, equation.values.tolist(), equation.errors.tolist(), strict=True)
    return [Coefficient(output, term, value, error) for term, value, error in numbers]


def coefficient_row(entry: Coefficient) -> dict[str, Any]:
    """Return a coefficient as it stands in the notes of a fit."""
    return {
        "axis": entry.axis,
        "term": entry.term,
        "value": entry.value,
        "standard_error": entry.error,
    }

"""Equations of several outputs, bred by genetic programming."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, NamedTuple, final

import numpy as np
import torch
from torch import Tensor

from residnet.regression.estimator import Estimator, column_names, require_data
from residnet.regression.expressions.algebra import Algebra, Product
from residnet.regression.expressions.library import tables
from residnet.regression.expressions.notation import LATEX, PLAIN, SYMPY, latex_left
from residnet.regression.expressions.text import c_function, term, total
from residnet.regression.genetic.config import BLOCKS, EquationSearchConfig, limits_of
from residnet.regression.genetic.evolution import Found, evolve
from residnet.regression.pieces import Regressors, whole
from residnet.regression.solutions import Coefficient, Solution
from residnet.regression.sparse import Equation, find
from residnet.regression.sparse_reduction import Reduced, reduce
from residnet.regression.sparse_regression import coefficient_row
from residnet.regression.sparse_search import coefficients

_TINY = 1e-300
"""Least energy of a target that an error is divided by."""
_EXACT = 1e-13
"""Unexplained share of the target below which a fit is as good as arithmetic allows."""


@final
class GeneticEquations(Estimator):
    """An equation of the inputs for each output, without intercept, by genetic programming.

    A solution's state is that of an `ExpressionLibrary` under the name `library`, and the
    coefficients of its terms [P, n], `weights.values`.

    Args:
        config: how to search.
    """

    def __init__(self, config: EquationSearchConfig) -> None:
        self.config = config

    def fit(
        self,
        x: Regressors,
        y: Tensor,
        groups: Tensor | None = None,
        *,
        names: Sequence[str] = (),
        outputs: Sequence[str] = (),
    ) -> list[Solution]:
        """Return the solution with the best individuals' equations; see `Estimator.fit`.

        Raises:
            FitError: where the data do not determine an equation.
            UsageError: where DEAP is not installed.
        """
        x = whole(x)
        names, outputs = column_names(x, names, "x"), column_names(y, outputs, "y")
        require_data(x, y, names, outputs)
        config, n = self.config, y.shape[1]
        algebra = Algebra(names, limits_of(config.evolution))
        values, target = x.numpy(), y.numpy()
        data = {name: values[:, j] for j, name in enumerate(names)}
        groups = torch.zeros(len(x)) if groups is None else groups
        train = ~validating(groups.numpy(), config.validate_every)
        bred = [
            breed(algebra, data, target[:, k], train, config, n * config.seed + k) for k in range(n)
        ]
        products = sorted({product for found in bred for product in found.products})
        weights = torch.zeros(len(products), n, dtype=torch.float64)
        table: list[Coefficient] = []
        for k, (output, found) in enumerate(zip(outputs, bred, strict=True)):
            for product, value, error in zip(
                found.products, found.values, found.errors, strict=True
            ):
                weights[products.index(product), k] = value
                table.append(Coefficient(output, term(algebra, product), value, error))
        notes = {
            "parameters": len(table),
            "coefficients": [coefficient_row(entry) for entry in table],
            "unexcited": [],
            "equations": {
                output: _written(algebra, output, found)
                for output, found in zip(outputs, bred, strict=True)
            },
        }
        library = tables(algebra, products, config.evolution.nesting)
        state = {f"library.{name}": value for name, value in library.items()}
        return [
            Solution(
                {"kept": [len(found.products) for found in bred]},
                state | {"weights.values": weights},
                tuple(table),
                notes,
            )
        ]


class Bred(NamedTuple):
    """The equation of one output.

    Attributes:
        found: what the search found.
        products: terms of the equation.
        values: coefficients of the terms.
        errors: standard errors of the coefficients.
        summary: what the data say about the equation.
    """

    found: Found
    products: tuple[Product, ...]
    values: tuple[float, ...]
    errors: tuple[float, ...]
    summary: dict[str, Any]


def breed(
    algebra: Algebra,
    data: Mapping[str, np.ndarray],
    target: np.ndarray,
    train: np.ndarray,
    config: EquationSearchConfig,
    seed: int,
) -> Bred:
    """Search an equation and fit it to all samples.

    Args:
        algebra: of the channels, within the limits of the search.
        data: channels [N] by name.
        target: [N].
        train: which samples train the search; the others validate.
        config: how to search.
        seed: of the random choices.

    Raises:
        FitError: where the data do not determine an equation.
        UsageError: where DEAP is not installed.
    """
    found = evolve(algebra, data, target, train, config.evolution, seed)
    values = algebra.values(found.terms, data).T
    names = [term(algebra, product) for product in found.terms]
    reduced = reduce(
        values,
        target[:, None],
        names,
        [algebra.degree(p) for p in found.terms],
        [algebra.effort(p) for p in found.terms],
    )
    equation, within = (
        (_whole(reduced), reduced) if config.final is None else find(reduced, 0, config.final)
    )
    products = tuple(found.terms[names.index(name)] for name in equation.terms)
    return Bred(
        found,
        products,
        tuple(equation.values.tolist()),
        tuple(equation.errors.tolist()),
        equation.summary(within),
    )


def _whole(reduced: Reduced) -> Equation:
    """Return all terms that the data tell apart, by least squares."""
    y = reduced.y[:, 0]
    best, inverse = coefficients(reduced.r, y)
    left = y - reduced.r @ best
    std = np.sqrt(left @ left / max(float(reduced.samples[0]) - len(best), 1.0))
    share = float(np.sqrt(left @ left / max(y @ y, _TINY)))
    errors = std * np.sqrt(np.square(inverse).sum(axis=1))
    return Equation(
        reduced.names,
        best / reduced.scale,
        errors / reduced.scale,
        share,
        share <= _EXACT,
        0.0,
        0,
        {},
        {},
    )


def validating(group: np.ndarray, every: int) -> np.ndarray:
    """Return which samples [N] validate, from the numbers of their groups.

    Every n-th group does where there are enough, else blocks of the record.
    """
    numbers = np.unique(group, return_inverse=True)[1]
    if numbers.max(initial=0) + 1 < every:
        numbers = np.arange(len(group)) * BLOCKS // max(len(group), 1)
    return np.asarray(numbers % every == every - 1)


def _written(algebra: Algebra, name: str, bred: Bred) -> dict[str, Any]:
    """Return one equation in writing, with the course of its search."""
    return {
        "text": f"{name} = {total(algebra, bred.products, bred.values, PLAIN)}",
        "latex": f"{latex_left(name)} = {total(algebra, bred.products, bred.values, LATEX)}",
        "sympy": total(algebra, bred.products, bred.values, SYMPY),
        "c": c_function(algebra, name, bred.products, bred.values),
        **bred.summary,
        "bred_terms": len(bred.found.terms),
        "generation": bred.found.generation,
        "reached_goal": bred.found.reached,
        "sets_fitted": bred.found.fitted,
        "history": [asdict(generation) for generation in bred.found.history],
    }

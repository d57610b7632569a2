"""The genetic head: the residual, or the whole acceleration, as an equation bred by genetic
programming (document 000).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, Literal, NamedTuple, final

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from residnet.core.names import ACCELERATION
from residnet.core.samples import Samples
from residnet.heads.base import EquationHead, FeatureConfig, Features
from residnet.regression.expressions.algebra import Algebra, Product
from residnet.regression.expressions.library import ExpressionLibrary, Weights, tables
from residnet.regression.expressions.notation import LATEX, PLAIN, SYMPY, latex_left
from residnet.regression.expressions.text import c_function, term, total
from residnet.regression.genetic.evolution import EvolutionConfig, Found, evolve, limits_of
from residnet.regression.solutions import Coefficient, Solution
from residnet.regression.sparse import Equation, Reduced, SearchConfig, find, reduce
from residnet.regression.sparse_search import coefficients

_BLOCKS = 8


class GeneticConfig(FeatureConfig):
    """An equation for each axis, in SI units, by genetic programming; fitting needs the extra `gp`,
    using a fitted model does not.

    Attributes:
        evolution: how equations are bred.
        final: how the terms of the individual that wins are chosen from once more, by the extended
            BIC on all samples; terms that genetic programming carries along without need go. None
            keeps all.
        validate_every: every so manieth manoeuvre validates during the search; with fewer
            manoeuvres every so manieth eighth of the samples.
        seed: of the random choices; each axis has its own.
    """

    kind: Literal["genetic"] = "genetic"
    evolution: EvolutionConfig = Field(default_factory=EvolutionConfig)
    final: SearchConfig | None = Field(default_factory=SearchConfig)
    validate_every: int = Field(default=4, ge=2, le=_BLOCKS)
    seed: int = Field(default=0, ge=0)

    def build(self, names: Sequence[str]) -> GeneticHead:
        """The module for channels `names`."""
        return GeneticHead(self, names)


class Bred(NamedTuple):
    """The equation of one axis: what the search found; products with coefficients and standard
    errors; and what the data say about them.
    """

    found: Found
    products: tuple[Product, ...]
    values: tuple[float, ...]
    errors: tuple[float, ...]
    told: dict[str, Any]


def breed(
    algebra: Algebra,
    data: Mapping[str, np.ndarray],
    target: np.ndarray,
    train: np.ndarray,
    config: GeneticConfig,
    seed: int,
) -> Bred:
    """Search an equation and fit it to all samples.

    Args:
        algebra: of the channels, within the limits of the search.
        data: channels [N] by name.
        target: [N].
        train: which samples train the search; the others validate.
        config: of the head.
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
    """All terms that the data tell apart, by least squares."""
    y = reduced.y[:, 0]
    best, inverse = coefficients(reduced.r, y)
    left = y - reduced.r @ best
    spread = np.sqrt(left @ left / max(float(reduced.samples[0]) - len(best), 1.0))
    share = float(np.sqrt(left @ left / max(y @ y, 1e-300)))
    errors = spread * np.sqrt(np.square(inverse).sum(axis=1))
    return Equation(
        reduced.names,
        best / reduced.scale,
        errors / reduced.scale,
        share,
        share <= 1e-13,
        0.0,
        0,
        {},
        {},
    )


@final
class GeneticHead(EquationHead):
    """rho [..., 3] = terms(features) coefficients; over the baseline `still` it is the equation of
    the acceleration itself.
    """

    def __init__(self, config: GeneticConfig, names: Sequence[str]) -> None:
        super().__init__()
        self.features = Features(config.chosen(names), names, config.margin)
        self.config = config
        self.library = ExpressionLibrary(config.evolution.nesting)
        self.weights = Weights()

    def calibrate(self, samples: Samples) -> None:
        """Take the ranges of the features from the samples."""
        self.features.calibrate(samples)

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Residual [..., 3] at channels z [..., nz]; the memory is empty."""
        return self.library(self.features.guarded(z)) @ self.weights.values.to(z.dtype), s

    def parameter_count(self) -> list[float]:
        """Coefficients of each axis that are not zero."""
        return [float(count) for count in (self.weights.values != 0).sum(0)]

    def contributions(self, z: Tensor, axis: int) -> dict[str, np.ndarray]:
        """Return each term of an axis times its coefficient [T], along channels z [T, nz]."""
        with torch.no_grad():
            values = (
                self.library(self.features.guarded(z)) * self.weights.values[:, axis].to(z.dtype)
            ).numpy()
        return {
            name: values[:, j]
            for j, name in enumerate(self.names())
            if float(self.weights.values[j, axis]) != 0.0
        }

    @torch.jit.unused
    def names(self) -> list[str]:
        """The terms in writing."""
        algebra, products = self.library.read(self.features.names)
        return [term(algebra, product) for product in products]

    def solutions(self, samples: Samples) -> list[Solution]:
        """The equations of the best individuals of the three searches.

        Raises:
            FitError: where the data do not determine an equation.
            UsageError: where DEAP is not installed.
        """
        algebra = Algebra(self.features.names, limits_of(self.config.evolution))
        z, target = self.features.guarded(samples.z).numpy(), samples.target.numpy()
        data = {name: z[:, i] for i, name in enumerate(self.features.names)}
        train = ~validating(samples.group.numpy(), self.config.validate_every)
        bred = [
            breed(algebra, data, target[:, axis], train, self.config, 3 * self.config.seed + axis)
            for axis in range(3)
        ]
        products = sorted({product for own in bred for product in own.products})
        weights = torch.zeros(len(products), 3, dtype=torch.float64)
        for axis, own in enumerate(bred):
            for product, value in zip(own.products, own.values, strict=True):
                weights[products.index(product), axis] = value
        table = tuple(
            Coefficient(name, term(algebra, product), value, error)
            for name, own in zip(ACCELERATION, bred, strict=True)
            for product, value, error in zip(own.products, own.values, own.errors, strict=True)
        )
        notes = {
            "parameters": len(table),
            "coefficients": [
                {"axis": c.axis, "term": c.term, "value": c.value, "standard_error": c.error}
                for c in table
            ],
            "unexcited": [],
            "equations": {
                name: _written(algebra, name, own)
                for name, own in zip(ACCELERATION, bred, strict=True)
            },
        }
        state = {
            f"library.{name}": value
            for name, value in tables(algebra, products, self.config.evolution.nesting).items()
        }
        return [
            Solution(
                {"kept": [len(own.products) for own in bred]},
                state | {"weights.values": weights},
                table,
                notes,
            )
        ]


def validating(group: np.ndarray, every: int) -> np.ndarray:
    """Which samples [N] validate, from the numbers of their manoeuvres: every so manieth where
    there are enough, else blocks of the record.
    """
    numbers = np.unique(group, return_inverse=True)[1]
    if numbers.max(initial=0) + 1 < every:
        numbers = np.arange(len(group)) * _BLOCKS // max(len(group), 1)
    return np.asarray(numbers % every == every - 1)


def _written(algebra: Algebra, name: str, bred: Bred) -> dict[str, Any]:
    """One equation in writing, with the course of its search."""
    return {
        "text": f"{name} = {total(algebra, bred.products, bred.values, PLAIN)}",
        "latex": f"{latex_left(name)} = {total(algebra, bred.products, bred.values, LATEX)}",
        "sympy": total(algebra, bred.products, bred.values, SYMPY),
        "c": c_function(algebra, name, bred.products, bred.values),
        **bred.told,
        "bred_terms": len(bred.found.terms),
        "generation": bred.found.generation,
        "reached_goal": bred.found.reached,
        "sets_fitted": bred.found.fitted,
        "history": [asdict(generation) for generation in bred.found.history],
    }

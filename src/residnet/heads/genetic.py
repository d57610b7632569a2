"""The genetic head: an equation bred by genetic programming (document 000)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, final

import torch
from torch import Tensor

from residnet.core.errors import FitError
from residnet.core.samples import Samples
from residnet.heads.base import EquationHead, FeatureConfig, Features
from residnet.physics.terms import CandidatesConfig, TermLibrary, parse_term
from residnet.regression.estimator import Solution
from residnet.regression.expressions import ExpressionLibrary, Term, Weights, term
from residnet.regression.genetic import EquationSearchConfig, GeneticEquations
from residnet.regression.sparse import SparseRegression


class GeneticConfig(FeatureConfig, EquationSearchConfig):
    """An equation for each axis, in SI units, by genetic programming.

    Fitting needs the extra `gp`, using a fitted model does not.

    Attributes:
        kind: name of the head.
        optional: leave the head out of a fit where the extra is not installed, and say so, instead
            of stopping.
    """

    kind: Literal["genetic"] = "genetic"
    optional: bool = False

    def build(self, names: Sequence[str]) -> GeneticHead:
        """Return the module for channels `names`."""
        return GeneticHead(self, names)


@final
class GeneticHead(EquationHead):
    """A head whose residual is terms(features) coefficients.

    Over the baseline `still` it is the equation of the acceleration itself.
    """

    def __init__(self, config: GeneticConfig, names: Sequence[str]) -> None:
        super().__init__(names)
        self.features = Features(config.chosen(names), names, config.margin)
        self.config = config
        self.library = ExpressionLibrary(config.evolution.nesting)
        self.weights = Weights(self.dof)

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        return self.library(self.features.guarded(z)) @ self.weights.values.to(z.dtype), s

    def parameter_count(self) -> list[float]:
        return [float(count) for count in (self.weights.values != 0).sum(0)]

    @torch.jit.unused
    def along(self, z: Tensor) -> tuple[Tensor, Tensor]:
        return self.library(self.features.guarded(z)), self.weights.values

    @torch.jit.unused
    def names(self) -> list[str]:
        algebra, products = self.library.read(self.features.names)
        return [term(algebra, product) for product in products]

    def solutions(self, samples: Samples) -> list[Solution]:
        """Return the equations of the best individuals of the three searches.

        Where their terms are chosen from once more, those of a sparse search are among them: with
        noise it finds more equations than breeding does, and in a hundredth of the time.

        Raises:
            FitError: where the data do not determine an equation.
            UsageError: where DEAP is not installed.
        """
        return GeneticEquations(self.config, self._known(samples)).fit(
            self.features.guarded(samples.z),
            samples.target,
            samples.group,
            names=self.features.names,
            outputs=self.outputs,
        )

    def _known(self, samples: Samples) -> list[list[Term]]:
        """Return the factors of the terms that a sparse search finds for each output."""
        search, names = self.config.final, self.features.names
        if search is None:
            return []
        space, z = CandidatesConfig(), self.features.guarded(samples.z)
        candidates = space.candidates(names)
        library = TermLibrary([candidate.term for candidate in candidates], names)
        clear = space.clear(library.terms, names, z)
        estimator = SparseRegression(
            search,
            degrees=[candidate.degree for candidate in candidates],
            efforts=[candidate.effort for candidate in candidates],
            allowed=clear[:, None].expand(-1, len(self.outputs)),
        )
        terms = library(z)
        try:
            found = estimator.fit(terms, samples.target, names=library.terms, outputs=self.outputs)[
                0
            ].table
        except FitError:
            # too few samples for all candidates say nothing against a bred equation
            return []
        return [
            [
                [
                    ("abs" if factor.magnitude else factor.function, factor.name, factor.power)
                    for factor in parse_term(one.term, names)
                ]
                for one in found
                if one.axis == output
            ]
            for output in self.outputs
        ]

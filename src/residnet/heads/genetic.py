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
from residnet.regression.expressions import (
    CoefficientTable,
    ExpressionLibrary,
    Factors,
    format_product,
)
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
        """Return the module for channels `format_terms`."""
        return GeneticHead(self, names)


@final
class GeneticHead(EquationHead):
    """A head whose residual is terms(features) coefficients.

    Over the baseline `still` it is the equation of the acceleration itself.
    """

    def __init__(self, config: GeneticConfig, names: Sequence[str]) -> None:
        super().__init__(names)
        self.features = Features(config.select_features(names), names, config.margin)
        self.config = config
        self.library = ExpressionLibrary(config.evolution.nesting)
        self.weights = CoefficientTable(self.n_dof)

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        return self.library(self.features.select_clamped(z)) @ self.weights.values.to(z.dtype), s

    def parameter_counts(self) -> list[float]:
        return [float(n_nonzero) for n_nonzero in (self.weights.values != 0).sum(0)]

    @torch.jit.unused
    def evaluate_terms(self, z: Tensor) -> tuple[Tensor, Tensor]:
        return self.library(self.features.select_clamped(z)), self.weights.values

    @torch.jit.unused
    def format_terms(self) -> list[str]:
        algebra, products = self.library.decode_terms(self.features.names)
        return [format_product(algebra, product) for product in products]

    def fit_solutions(self, samples: Samples) -> list[Solution]:
        """Return the equations of the best individuals of the three searches.

        Where their terms are chosen from once more, those of a sparse search are among them: with
        noise it finds more equations than breeding does, and in a hundredth of the time.

        Raises:
            FitError: where the data do not determine an equation.
            UsageError: where DEAP is not installed.
        """
        return GeneticEquations(self.config, self._sparse_search_terms(samples)).fit(
            self.features.select_clamped(samples.z),
            samples.target,
            samples.group,
            names=self.features.names,
            outputs=self.output_names,
        )

    def _sparse_search_terms(self, samples: Samples) -> list[list[Factors]]:
        """Return the factors of the terms that a sparse search finds for each output."""
        search_settings = self.config.final
        names = self.features.names
        if search_settings is None:
            return []
        candidate_settings = CandidatesConfig()
        z = self.features.select_clamped(samples.z)
        candidates = candidate_settings.generate_candidates(names)
        library = TermLibrary([candidate.term for candidate in candidates], names)
        is_nonsingular = candidate_settings.find_nonsingular_terms(library.terms, names, z)
        estimator = SparseRegression(
            search_settings,
            degrees=[candidate.degree for candidate in candidates],
            complexities=[candidate.complexity for candidate in candidates],
            allowed_terms=is_nonsingular[:, None].expand(-1, len(self.output_names)),
        )
        term_values = library(z)
        try:
            coefficients = estimator.fit(
                term_values, samples.target, names=library.terms, outputs=self.output_names
            )[0].table
        except FitError:
            # too few samples for all candidates say nothing against a bred equation
            return []
        return [
            [
                [
                    ("abs" if factor.magnitude else factor.function, factor.name, factor.power)
                    for factor in parse_term(coefficient.term, names)
                ]
                for coefficient in coefficients
                if coefficient.axis == output
            ]
            for output in self.output_names
        ]

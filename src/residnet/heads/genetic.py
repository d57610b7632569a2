"""Residual equation found by genetic programming (document 000)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, final

import torch
from torch import Tensor

from residnet.core.errors import FitError
from residnet.core.samples import Samples
from residnet.heads.base import EquationHead, Features
from residnet.physics.term_library import TermLibrary
from residnet.physics.terms import CandidatesConfig, parse_term
from residnet.regression.estimator import Solution
from residnet.regression.expressions import (
    CoefficientTable,
    ExpressionLibrary,
    Factors,
    format_product,
)
from residnet.regression.genetic import GeneticEquations
from residnet.regression.sparse import SparseRegression

if TYPE_CHECKING:
    from residnet.heads.genetic_config import GeneticConfig


@final
class GeneticHead(EquationHead):
    """Head with the residual terms(features) coefficients.

    With the baseline `still` it is an equation of the acceleration.
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
        """Search an equation for each axis.

        The final selection also considers the terms of a sparse search. On noisy data this search
        finds more of the true equations than genetic programming, in a hundredth of the time.

        Raises:
            FitError: if the data do not determine an equation.
            UsageError: if DEAP is not installed.
        """
        return GeneticEquations(self.config, self._sparse_search_terms(samples)).fit(
            self.features.select_clamped(samples.z),
            samples.target,
            samples.group,
            names=self.features.names,
            outputs=self.output_names,
        )

    def _sparse_search_terms(self, samples: Samples) -> list[list[Factors]]:
        """Return the factors of the terms that a sparse search selects for each output."""
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
            # too few samples for all candidates at once; genetic programming needs fewer
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

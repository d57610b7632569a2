"""Heads (residual models) that are linear in basis functions, with a choice of estimators."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, final

import torch
from torch import Tensor, nn

from residnet.core.arrays.paged import iterate_row_chunks
from residnet.core.samples import Samples
from residnet.heads.base import ClosedFormHead, Features
from residnet.physics.term_library import TermLibrary
from residnet.regression.estimator import (
    Solution,
    default_fold_count,
    evaluate_regressors,
    require_finite,
)

if TYPE_CHECKING:
    from residnet.heads.basis_config import BasisConfig


@final
class BasisHead(ClosedFormHead):
    """Head that is linear in basis functions, intercept + phi(features / std) coefficients."""

    def __init__(self, config: BasisConfig, names: Sequence[str]) -> None:
        super().__init__(names)
        feature_names = config.select_features(names)
        self.features = Features(feature_names, names, config.margin)
        self.library = TermLibrary(config.term_names(names), feature_names)
        self.config = config
        self.coefficients = nn.Buffer(
            torch.zeros(self.library.n_terms, self.n_dof, dtype=torch.float64)
        )
        self.intercept = nn.Buffer(torch.zeros(self.n_dof, dtype=torch.float64))

    def basis_functions(self, z: Tensor) -> Tensor:
        """Return the basis functions [..., J] at channels z [..., nz].

        Features are scaled but not centred, so that a product term is the product of its channels.
        """
        values: Tensor = self.library(
            self.features.select_clamped(z) / self.features.std.to(z.dtype)
        )
        return values

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        return self.basis_functions(z) @ self.coefficients.to(z.dtype) + self.intercept.to(
            z.dtype
        ), s

    def fit_solutions(self, samples: Samples) -> list[Solution]:
        columns = [samples.names.index(name) for name in self.features.names]
        for rows in iterate_row_chunks(len(samples)):
            features = samples.z[rows][:, columns]
            require_finite(features, self.features.names, "channel", rows.start)
        n_folds = self.config.folds or default_fold_count(samples.group)
        return self.config.build_estimator(n_folds).fit(
            evaluate_regressors(self.basis_functions, samples.z, range(self.library.n_terms)),
            samples.target,
            samples.group,
            names=self.library.terms,
            outputs=self.output_names,
        )

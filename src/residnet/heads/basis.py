"""Heads that are linear in basis functions of the channels, with a choice of estimators."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Literal, Self, final

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn

from residnet.core.arrays.paged import iterate_row_chunks
from residnet.core.names import ACCELERATION_NAMES
from residnet.core.samples import Samples
from residnet.heads.base import ClosedFormHead, FeatureConfig, Features
from residnet.physics.symmetry import get_dof
from residnet.physics.terms import TermLibrary, make_polynomial_terms
from residnet.regression.estimator import (
    Estimator,
    Solution,
    assign_group_folds,
    default_fold_count,
    evaluate_regressors,
    require_finite,
)


class BasisConfig(FeatureConfig, ABC):
    """Basis functions of a head and the selection of its complexity.

    Attributes:
        space: space of the residual. `acceleration` is nu_dot minus the baseline. `force` is
            tau - F(nu_dot, nu) of a baseline of kind `believed`; its features are accelerations and
            velocities, and its terms are affine in the accelerations.
        terms: names of basis functions (see `residnet.physics.terms`) of features scaled by their
            standard deviations. If empty, all products of the features up to `degree` and x|x| of
            the velocities; in force space the thirty terms of document 002 (4.12).
        degree: maximum degree of the products if `terms` is empty.
        choose: criterion of the complexity. `free_run` is the error of free runs on validation
            data, with no residual as a candidate; `one_step` is the cross-validated error of the
            accelerations.
        folds: number of folds of the cross-validation, which never splits a manoeuvre; null for
            five folds, or the number of manoeuvres if it is lower.
    """

    space: Literal["acceleration", "force"] = "acceleration"
    terms: tuple[str, ...] = ()
    degree: int = Field(default=2, ge=1, le=4)
    choose: Literal["one_step", "free_run"] = "free_run"
    folds: int | None = Field(default=None, ge=2, le=1_000)

    @model_validator(mode="after")
    def _validate_space(self) -> Self:
        acceleration_terms = [
            term for term in self.terms if any(name in term for name in ACCELERATION_NAMES)
        ]
        if self.space == "acceleration" and acceleration_terms:
            raise ValueError(
                f"terms: '{acceleration_terms[0]}' contains an acceleration, which only heads in"
                " force space support (space: force)"
            )
        return self

    @abstractmethod
    def build_estimator(self, n_folds: int | None) -> Estimator:
        """Build the estimator of the coefficients with a number of cross-validation folds."""


@final
class BasisHead(ClosedFormHead):
    """Head that is linear in basis functions, intercept + phi(features / std) coefficients."""

    def __init__(self, config: BasisConfig, names: Sequence[str]) -> None:
        super().__init__(names)
        feature_names = config.select_features(names)
        dynamic_states = get_dof(names).dynamic_states
        self.features = Features(feature_names, names, config.margin)
        magnitudes = [name for name in dynamic_states if name in feature_names]
        self.library = TermLibrary(
            config.terms
            or make_polynomial_terms(feature_names, config.degree, magnitudes=magnitudes),
            feature_names,
        )
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

    def validate_samples(self, samples: Samples) -> None:
        assign_group_folds(samples.group, self.config.folds or default_fold_count(samples.group))

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

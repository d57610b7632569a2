"""Heads that are linear in basis functions of the channels.

Their solutions differ, their evaluation does not.
"""

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
    """The basis functions of a head.

    Attributes:
        space: what the residual is: `acceleration`, what the baseline leaves of nu_dot; or `force`,
            tau - F(nu_dot, nu) of a baseline of kind believed, whose features are accelerations and
            velocities and whose terms are affine in the accelerations.
        terms: basis functions by name (see `residnet.physics.terms`), in units of each feature's
            standard deviation; empty: all products of the features up to `degree` and x|x| of the
            velocities, or in force space the thirty of document 002 (4.12).
        degree: highest degree of the products where `terms` is empty.
        choose: what the complexity is chosen by: `free_run`, error of free runs on validation data,
            which may find that no residual at all is best; or `one_step`, cross-validated error of
            accelerations.
        folds: number of folds of the cross-validation; a manoeuvre is never split between folds.
            null for five, or one for each manoeuvre where there are fewer.
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
                f"terms: '{acceleration_terms[0]}' names an acceleration, which only a residual in force space"
                " may (space: force)"
            )
        return self

    @abstractmethod
    def build_estimator(self, n_folds: int | None) -> Estimator:
        """Return the estimator of the coefficients, cross-validated over so many folds."""


@final
class BasisHead(ClosedFormHead):
    """A head that is linear in basis functions: intercept + phi(features / std) coefficients."""

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

        Features are scaled but not centred, so that names keep their meaning.
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

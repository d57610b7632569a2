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

from residnet.core.arrays.paged import row_pieces
from residnet.core.names import ACCELERATION
from residnet.core.samples import Samples
from residnet.heads.base import ClosedFormHead, FeatureConfig, Features
from residnet.physics.symmetry import live_of
from residnet.physics.terms import TermLibrary, polynomial_terms
from residnet.regression.estimator import (
    Estimator,
    Solution,
    fold_numbers,
    regressors,
    require_finite,
    usual_folds,
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
    def _space(self) -> Self:
        named = [term for term in self.terms if any(name in term for name in ACCELERATION)]
        if self.space == "acceleration" and named:
            raise ValueError(
                f"terms: '{named[0]}' names an acceleration, which only a residual in force space"
                " may (space: force)"
            )
        return self

    @abstractmethod
    def estimator(self, folds: int | None) -> Estimator:
        """Return the estimator of the coefficients, cross-validated over so many folds."""


@final
class BasisHead(ClosedFormHead):
    """A head that is linear in basis functions: intercept + phi(features / std) coefficients."""

    def __init__(self, config: BasisConfig, names: Sequence[str]) -> None:
        super().__init__(names)
        chosen, moving = config.chosen(names), live_of(names).moving
        self.features = Features(chosen, names, config.margin)
        magnitudes = [name for name in moving if name in chosen]
        self.library = TermLibrary(
            config.terms or polynomial_terms(chosen, config.degree, magnitudes=magnitudes), chosen
        )
        self.config = config
        self.coefficients = nn.Buffer(
            torch.zeros(self.library.count, self.dof, dtype=torch.float64)
        )
        self.intercept = nn.Buffer(torch.zeros(self.dof, dtype=torch.float64))

    def basis(self, z: Tensor) -> Tensor:
        """Return the basis functions [..., J] at channels z [..., nz].

        Features are scaled but not centred, so that names keep their meaning.
        """
        values: Tensor = self.library(self.features.guarded(z) / self.features.std.to(z.dtype))
        return values

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        return self.basis(z) @ self.coefficients.to(z.dtype) + self.intercept.to(z.dtype), s

    def require_samples(self, samples: Samples) -> None:
        fold_numbers(samples.group, self.config.folds or usual_folds(samples.group))

    def solutions(self, samples: Samples) -> list[Solution]:
        columns = [samples.names.index(name) for name in self.features.names]
        for rows in row_pieces(len(samples)):
            chosen = samples.z[rows][:, columns]
            require_finite(chosen, self.features.names, "channel", rows.start)
        folds = self.config.folds or usual_folds(samples.group)
        return self.config.estimator(folds).fit(
            regressors(self.basis, samples.z, range(self.library.count)),
            samples.target,
            samples.group,
            names=self.library.terms,
            outputs=self.outputs,
        )

"""Heads that are linear in basis functions of the channels; their solutions differ, their
evaluation does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, Self

import torch
from pydantic import Field, model_validator
from torch import Tensor

from residnet.core.errors import FitError
from residnet.core.names import ACCELERATION
from residnet.core.samples import Samples
from residnet.heads.base import ClosedFormHead, FeatureConfig, Features
from residnet.physics.terms import TermLibrary, polynomial_terms
from residnet.regression.moments import FoldMoments
from residnet.regression.solutions import Solution


class BasisConfig(FeatureConfig):
    """Which basis functions.

    Attributes:
        space: what the residual is: `acceleration`, what the baseline leaves of nu_dot; or `force`,
            tau - F(nu_dot, nu) of a baseline of kind believed, whose features are accelerations and
            velocities and whose terms are affine in the accelerations.
        terms: basis functions by name (see `residnet.physics.terms`), in units of each feature's
            spread; empty: all products of the features up to `degree` and x|x| of the velocities,
            or in force space the thirty of document 002 (4.12).
        degree: highest degree of the products where `terms` is empty.
        choose: what the complexity is chosen by: `free_run`, error of free runs on validation data,
            which may find that no residual at all is best; or `one_step`, cross-validated error of
            accelerations.
        folds: folds of the cross-validation; a manoeuvre is never split between folds.
    """

    space: Literal["acceleration", "force"] = "acceleration"
    terms: tuple[str, ...] = ()
    degree: int = Field(default=2, ge=1, le=4)
    choose: Literal["one_step", "free_run"] = "free_run"
    folds: int = Field(default=5, ge=2)

    @model_validator(mode="after")
    def _space(self) -> Self:
        named = [term for term in self.terms if any(name in term for name in ACCELERATION)]
        if self.space == "acceleration" and named:
            raise ValueError(
                f"terms: '{named[0]}' names an acceleration, which only a residual in force space"
                " may (space: force)"
            )
        return self


class BasisHead(ClosedFormHead):
    """rho [..., 3] = intercept + phi(features / spread) coefficients; buffers found by the
    subclass.
    """

    def __init__(self, config: BasisConfig, names: Sequence[str]) -> None:
        super().__init__()
        chosen = config.chosen(names)
        self.features = Features(chosen, names, config.margin)
        magnitudes = [name for name in ("u", "v", "r") if name in chosen]
        self.library = TermLibrary(
            config.terms or polynomial_terms(chosen, config.degree, magnitudes=magnitudes), chosen
        )
        self.folds = config.folds
        self.by_free_run = config.choose == "free_run"
        self.register_buffer(
            "coefficients", torch.zeros(self.library.count, 3, dtype=torch.float64)
        )
        self.register_buffer("intercept", torch.zeros(3, dtype=torch.float64))
        self.coefficients: Tensor
        self.intercept: Tensor

    def calibrate(self, samples: Samples) -> None:
        """Take scales and ranges of the features from the samples."""
        self.features.calibrate(samples)

    def basis(self, z: Tensor) -> Tensor:
        """Basis functions [..., J] at channels z [..., nz]; features are scaled but not centred, so
        that names keep their meaning.
        """
        return self.library(self.features.guarded(z) / self.features.std.to(z.dtype))

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Residual [..., 3] at channels z [..., nz]; the memory is empty."""
        return self.basis(z) @ self.coefficients.to(z.dtype) + self.intercept.to(z.dtype), s

    def moments(self, samples: Samples) -> FoldMoments:
        """Moments of basis functions and target by fold.

        Raises:
            FitError: with fewer manoeuvres than folds, fewer samples than basis functions, or one
                that is not finite.
        """
        groups = torch.unique(samples.group)
        if groups.numel() < self.folds:
            raise FitError(
                f"{self.folds} folds need as many manoeuvres, the training data have"
                f" {groups.numel()}; lower `folds`"
            )
        if len(samples) <= self.library.count:
            raise FitError(
                f"{len(samples)} samples do not determine {self.library.count} basis functions;"
                " give more data or fewer terms"
            )
        fold = torch.searchsorted(groups, samples.group) % self.folds
        chosen = [samples.names.index(name) for name in self.features.names]
        _require_finite(samples.z[:, chosen], self.features.names, "channel")
        x = self.basis(samples.z)
        _require_finite(x, self.library.terms, "basis function")
        # a column that varies by rounding alone gets no coefficient instead of a huge one
        constant = x.std(0) <= 1e-9 * x.abs().amax(0)
        return FoldMoments.gather(x.masked_fill(constant, 0.0), samples.target, fold, self.folds)

    def solution(
        self,
        choice: dict[str, Any],
        coefficients: Tensor,
        mean_x: Tensor,
        mean_y: Tensor,
        moments: FoldMoments,
        notes: dict[str, Any] | None = None,
    ) -> Solution:
        """A solution y = mean_y + (x - mean_x) coefficients [J, 3], means as in `moments`."""
        intercept = mean_y + moments.shift_y - (mean_x + moments.shift_x) @ coefficients
        return Solution(
            choice, {"coefficients": coefficients, "intercept": intercept}, notes=notes or {}
        )

    def nothing(self, choice: dict[str, Any], notes: dict[str, Any]) -> Solution:
        """The solution that leaves the baseline as it is: a residual that explains accelerations
        may still spoil free runs.
        """
        return Solution(
            choice,
            {
                "coefficients": torch.zeros_like(self.coefficients),
                "intercept": torch.zeros_like(self.intercept),
            },
            notes=notes,
        )

    def coefficient_table(self) -> dict[str, list[float]]:
        """Basis function -> its coefficients (u, v, r axis), for features in units of their spread;
        for the report.
        """
        return dict(zip(self.library.terms, self.coefficients.tolist(), strict=True))


def _require_finite(values: Tensor, names: Sequence[str], what: str) -> None:
    bad = ~torch.isfinite(values)
    if bool(bad.any()):
        row, column = (int(part[0]) for part in bad.nonzero(as_tuple=True))
        raise FitError(
            f"{what} '{names[column]}' is not finite at sample {row}; mask or repair the log"
        )

"""Ridge regression (document 001 section 2.2, correction M4) and PLSR over basis functions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, final

from pydantic import Field

from residnet.heads.base import ClosedFormHead
from residnet.heads.basis import BasisConfig, BasisHead
from residnet.heads.force import in_space
from residnet.regression.estimator import Estimator
from residnet.regression.shrinkage import PLSR, Ridge


class PlsrConfig(BasisConfig):
    """A PLSR of the three residuals together.

    Attributes:
        order: number of latent variables; None chooses it as `choose` says. One-step errors are
            summed over the axes, each in units of its variance.
        max_order: highest number of latent variables that is tried.
    """

    kind: Literal["plsr"] = "plsr"
    order: int | None = Field(default=None, ge=1)
    max_order: int = Field(default=40, ge=1)

    def build(self, names: Sequence[str]) -> ClosedFormHead:
        """Return the module for channels `names`."""
        return in_space(
            self,
            names,
            lambda settings, channels: PlsrHead(self.model_validate(settings), channels),
        )


@final
class PlsrHead(BasisHead):
    """A head of basis functions with coefficients by PLSR."""

    def __init__(self, config: PlsrConfig, names: Sequence[str]) -> None:
        super().__init__(config, names)
        self.order = config.order
        self.max_order = config.max_order

    def estimator(self, folds: int | None) -> Estimator:
        """Return PLSR of all axes, other orders on offer where free runs choose."""
        return PLSR(
            self.order,
            max_order=self.max_order,
            folds=folds,
            alternatives=self.by_free_run and self.order is None,
        )


class RidgeConfig(BasisConfig):
    """A ridge regression of each residual.

    Attributes:
        penalties: candidates, in units of a standardised column's energy: alpha = penalty * samples
            in scikit-learn's terms. By one-step errors each axis takes its own; free runs choose
            between those, one penalty for all axes, and no residual (an empty list in fit.json).
    """

    kind: Literal["ridge"] = "ridge"
    penalties: tuple[float, ...] = Field(
        default=(1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0), min_length=1
    )

    def build(self, names: Sequence[str]) -> ClosedFormHead:
        """Return the module for channels `names`."""
        return in_space(
            self,
            names,
            lambda settings, channels: RidgeHead(self.model_validate(settings), channels),
        )


@final
class RidgeHead(BasisHead):
    """A head of basis functions with coefficients by ridge regression."""

    def __init__(self, config: RidgeConfig, names: Sequence[str]) -> None:
        super().__init__(config, names)
        self.penalties = config.penalties

    def estimator(self, folds: int | None) -> Estimator:
        """Return ridge regression, every penalty on offer where free runs choose."""
        return Ridge(self.penalties, folds=folds, alternatives=self.by_free_run)

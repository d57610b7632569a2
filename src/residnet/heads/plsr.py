"""Partial least squares over basis functions (document 002 section 3.2, corrections J14 to J17)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, final

from pydantic import Field

from residnet.heads.base import ClosedFormHead
from residnet.heads.basis import BasisConfig, BasisHead
from residnet.heads.force import in_space
from residnet.regression.estimator import Estimator
from residnet.regression.shrinkage import PLSR


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

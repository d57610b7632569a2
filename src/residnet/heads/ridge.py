"""Ridge regression over basis functions (document 001 section 2.2, correction M4)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, final

from pydantic import Field

from residnet.heads.base import ClosedFormHead
from residnet.heads.basis import BasisConfig, BasisHead
from residnet.heads.force import in_space
from residnet.regression.estimator import Estimator
from residnet.regression.shrinkage import Ridge


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

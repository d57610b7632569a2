"""Ridge regression (document 001 section 2.2, correction M4) and PLSR over basis functions."""

from __future__ import annotations

from abc import ABC
from collections.abc import Sequence
from typing import Literal, final

from pydantic import Field

from residnet.core.names import ACCELERATION_NAMES
from residnet.heads.base import ClosedFormHead
from residnet.heads.basis import BasisConfig, BasisHead
from residnet.heads.force import ForceHead
from residnet.physics.force_model import FERRY_TERMS, MOTION_CHANNELS
from residnet.regression.estimator import Estimator
from residnet.regression.shrinkage import PLSR, Ridge


class LinearBasisConfig(BasisConfig, ABC):
    @final
    def build(self, names: Sequence[str]) -> ClosedFormHead:
        """Return the module for channels `names`, in the space that the config names.

        Raises:
            ConfigError: where a term is not understood, or in force space not affine in the
                accelerations.
        """
        if self.space == "acceleration":
            return BasisHead(self, names)
        force_defaults = {
            "features": self.features or MOTION_CHANNELS,
            "terms": self.terms or FERRY_TERMS,
        }
        return ForceHead(
            BasisHead(self.model_copy(update=force_defaults), (*ACCELERATION_NAMES, *names))
        )


class PlsrConfig(LinearBasisConfig):
    """A PLSR of the three residuals together.

    Attributes:
        order: number of latent variables; None chooses it as `choose` says. One-step errors are
            summed over the axes, each in units of its variance.
        max_order: highest number of latent variables that is tried.
    """

    kind: Literal["plsr"] = "plsr"
    order: int | None = Field(default=None, ge=1)
    max_order: int = Field(default=40, ge=1)

    def build_estimator(self, n_folds: int | None) -> Estimator:
        """Return PLSR of all axes, other orders on offer where free runs choose."""
        has_alternatives = self.choose == "free_run" and self.order is None
        return PLSR(
            self.order, max_order=self.max_order, folds=n_folds, has_alternatives=has_alternatives
        )


class RidgeConfig(LinearBasisConfig):
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

    def build_estimator(self, n_folds: int | None) -> Estimator:
        """Return ridge regression, every penalty on offer where free runs choose."""
        return Ridge(self.penalties, folds=n_folds, has_alternatives=self.choose == "free_run")

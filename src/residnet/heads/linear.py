"""Ridge regression and partial least squares (PLSR) on basis functions.

Sources: Moreno-Salinas et al. 2019, section 2.2, and Jervan 2020, section 3.2.
"""

from __future__ import annotations

from abc import ABC
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal, Self, final

from pydantic import Field

from residnet.core.names import ACCELERATION_NAMES
from residnet.heads.basis_config import BasisConfig
from residnet.physics.force_terms import (
    FERRY_TERMS,
    MOTION_CHANNELS,
    find_acceleration_terms,
    require_inertia_matrix,
)
from residnet.physics.terms import parse_term

if TYPE_CHECKING:
    from residnet.heads.base import ClosedFormHead
    from residnet.regression.estimator import Estimator


class LinearBasisConfig(BasisConfig, ABC):
    """Base of the configurations of heads that are linear in basis functions."""

    @final
    def check_channels(self, names: Sequence[str]) -> None:
        config = self
        channel_names: Sequence[str] = names
        if self.space == "force":
            config = self._with_force_defaults()
            channel_names = (*ACCELERATION_NAMES, *names)
        feature_names = config.select_features(channel_names)
        terms = config.term_names(channel_names)
        for term in terms:
            parse_term(term, feature_names)
        if self.space == "force":
            find_acceleration_terms(terms, feature_names)

    @final
    def check_inertia(self, names: Sequence[str], *, has_inertia_matrix: bool) -> None:
        if self.space == "force":
            require_inertia_matrix(has_inertia_matrix=has_inertia_matrix)

    def _with_force_defaults(self) -> Self:
        """Return the config with the features and terms of Jervan 2020 where none are given."""
        force_defaults = {
            "features": self.features or MOTION_CHANNELS,
            "terms": self.terms or FERRY_TERMS,
        }
        return self.model_copy(update=force_defaults)

    @final
    def build(self, names: Sequence[str]) -> ClosedFormHead:
        """Build the head for channels `names`, in acceleration or force space.

        Raises:
            ConfigError: if a term is invalid or, in force space, not affine in the accelerations.
        """
        from residnet.heads.basis import BasisHead
        from residnet.heads.force import ForceHead

        if self.space == "acceleration":
            return BasisHead(self, names)
        return ForceHead(BasisHead(self._with_force_defaults(), (*ACCELERATION_NAMES, *names)))


class PlsrConfig(LinearBasisConfig):
    """Partial least squares regression of the residuals of all axes in one model.

    Attributes:
        order: number of latent variables; null to select it by `choose`. One-step errors are
            summed over the axes relative to their variances.
        max_order: highest candidate number of latent variables.
    """

    kind: Literal["plsr"] = "plsr"
    order: int | None = Field(default=None, ge=1)
    max_order: int = Field(default=40, ge=1)

    def build_estimator(self, n_folds: int | None) -> Estimator:
        """Build the PLSR estimator, with alternative orders if free runs select."""
        from residnet.regression.shrinkage import PLSR

        has_alternatives = self.choose == "free_run" and self.order is None
        return PLSR(
            self.order, max_order=self.max_order, folds=n_folds, has_alternatives=has_alternatives
        )


class RidgeConfig(LinearBasisConfig):
    """Ridge regression of the residual of each axis.

    Attributes:
        penalties: candidate penalties relative to the energy of a standardised column; `alpha` of
            scikit-learn is the penalty times the number of samples. One-step errors select a
            penalty per axis. Free runs select among these, a shared penalty, and no residual (an
            empty list in fit.json).
    """

    kind: Literal["ridge"] = "ridge"
    penalties: tuple[float, ...] = Field(
        default=(1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0), min_length=1
    )

    def build_estimator(self, n_folds: int | None) -> Estimator:
        """Build the ridge estimator, with all penalties as alternatives if free runs select."""
        from residnet.regression.shrinkage import Ridge

        return Ridge(self.penalties, folds=n_folds, has_alternatives=self.choose == "free_run")

"""Configuration of heads (residual models) that are linear in basis functions."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal, Self

from pydantic import Field, model_validator

from residnet.core.names import ACCELERATION_NAMES
from residnet.core.sample_origins import SampleOrigins
from residnet.heads.config import ClosedFormConfig
from residnet.physics.symmetry import get_dof
from residnet.physics.terms import make_polynomial_terms
from residnet.regression.folds import count_default_folds, require_folds

if TYPE_CHECKING:
    from residnet.regression.estimator import Estimator


class BasisConfig(ClosedFormConfig, ABC):
    """Basis functions of a head and the selection of its complexity.

    Attributes:
        space: space of the residual. `acceleration` is nu_dot minus the baseline. `force` is
            tau - F(nu_dot, nu) of a baseline of kind `believed`; its features are accelerations and
            velocities, and its terms are affine in the accelerations.
        terms: names of basis functions (see `residnet.physics.terms`) of features scaled by their
            standard deviations. If empty, all products of the features up to `degree` and x|x| of
            the velocities; in force space the thirty terms of Jervan 2020, eq. (4.12).
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

    def validate_samples(self, samples: SampleOrigins) -> None:
        require_folds(samples.n_groups, self.folds or count_default_folds(samples.n_groups))

    def term_names(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return the names of the basis functions for channels `names`.

        Raises:
            ConfigError: if a feature is not a channel.
        """
        feature_names = self.select_features(names)
        magnitudes = [name for name in get_dof(names).dynamic_states if name in feature_names]
        return self.terms or make_polynomial_terms(
            feature_names, self.degree, magnitudes=magnitudes
        )

    @abstractmethod
    def build_estimator(self, n_folds: int | None) -> Estimator:
        """Build the estimator of the coefficients with a number of cross-validation folds."""

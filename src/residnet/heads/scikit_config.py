"""Configuration of regressors of scikit-learn as heads (residual models)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field, field_validator

from residnet.heads.config import ClosedFormConfig
from residnet.heads.scikit_estimators import _is_listed, make_estimator
from residnet.heads.scikit_state import FITTED

if TYPE_CHECKING:
    from residnet.heads.base import ClosedFormHead


class SklearnConfig(ClosedFormConfig):
    """Pipeline of scikit-learn that ends in a regressor, fitted per axis.

    Features and targets are standardised.

    Attributes:
        pipeline: steps of the pipeline. A step is a dotted name below `sklearn`, or a mapping from
            the name to the parameters, whose values may again be names or mappings. Classes outside
            of `residnet.heads.scikit_state.FITTED` need `--trust`.
        samples: maximum number of training samples; more samples are decimated evenly.
    """

    kind: Literal["sklearn"] = "sklearn"
    pipeline: tuple[str | dict[str, dict[str, Any] | None], ...] = Field(
        default=("sklearn.ensemble.HistGradientBoostingRegressor",), min_length=1
    )
    samples: int = Field(default=5_000, ge=10, le=1_000_000)

    @field_validator("pipeline")
    @classmethod
    def _validate_pipeline(cls, steps: tuple[Any, ...]) -> tuple[Any, ...]:
        estimators = [make_estimator(step) for step in steps]
        final_step = estimators[-1]
        if not callable(getattr(final_step, "predict", None)):
            raise ValueError(
                f"the last step, {type(final_step).__name__}, is not a regressor; end the pipeline"
                " with one"
            )
        for estimator in estimators[:-1]:
            if not callable(getattr(estimator, "transform", None)):
                raise ValueError(
                    f"{type(estimator).__name__} is not a transformer; only the last step may be a"
                    " regressor"
                )
        return steps

    @property
    def is_storable(self) -> bool:
        """Whether all classes are on the allow-list, so that the fitted state can be stored."""
        return all(_is_listed(step, FITTED) for step in self.pipeline)

    def build(self, names: Sequence[str]) -> ClosedFormHead:
        """Build the head for channels `names`."""
        from residnet.heads.scikit import SklearnHead

        return SklearnHead(self, names)

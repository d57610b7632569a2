"""Settings of the refit of a baseline through rollouts."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from residnet.core.config import Config, Seconds
from residnet.training.offsets import OffsetsConfig

Prior = Annotated[float, Field(ge=0)]


class RefitConfig(Config):
    """Settings of the Gauss-Newton refit of a baseline's parameters.

    Attributes:
        horizon: length of the free runs in s.
        every: time between their starts in s.
        prior: weight of the least-squares solution, as a share of its own information; of several
            the strongest is taken whose free runs over folds of the logs are within one standard
            error of the best, the least-squares solution itself being one of the candidates.
        folds: number of parts that the training and validation logs are divided into where there
            are several priors: whole logs, or stretches where there are fewer logs than folds.
        asymmetric: shrinks terms that a mirror-symmetric vessel cannot have towards zero; 0 for no
            such knowledge.
        robust: windows whose error (in units of the scales) is far above this count by their error
            and not by its square.
        correlation: time over which errors of a free run hang together; the logs hold so many
            independent errors, which says how much beliefs weigh beside them, and how large the
            standard errors are.
        offsets: accelerations that each log has for itself (trim, rudder zero, carriage), estimated
            with the parameters and left out of the model; null where all logs are of exactly the
            same vessel. The least-squares prior does not know them: give it little weight.
        iterations: at most.
    """

    horizon: Seconds = Field(default=20.0, gt=0)
    every: Seconds = Field(default=10.0, gt=0)
    prior: Prior | Annotated[tuple[Prior, ...], Field(min_length=2)] = 1e-2
    folds: int = Field(default=4, ge=2)
    asymmetric: float = Field(default=0.0, ge=0)
    robust: float = Field(default=0.05, gt=0)
    correlation: Seconds = Field(default=10.0, gt=0)
    offsets: OffsetsConfig | None = None
    iterations: int = Field(default=10, ge=1, le=10_000)

    @property
    def priors(self) -> tuple[float, ...]:
        """The strengths of the prior to choose from, the strongest first."""
        given = self.prior if isinstance(self.prior, tuple) else (self.prior,)
        return tuple(sorted(given, reverse=True))

    def with_prior(self, prior: float) -> RefitConfig:
        """Return the same settings with one strength of the prior."""
        return self.model_copy(update={"prior": prior})

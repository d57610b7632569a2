"""Settings of the refit of a baseline through rollouts."""

from __future__ import annotations

from pydantic import Field

from residnet.core.config import Config, Seconds
from residnet.training.offsets import OffsetsConfig


class RefitConfig(Config):
    """Settings of the Gauss-Newton refit of a baseline's parameters.

    Attributes:
        horizon: length of the free runs in s.
        every: time between their starts in s.
        prior: weight of the least-squares solution, as a share of its own information.
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
    prior: float = Field(default=1e-2, ge=0)
    asymmetric: float = Field(default=0.0, ge=0)
    robust: float = Field(default=0.05, gt=0)
    correlation: Seconds = Field(default=10.0, gt=0)
    offsets: OffsetsConfig | None = None
    iterations: int = Field(default=10, ge=1, le=10_000)

    def with_prior(self, prior: float) -> RefitConfig:
        """Return the same settings with one strength of the prior."""
        return self.model_copy(update={"prior": prior})

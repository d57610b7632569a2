"""Laws of the line of sight: how a vessel aside of a straight leg steers back to it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Annotated, Literal, final

import torch
from pydantic import Field
from torch import Tensor, nn

from residnet.control.guidance.drift import DriftEstimate
from residnet.core.config import Config, Metres, MetresPerSecond


class LineOfSight(nn.Module, ABC):
    """The angle between a leg and the course that is steered."""

    def __init__(self) -> None:
        super().__init__()
        self.n_state = 0

    @abstractmethod
    def forward(self, error: Tensor, direction: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the angle [B] in rad that is added to the leg's direction, and the memory.

        Args:
            error: cross-track error [B] in m, positive to starboard of the leg.
            direction: of the leg [B] in rad.
            s: memory [B, n_state], zeros at the start.
        """


@final
class LookAhead(LineOfSight):
    """Steering for the point of the leg a distance ahead of the vessel: -atan(error / distance).

    Source: T. I. Fossen, Handbook of Marine Craft Hydrodynamics and Motion Control, section 12.3.

    Args:
        distance: along the leg in m.
    """

    def __init__(self, distance: float) -> None:
        super().__init__()
        self.distance = distance

    def forward(self, error: Tensor, direction: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the angle [B]; never a right angle."""
        return -torch.atan(error / self.distance), s


@final
class Enclosure(LineOfSight):
    """Steering for the forward point where a circle about the vessel meets the leg.

    The angle is -asin(error / radius) (Fossen, section 12.3).

    Further from the leg than the radius there is none; the vessel then steers straight for the leg.

    Args:
        radius: of the circle in m.
    """

    def __init__(self, radius: float) -> None:
        super().__init__()
        self.radius = radius

    def forward(self, error: Tensor, direction: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the angle [B]; a right angle from the radius on."""
        return -torch.asin((error / self.radius).clamp(-1.0, 1.0)), s


@final
class IntegralLookAhead(LineOfSight):
    """Look-ahead steering with the crab angle that a steady current needs.

    The angle is -atan(error / distance + D).

    Memory [B, 2]: of `DriftEstimate`, whose D across the leg this is.

    Args:
        distance: along the leg in m.
        gain: of the estimate in m/s.
        dt: step of the guidance in s.
    """

    def __init__(self, distance: float, gain: float, dt: float) -> None:
        super().__init__()
        self.drift = DriftEstimate(distance, gain, dt)
        self.distance = distance
        self.n_state = 2

    def forward(self, error: Tensor, direction: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the angle [B]; never a right angle."""
        return -torch.atan(error / self.distance + self.drift.across(direction, s)), self.drift(
            error, direction, s
        )


class LookAheadConfig(Config):
    """Look-ahead-based line of sight.

    Attributes:
        distance: along the leg.
    """

    kind: Literal["lookahead"] = "lookahead"
    distance: Metres = Field(gt=0)

    def build(self, dt: float) -> LineOfSight:
        """Return the law, for steps of dt seconds."""
        return LookAhead(self.distance)


class EnclosureConfig(Config):
    """Enclosure-based line of sight.

    Attributes:
        radius: of the circle about the vessel.
    """

    kind: Literal["enclosure"] = "enclosure"
    radius: Metres = Field(gt=0)

    def build(self, dt: float) -> LineOfSight:
        """Return the law, for steps of dt seconds."""
        return Enclosure(self.radius)


class IntegralLookAheadConfig(Config):
    """Look-ahead-based line of sight with integral action against a steady current.

    Attributes:
        distance: along the leg.
        gain: sigma of the integral action, below speed less current; a quarter of the speed returns
            to a leg without overshoot.
    """

    kind: Literal["integral"] = "integral"
    distance: Metres = Field(gt=0)
    gain: MetresPerSecond = Field(gt=0)

    def build(self, dt: float) -> LineOfSight:
        """Return the law, for steps of dt seconds."""
        return IntegralLookAhead(self.distance, self.gain, dt)


AnyLineOfSight = Annotated[
    LookAheadConfig | EnclosureConfig | IntegralLookAheadConfig, Field(discriminator="kind")
]

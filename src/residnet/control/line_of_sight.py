"""Laws of the line of sight: how a vessel aside of a straight leg steers back to it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Annotated, Literal, final

import torch
from pydantic import Field
from torch import Tensor, nn

from residnet.core.config import Config, Metres


class LineOfSight(nn.Module, ABC):
    """The angle between a leg and the course that is steered."""

    @abstractmethod
    def forward(self, error: Tensor) -> Tensor:
        """Angle [B] in rad, added to the leg's direction, from the cross-track error [B] in m, positive to starboard of the leg."""


@final
class LookAhead(LineOfSight):
    """Towards the point of the leg that lies a distance before the vessel: -atan(error / distance) (T. I. Fossen, Handbook of Marine Craft
    Hydrodynamics and Motion Control, section 12.3).

    Args:
        distance: along the leg in m.
    """

    def __init__(self, distance: float) -> None:
        super().__init__()
        self.distance = distance

    def forward(self, error: Tensor) -> Tensor:
        """Angle [B]; never a right angle."""
        return -torch.atan(error / self.distance)


@final
class Enclosure(LineOfSight):
    """Towards the forward one of the points where a circle about the vessel meets the leg: -asin(error / radius) (Fossen, section 12.3).

    Further from the leg than the radius there is none; the vessel then steers straight for the leg.

    Args:
        radius: of the circle in m.
    """

    def __init__(self, radius: float) -> None:
        super().__init__()
        self.radius = radius

    def forward(self, error: Tensor) -> Tensor:
        """Angle [B]; a right angle from the radius on."""
        return -torch.asin((error / self.radius).clamp(-1.0, 1.0))


class LookAheadConfig(Config):
    """Look-ahead-based line of sight.

    Attributes:
        distance: along the leg.
    """

    kind: Literal["lookahead"] = "lookahead"
    distance: Metres = Field(gt=0)

    def build(self) -> LineOfSight:
        """The law."""
        return LookAhead(self.distance)


class EnclosureConfig(Config):
    """Enclosure-based line of sight.

    Attributes:
        radius: of the circle about the vessel.
    """

    kind: Literal["enclosure"] = "enclosure"
    radius: Metres = Field(gt=0)

    def build(self) -> LineOfSight:
        """The law."""
        return Enclosure(self.radius)


AnyLineOfSight = Annotated[LookAheadConfig | EnclosureConfig, Field(discriminator="kind")]

"""Laws of the line of sight: how a vessel aside of a straight leg steers back to it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Annotated, Literal, final

import torch
from pydantic import Field
from torch import Tensor, nn

from residnet.core.config import Config, Metres, MetresPerSecond
from residnet.core.errors import ConfigError

_MOST = 1.0
"""Tangent of the largest crab angle."""


@final
class DriftEstimate(nn.Module):
    """An estimate of how a steady current sets the vessel across its way.

    It is the integral of E. Borhaug, A. Pavlov and K. Y. Pettersen (Integral LOS control for path
    following of underactuated marine surface vessels in the presence of constant ocean currents,
    CDC 2008; T. I. Fossen, Handbook of Marine Craft Hydrodynamics and Motion Control, section
    12.3).

    heading_d = direction - atan(e / distance + D), dD/dt = gain e / (distance^2 + (e + distance
    D)^2), their D being sigma e_int / distance. At rest e = 0 and D is the tangent of the crab
    angle asin(V_c / U) for a current V_c across the way of a vessel at speed U.

    A current keeps its direction over ground while the way bends. So D is kept as a vector, north
    and east, that only its part across the way steers by and that grows only there: what one leg
    has taught is known on the next.

    Memory s [B, 2]: the vector, at most one long.

    Args:
        distance: look-ahead in m.
        gain: sigma in m/s. With a quarter of the speed both poles of the error lie at U / (2
            distance).
        dt: step in s.

    Raises:
        ConfigError: where one of them is not above zero.
    """

    def __init__(self, distance: float, gain: float, dt: float) -> None:
        super().__init__()
        if distance <= 0 or gain <= 0 or dt <= 0:
            raise ConfigError(
                "integral line of sight: distance, gain and step must be above zero, given"
                f" {distance:g} m, {gain:g} m/s, {dt:g} s"
            )
        self.distance, self.gain, self.dt = distance, gain, dt
        self.most = _MOST

    def across(self, direction: Tensor, s: Tensor) -> Tensor:
        """Return the part [B] to starboard of a direction [B] in rad."""
        return torch.cos(direction) * s[:, 1] - torch.sin(direction) * s[:, 0]

    def along(self, direction: Tensor, s: Tensor) -> Tensor:
        """Return the part [B] along a direction [B] in rad."""
        return torch.cos(direction) * s[:, 0] + torch.sin(direction) * s[:, 1]

    def forward(self, error: Tensor, direction: Tensor, s: Tensor) -> Tensor:
        """Return the memory after a step.

        Args:
            s: memory [B, 2].
            error: cross-track error [B] in m.
            direction: of the way [B] in rad.
        """
        aim = error + self.distance * self.across(direction, s)
        grown = self.dt * self.gain * error / (self.distance**2 + aim.square())
        s = s + grown.unsqueeze(-1) * torch.stack(
            (-torch.sin(direction), torch.cos(direction)), dim=-1
        )
        return s / (s.square().sum(dim=-1, keepdim=True).sqrt() / self.most).clamp(min=1.0)


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

"""Rudders and propellers of the patrol vessel: foils in the race, or linear in the angle.

Source: document 004, section 5.2.2.3.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Literal, final

import torch
from pydantic import Field
from torch import Tensor

from residnet.core.config import Metres, Newtons, Radians, RadiansPerSecond
from residnet.physics.actuators.base import ActuatorConfig, Actuators
from residnet.physics.actuators.servo import ServoConfig, Servos
from residnet.physics.parameters import Density, SquareMetres


class SternRuddersConfig(ServoConfig, ActuatorConfig, ABC):
    """Rudders that move together behind propellers whose thrust is commanded.

    Attributes:
        limit: largest rudder angle of either side.
        rate: of the steering gear; None where the rudder stands at its command at once.
        x: place of the rudders' centre of pressure ahead of the body origin in m; negative aft.
        z: the same below the body origin in m.
        thrust: of all propellers together at full drive; the source knows no astern thrust, so
            commands hold between zero and this.
    """

    limit: Radians = Field(gt=0, lt=1.5707)
    rate: RadiansPerSecond | None = Field(default=None, gt=0)
    x: Metres = Field(lt=0)
    z: Metres
    thrust: Newtons = Field(gt=0)


class SternRudders(Actuators, ABC):
    """The forces tau [..., 4] along x, y and about x, z of rudders and propellers at the stern.

    Commands are cmd_delta [rad] and cmd_thrust [N]; delta [rad] is a state where the rudder has a
    rate.

    delta > 0 turns to starboard: Y = -L, K = z L, N = -x L, X = T - D (document 004 eqs.
    (5.26)-(5.29), signs as in corrections G9, G10).
    """

    commands = ("cmd_delta", "cmd_thrust")

    def __init__(self, config: SternRuddersConfig) -> None:
        super().__init__()
        self.servos = Servos([config.follow("delta", config.limit, config.rate)])
        self.state = self.servos.state
        self.delta_max, self.thrust_max = config.limit, config.thrust
        self.x, self.z = config.x, config.z

    @abstractmethod
    def foil(self, delta: Tensor, u: Tensor, v: Tensor, thrust: Tensor) -> tuple[Tensor, Tensor]:
        """Return the lift and drag [...] in N of all rudders.

        Args:
            delta: rudder angle [...] in rad.
            u: surge velocity through the water [...] in m/s.
            v: sway velocity through the water [...] in m/s.
            thrust: of all propellers [...] in N.
        """

    @final
    def demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return rudder angle and thrust [..., 2] for steer and drive, shares of their limits.

        There is no thrust astern.

        No thrust astern.
        """
        return torch.stack(
            (steer.clamp(-1.0, 1.0) * self.delta_max, drive.clamp(0.0, 1.0) * self.thrust_max),
            dim=-1,
        )

    @final
    def force(self, a: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        """Return tau [..., 4] in N, N, N m, N m."""
        delta = self.servos.value(a, command[..., :1])[..., 0]
        thrust = command[..., 1].clamp(0.0, self.thrust_max)
        lift, drag = self.foil(delta, nu[..., 0], nu[..., 1], thrust)
        return torch.stack((thrust - drag, -lift, self.z * lift, -self.x * lift), dim=-1)

    @final
    def rate(self, a: Tensor, command: Tensor) -> Tensor:
        """Return the derivative [..., k] of the states."""
        return self.servos.rate(a, command[..., :1])

    @final
    def advance(self, a: Tensor, command: Tensor, dt: float) -> Tensor:
        """Return the states [..., k] after a step of dt seconds."""
        return self.servos.advance(a, command[..., :1], dt)


class FoilRuddersConfig(SternRuddersConfig):
    """Rudders as foils (document 004 eqs. (5.20)-(5.25), corrections G8, G11).

    Attributes:
        rudders: how many rudders share the lift evenly.
        propellers: how many propellers share the thrust evenly.
        area: of one rudder.
        aspect_ratio: effective, of the induced drag C_L^2 / (0.9 pi a).
        lift_slope: dC_L/d alpha per rad.
        stall: angle of attack beyond which lift and drag grow no more.
        diameter: of a propeller.
        density: of the water.
    """

    kind: Literal["foil_rudders"] = "foil_rudders"
    rudders: int = Field(gt=0)
    area: SquareMetres = Field(gt=0)
    aspect_ratio: float = Field(gt=0)
    lift_slope: float = Field(gt=0)
    stall: Radians = Field(gt=0, lt=1.5707)
    propellers: int = Field(gt=0)
    diameter: Metres = Field(gt=0)
    density: Density = Field(gt=0)

    def build(self) -> FoilRudders:
        """Build the module that turns commands into forces."""
        return FoilRudders(self)


@final
class FoilRudders(SternRudders):
    """Rudders as foils in the open water's speed, corrected for the propellers' race.

    The drag at zero angle belongs to the hull's calm-water resistance.
    """

    def __init__(self, config: FoilRuddersConfig) -> None:
        super().__init__(config)
        self.slope, self.stall = config.lift_slope, config.stall
        self.pressure = 0.5 * config.density * config.area * config.rudders
        self.induced = 1.0 / (0.9 * math.pi * config.aspect_ratio)
        disc = 0.25 * math.pi * config.diameter**2
        # C_Th V^2 per newton of total thrust: each propeller has its share
        self.loading = 2.0 / (config.propellers * config.density * disc)

    def foil(self, delta: Tensor, u: Tensor, v: Tensor, thrust: Tensor) -> tuple[Tensor, Tensor]:
        """Return the lift and drag [...] in N."""
        angle = delta.clamp(-self.stall, self.stall)
        square = u * u + v * v
        # 1/sqrt(1 + C_Th); the offset keeps it and its gradient finite at rest
        share = torch.sqrt((square + 1e-20) / (square + self.loading * thrust + 1e-20))
        race = thrust * (1.0 + share)
        coefficient = self.slope * angle
        flow = self.pressure * square
        lift = flow * coefficient + race * torch.sin(angle)
        drag = flow * self.induced * coefficient * coefficient + race * (1.0 - torch.cos(angle))
        return lift, drag


class LinearRuddersConfig(SternRuddersConfig):
    """Rudders whose side force is Y_delta_uu u^2 delta, without drag and race.

    Source: document 004, Table 5.3.

    Attributes:
        Y_delta_uu: of all rudders together, in kg/m per rad.
    """

    kind: Literal["linear_rudders"] = "linear_rudders"
    Y_delta_uu: float = Field(gt=0)

    def build(self) -> LinearRudders:
        """Build the module that turns commands into forces."""
        return LinearRudders(self)


@final
class LinearRudders(SternRudders):
    """Rudders whose lift is proportional to u^2 delta."""

    def __init__(self, config: LinearRuddersConfig) -> None:
        super().__init__(config)
        self.slope = config.Y_delta_uu

    def foil(self, delta: Tensor, u: Tensor, v: Tensor, thrust: Tensor) -> tuple[Tensor, Tensor]:
        """Return the lift and no drag [...] in N."""
        return self.slope * u * u * delta, torch.zeros_like(delta)

"""One propeller with a rudder behind it, or with the rudder outside its race."""

from __future__ import annotations

from typing import Literal, final

import torch
from pydantic import Field, model_validator
from torch import Tensor

from residnet.core.config import Metres, Radians, RadiansPerSecond, RevRate, RevsPerSecond
from residnet.physics.actuators.base import ActuatorConfig, Actuators
from residnet.physics.actuators.servo import ServoConfig, Servos
from residnet.physics.actuators.thrust_curve import (
    Coefficients,
    CurveRange,
    ThrustCurve,
    require_range,
)
from residnet.physics.parameters import Density, SquareMetres


class RudderConfig(ServoConfig):
    """A rudder with its steering gear.

    Attributes:
        area: movable area.
        aspect_ratio: height over mean chord; the slope of the normal force is 6.13 L / (L + 2.25)
            (Fujii).
        x: of the rudder stock from the body origin, negative aft.
        limit: largest angle of either side.
        rate: of the steering gear; None for no limit.
        race_share: share of the area in the propeller's race; 0 for a force that grows with u^2
            alone.
        straightening: share of the local drift angle that reaches the rudder; 0 for a rudder that
            sees the flow from ahead only.
    """

    area: SquareMetres = Field(gt=0)
    aspect_ratio: float = Field(gt=0)
    x: Metres = Field(lt=0)
    limit: Radians = Field(gt=0, lt=1.5707)
    rate: RadiansPerSecond | None = Field(default=None, gt=0)
    race_share: float = Field(default=0.0, ge=0, le=1)
    straightening: float = Field(default=1.0, ge=0, le=1)


class PropellerConfig(ServoConfig):
    """A propeller on its shaft.

    Attributes:
        diameter: of the disc.
        forward: coefficients c0 [N], c1 [N s], c2 [N s^2] of the thrust c0 + c1 n + c2 n^2 at
            standstill for n > 0 [1/s]; it never opposes the rotation.
        reverse: coefficients for n < 0.
        curve_range: revolutions (astern, ahead) that these were measured between; they must include
            +-n_max.
        n_max: largest revolutions of either direction; commands beyond it saturate.
        n_rate: rate limit of the shaft; None for no limit.
        advance_loss: thrust lost per revolution and speed, T = curve - advance_loss |n| u [N
            s^2/m], u >= 0; K_T falls linearly.
        thrust_deduction: share t of the thrust that the hull takes back.
    """

    diameter: Metres = Field(gt=0)
    forward: Coefficients
    reverse: Coefficients
    curve_range: CurveRange | None = None
    n_max: RevsPerSecond = Field(gt=0)
    n_rate: RevRate | None = Field(default=None, gt=0)
    advance_loss: float = Field(default=0.0, ge=0)
    thrust_deduction: float = Field(default=0.0, ge=0, lt=1)

    @model_validator(mode="after")
    def _range(self) -> PropellerConfig:
        require_range(self)
        return self


class RudderPropellerConfig(ActuatorConfig):
    """A propeller and a rudder, without hull interaction.

    Normal force and inflow are those of the MMG standard method (Yasukawa and Yoshimura 2015).

    F_N = 0.5 rho A f sin(delta_e) U_R^2, X = -F_N sin delta, Y = -F_N cos delta, N = x Y; delta > 0
    turns to starboard. The inflow is U_R^2 = u|u| + race_share 2 T / (rho A_p): the race of an
    actuator disc, fully contracted.

    Attributes:
        rudder: the rudder.
        propeller: the propeller.
        density: of the water in kg/m^3.
    """

    kind: Literal["rudder_propeller"] = "rudder_propeller"
    rudder: RudderConfig
    propeller: PropellerConfig
    density: Density = Field(default=1025.0, gt=0)

    def build(self) -> RudderPropeller:
        """Build the module that turns commands into forces."""
        return RudderPropeller(self)


@final
class RudderPropeller(Actuators):
    """The forces tau [..., 3] of a propeller and a rudder.

    Commands are cmd_delta [rad] and cmd_n [1/s]; states are delta and n where they do not follow at
    once.
    """

    commands = ("cmd_delta", "cmd_n")

    def __init__(self, config: RudderPropellerConfig) -> None:
        super().__init__()
        rudder, propeller = config.rudder, config.propeller
        self.servos = Servos(
            [
                rudder.follow("delta", rudder.limit, rudder.rate),
                propeller.follow("n", propeller.n_max, propeller.n_rate),
            ]
        )
        self.state = self.servos.state
        self.curve = ThrustCurve(propeller.forward, propeller.reverse)
        self.delta_max, self.n_max, self.x = rudder.limit, propeller.n_max, rudder.x
        self.lift = (
            0.5
            * config.density
            * rudder.area
            * 6.13
            * rudder.aspect_ratio
            / (rudder.aspect_ratio + 2.25)
        )
        self.race = (
            rudder.race_share * 2.0 / (config.density * 0.25 * torch.pi * propeller.diameter**2)
        )
        self.straightening = rudder.straightening
        self.loss = propeller.advance_loss
        self.thrust_factor = 1.0 - propeller.thrust_deduction

    def demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return the rudder angle from steer and revolutions from drive, as shares of their limits.

        Steer to starboard is positive.
        """
        return torch.stack(
            (steer.clamp(-1.0, 1.0) * self.delta_max, drive.clamp(-1.0, 1.0) * self.n_max), dim=-1
        )

    def thrust(self, n: Tensor, u: Tensor) -> Tensor:
        """Return the thrust [N] of the propeller at n [1/s] and speed through the water u [m/s]."""
        thrust: Tensor = self.curve(n) - self.loss * n.abs() * u.clamp(min=0.0)
        return thrust

    def force(self, a: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        """Return tau [..., 3] in N, N, N m."""
        position = self.servos.value(a, command)
        delta, u = position[..., 0], nu[..., 0]
        thrust = self.thrust(position[..., 1], u)
        square = u * u.abs() + self.race * thrust.clamp(min=0.0)
        across = self.straightening * (nu[..., 1] + self.x * nu[..., 2])
        # the offset keeps the gradient finite at rest
        inflow = torch.sqrt(square.abs() + 1e-8)
        normal = self.lift * (square * torch.sin(delta) + inflow * across * torch.cos(delta))
        side = -normal * torch.cos(delta)
        return torch.stack(
            (self.thrust_factor * thrust - normal * torch.sin(delta), side, self.x * side), dim=-1
        )

    def rate(self, a: Tensor, command: Tensor) -> Tensor:
        """Return the derivative [..., k] of the states."""
        return self.servos.rate(a, command)

    def advance(self, a: Tensor, command: Tensor, dt: float) -> Tensor:
        """Return the states [..., k] after a step of dt seconds."""
        return self.servos.advance(a, command, dt)

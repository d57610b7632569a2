"""Water jets with a common nozzle angle and a common motor speed.

Source: document 000 eqs. (6.12)-(6.16), corrections H10 to H16.
"""

from __future__ import annotations

from typing import Annotated, Literal, final

import torch
from pydantic import AfterValidator, Field, field_validator
from torch import Tensor

from residnet.core.config import Config, Metres, Radians, RadiansPerSecond, RevRate, RevsPerSecond
from residnet.physics.actuators.base import ActuatorConfig, Actuators
from residnet.physics.actuators.servo import ServoConfig, Servos
from residnet.physics.parameters import Parameter, above_zero, of_dimension

Force = Annotated[Parameter, AfterValidator(of_dimension(1, 1, -2))]
ForcePerSpeed = Annotated[Parameter, AfterValidator(of_dimension(1, 0, -1))]
ForcePerSquaredSpeed = Annotated[Parameter, AfterValidator(of_dimension(1, -1, 0))]
Ratio = Annotated[Parameter, AfterValidator(of_dimension(0, 0, 0))]
PerRevolutions = Annotated[Parameter, AfterValidator(of_dimension(0, 0, 1))]
PerSquaredRevolutions = Annotated[Parameter, AfterValidator(of_dimension(0, 0, 2))]


class SpeedCurve(Config):
    """The thrust at reference revolutions over the speed through the water: a0 + a1 u + a2 u^2.

    Attributes:
        a0: thrust at rest in N.
        a1: slope in N s/m.
        a2: curvature in N s^2/m^2.
    """

    a0: Force
    a1: ForcePerSpeed
    a2: ForcePerSquaredSpeed


class RevolutionsCurve(Config):
    """The share of that thrust at n revolutions per second: (r0 + r1 n + r2 n^2) / reference.

    Attributes:
        r0: share at rest, dimensionless.
        r1: slope in s.
        r2: curvature in s^2.
        reference: value of the polynomial at the reference revolutions, dimensionless.
    """

    r0: Ratio
    r1: PerRevolutions
    r2: PerSquaredRevolutions
    reference: Ratio

    _positive = field_validator("reference")(above_zero)


class MotorConfig(ServoConfig):
    """The motor of each jet, which turns in one direction.

    Attributes:
        n_max: largest revolutions in 1/s.
        n_rate: largest change of revolutions in 1/s^2; None for at once.
    """

    n_max: RevsPerSecond = Field(gt=0)
    n_rate: RevRate | None = Field(default=None, gt=0)


class NozzleConfig(ServoConfig):
    """The nozzles that direct the jets.

    Attributes:
        limit: largest angle of either side in rad.
        rate: largest rate of turn in rad/s; None for at once.
    """

    limit: Radians = Field(gt=0, lt=1.5707)
    rate: RadiansPerSecond | None = Field(default=None, gt=0)


class WaterJetsConfig(ActuatorConfig):
    """Equal water jets that turn and run together.

    Commands are cmd_n [1/s] and cmd_nozzle [rad], whose thrust pushes to starboard where positive.

    Attributes:
        jets: how many there are.
        x: place of the nozzles ahead of the body origin; negative astern.
        speed: parabola of the thrust of one jet over the speed; its product with `revolutions` is
            the thrust (6.16), which may be negative below some revolutions (H15).
        revolutions: parabola of the thrust over the revolutions.
        motor: limits of the revolutions.
        nozzle: limits of the nozzle angle.
    """

    kind: Literal["water_jets"]
    jets: int = Field(gt=0)
    x: Metres
    speed: SpeedCurve
    revolutions: RevolutionsCurve
    motor: MotorConfig
    nozzle: NozzleConfig

    def build(self) -> WaterJets:
        """Build the module that turns commands into forces."""
        return WaterJets(self)


@final
class WaterJets(Actuators):
    """The forces tau [..., 3] of water jets from motor speed and nozzle angle."""

    commands = ("cmd_n", "cmd_nozzle")

    def __init__(self, config: WaterJetsConfig) -> None:
        super().__init__()
        motor, nozzle = config.motor, config.nozzle
        self.servos = Servos(
            [
                motor.follow("n", motor.n_max, motor.n_rate),
                nozzle.follow("nozzle", nozzle.limit, nozzle.rate),
            ]
        )
        self.state = self.servos.state
        self.n_max = motor.n_max
        self.angle = nozzle.limit
        self.jets = float(config.jets)
        self.x = config.x
        speed, revolutions = config.speed, config.revolutions
        self.a = [p.value for p in (speed.a0, speed.a1, speed.a2)]
        self.c = [
            p.value / revolutions.reference.value
            for p in (revolutions.r0, revolutions.r1, revolutions.r2)
        ]

    def thrust(self, n: Tensor, u: Tensor) -> Tensor:
        """Return the thrust [N] of one jet at revolutions n [1/s] and speed u [m/s], any shape.

        Source: document 000 eq. (6.16).
        """
        a, c = self.a, self.c
        return (a[0] + u * (a[1] + u * a[2])) * (c[0] + n * (c[1] + n * c[2]))

    def demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return the commands [..., 2] for drive and steer.

        Drive ahead is the share of the motor's revolutions (jets do not push astern), steer the yaw
        moment's sense.
        """
        side = self.angle if self.x > 0 else -self.angle
        return torch.stack(
            (drive.clamp(0.0, 1.0) * self.n_max, steer.clamp(-1.0, 1.0) * side), dim=-1
        )

    def force(self, a: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        """Return tau [..., 3] in N, N, N m (6.12)-(6.14)."""
        state = self.servos.value(a, self._ahead(command))
        total = self.jets * self.thrust(state[..., 0], nu[..., 0])
        across = total * torch.sin(state[..., 1])
        return torch.stack((total * torch.cos(state[..., 1]), across, self.x * across), dim=-1)

    def rate(self, a: Tensor, command: Tensor) -> Tensor:
        """Return the derivative [..., k] of the states."""
        return self.servos.rate(a, self._ahead(command))

    def advance(self, a: Tensor, command: Tensor, dt: float) -> Tensor:
        """Return the states [..., k] after a step of dt seconds."""
        return self.servos.advance(a, self._ahead(command), dt)

    def _ahead(self, command: Tensor) -> Tensor:
        """Return the commands [..., 2] without negative revolutions."""
        return torch.stack((command[..., 0].clamp(min=0.0), command[..., 1]), dim=-1)

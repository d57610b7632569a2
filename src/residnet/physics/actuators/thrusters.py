"""Any number of fixed thrusters anywhere on the hull."""

from __future__ import annotations

from typing import Annotated, Literal, final

import torch
from pydantic import Field, model_validator
from torch import Tensor

from residnet.core.config import Metres, Radians, RevRate, RevsPerSecond
from residnet.physics.actuators.base import ActuatorConfig, Actuators
from residnet.physics.actuators.servo import ServoConfig, Servos
from residnet.physics.actuators.thrust_curve import (
    Coefficients,
    CurveRange,
    ThrustCurve,
    require_range,
)


class ThrusterConfig(ServoConfig):
    """One fixed thruster of several.

    Attributes:
        name: ends its channels, n_<name> and cmd_<name>, for example `port`.
        x: place ahead of the body origin in m.
        y: place to starboard of the body origin in m.
        angle: of its thrust from the bow, clockwise; 90 deg for a bow thruster that pushes to
            starboard.
        n_max: largest revolutions of either direction in 1/s; commands beyond it saturate.
        n_rate: rate limit of the shaft in 1/s^2; None for no limit.
        forward: coefficients c0 [N], c1 [N s], c2 [N s^2] of the thrust for n > 0.
        reverse: coefficients for n < 0.
        curve_range: revolutions (astern, ahead) in 1/s that the curves were measured between; they
            must include +-n_max.
    """

    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$")
    x: Metres = 0.0
    y: Metres = 0.0
    angle: Radians = 0.0
    n_max: RevsPerSecond = Field(gt=0)
    n_rate: RevRate | None = Field(default=None, gt=0)
    forward: Coefficients
    reverse: Coefficients
    curve_range: CurveRange | None = None

    @model_validator(mode="after")
    def _range(self) -> ThrusterConfig:
        require_range(self)
        return self


class ThrustersConfig(ActuatorConfig):
    """Fixed thrusters anywhere on the hull.

    Drive turns all of them ahead as far as they push forward, steer those with a lever about the
    origin.

    Attributes:
        thrusters: the thrusters, in the order of the commands.
    """

    kind: Literal["thrusters"] = "thrusters"
    thrusters: Annotated[tuple[ThrusterConfig, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _names(self) -> ThrustersConfig:
        names = [thruster.name for thruster in self.thrusters]
        if repeated := [name for name in names if names.count(name) > 1]:
            raise ValueError(f"two thrusters are named '{repeated[0]}'")
        return self

    def build(self) -> Thrusters:
        """Build the module that turns commands into forces."""
        return Thrusters(self)


@final
class Thrusters(Actuators):
    """Revolutions of each thruster -> tau [..., 3]."""

    def __init__(self, config: ThrustersConfig) -> None:
        super().__init__()
        units = config.thrusters
        self.commands = tuple(f"cmd_{unit.name}" for unit in units)
        self.servos = Servos(
            [unit.follow(f"n_{unit.name}", unit.n_max, unit.n_rate) for unit in units]
        )
        self.state = self.servos.state
        self.curves = torch.nn.ModuleList(
            [ThrustCurve(unit.forward, unit.reverse) for unit in units]
        )
        angle = torch.tensor([unit.angle for unit in units], dtype=torch.float64)
        x, y = (
            torch.tensor([getattr(unit, axis) for unit in units], dtype=torch.float64)
            for axis in ("x", "y")
        )
        along, across = torch.cos(angle), torch.sin(angle)
        lever = x * across - y * along
        self.register_buffer("map", torch.stack((along, across, lever), dim=-1), persistent=False)
        self.register_buffer(
            "ahead",
            torch.where(along.abs() < 1e-9, torch.zeros_like(along), along),
            persistent=False,
        )
        self.register_buffer(
            "turn",
            torch.where(lever.abs() < 1e-9, torch.zeros_like(lever), torch.sign(lever)),
            persistent=False,
        )
        self.register_buffer(
            "n_max",
            torch.tensor([unit.n_max for unit in units], dtype=torch.float64),
            persistent=False,
        )
        self.map: Tensor
        self.ahead: Tensor
        self.turn: Tensor
        self.n_max: Tensor

    def demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return the revolutions [..., c]: each thruster's share of drive and steer, within +-1."""
        both = drive.unsqueeze(-1) * self.ahead.to(drive.dtype) + steer.unsqueeze(
            -1
        ) * self.turn.to(drive.dtype)
        return both.clamp(-1.0, 1.0) * self.n_max.to(drive.dtype)

    def force(self, a: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        """Return tau [..., 3] in N, N, N m."""
        n = self.servos.value(a, command)
        thrust = torch.stack([curve(n[..., i]) for i, curve in enumerate(self.curves)], dim=-1)
        return thrust @ self.map.to(thrust.dtype)

    def rate(self, a: Tensor, command: Tensor) -> Tensor:
        """Return the derivative [..., k] of the states."""
        return self.servos.rate(a, command)

    def advance(self, a: Tensor, command: Tensor, dt: float) -> Tensor:
        """Return the states [..., k] after a step of dt seconds."""
        return self.servos.advance(a, command, dt)

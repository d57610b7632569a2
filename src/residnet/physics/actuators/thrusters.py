"""Thrusters: fixed ones, two side by side, azimuths with their allocation, or forces alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Literal, final

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor, nn

from residnet.core.config import (
    Config,
    Metres,
    NewtonMetres,
    Newtons,
    Radians,
    RadiansPerSecond,
    RevRate,
)
from residnet.physics.actuators.base import (
    ActuatorConfig,
    Actuators,
    CurveRange,
    FirstOrderConfig,
    ForceActuators,
    ImmediateConfig,
    SecondOrderConfig,
    Servo,
    ServoConfig,
    ShaftConfig,
    ThrustConfig,
    require_range,
)

_TABLE = 401
"""Points of the thrust curve from which its inverse starts; between them it is known to rise."""
_NEWTON_STEPS = 4
"""Steps of Newton's method; each doubles the digits that a line between two points has."""


def _different(names: Sequence[str]) -> None:
    if repeated := [name for name in names if names.count(name) > 1]:
        raise ValueError(f"two thrusters are named '{repeated[0]}'")


class PlaceConfig(Config):
    """The name and place of one thruster.

    Attributes:
        name: what ends the names of its channels, for example `port`.
        x: distance forward of the body origin in m.
        y: distance to starboard of the body origin in m.
    """

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9_]*$")
    x: Metres = 0.0
    y: Metres = 0.0


class ThrusterConfig(PlaceConfig, ShaftConfig, ThrustConfig):
    """One fixed thruster of several.

    Attributes:
        name: ends its channels, n_<name> and cmd_<name>.
        angle: of its thrust from the bow, clockwise; 90 deg for a bow thruster that pushes to
            starboard.
    """

    angle: Radians = 0.0


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
        _different([thruster.name for thruster in self.thrusters])
        return self

    def build(self) -> Thrusters:
        units = self.thrusters
        return Thrusters(units, [unit.servo(f"n_{unit.name}") for unit in units])


class DifferentialThrustConfig(ThrustConfig, ActuatorConfig):
    """Two fixed thrusters side by side (document 003 section 4.1; revolutions in 1/s).

    The thrust curve is clipped so that thrust never opposes the sense of rotation, which closes the
    jump that the printed polynomials have at zero (correction W5).

    Attributes:
        spacing: distance between the thrusters in m.
        n_rate: largest change of revolutions in 1/s^2.
    """

    kind: Literal["differential_thrust"] = "differential_thrust"
    spacing: Metres = Field(gt=0)
    n_rate: RevRate = Field(gt=0)

    def build(self) -> Thrusters:
        """Build the module of a thruster to port and one to starboard, in this order."""
        units = [
            ThrusterConfig(
                name=name, y=y, n_max=self.n_max, forward=self.forward, reverse=self.reverse
            )
            for name, y in (("port", -0.5 * self.spacing), ("stbd", 0.5 * self.spacing))
        ]
        return Thrusters(units, [units[0].follow(self.n_max, self.n_rate, "n_port", "n_stbd")])


@final
class ThrusterForces(nn.Module):
    """Revolutions n [..., c] of fixed thrusters in 1/s make forces tau [..., 3] in N, N, N m.

    Source: document 003 eqs. (6), (21), (22), clipped as in correction W5.
    """

    def __init__(self, units: Sequence[ThrusterConfig]) -> None:
        super().__init__()
        curves = torch.tensor([[u.forward, u.reverse] for u in units], dtype=torch.float64)
        self.curves = nn.Buffer(curves.permute(1, 2, 0).contiguous(), persistent=False)
        rows = [[unit.x, unit.y, unit.angle] for unit in units]
        x, y, angle = torch.tensor(rows, dtype=torch.float64).unbind(-1)
        along, across = torch.cos(angle), torch.sin(angle)
        lever = x * across - y * along
        self.map = nn.Buffer(torch.stack((along, across, lever), dim=-1), persistent=False)

    def thrust(self, n: Tensor) -> Tensor:
        """Return the thrusts [N] at revolutions n [..., c] in 1/s."""
        f, b = self.curves.to(n.dtype).unbind(0)
        ahead = (f[0] + n * (f[1] + n * f[2])).clamp(min=0.0)
        astern = (b[0] + n * (b[1] + n * b[2])).clamp(max=0.0)
        return torch.where(n > 0, ahead, torch.where(n < 0, astern, torch.zeros_like(n)))

    def forward(self, n: Tensor) -> Tensor:
        """Return tau [..., 3] of revolutions n [..., c]."""
        return self.thrust(n) @ self.map.to(n.dtype)


@final
class Thrusters(Actuators):
    """Fixed thrusters, each on a shaft of its own or on equal ones."""

    in_flow = False

    def __init__(self, units: Sequence[ThrusterConfig], servos: Sequence[Servo]) -> None:
        super().__init__(*servos)
        self.commands = tuple(f"cmd_{unit.name}" for unit in units)
        self.forces = ThrusterForces(units)
        along, _, lever = self.forces.map.unbind(-1)
        # what a thruster adds to surge and yaw as far as it does so at all
        wish = torch.stack((along, torch.sign(lever)))
        small = torch.stack((along, lever)).abs() < 1e-9
        n_max = torch.tensor([unit.n_max for unit in units], dtype=torch.float64)
        self.wish = nn.Buffer(torch.where(small, 0.0, wish), persistent=False)
        self.n_max = nn.Buffer(n_max, persistent=False)

    def demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return the revolutions [..., c]: each thruster's share of drive and steer, within +-1.

        Of two side by side these are mean and difference (document 003 eqs. (30), (31)).
        """
        both = torch.stack((drive, steer), dim=-1) @ self.wish.to(drive.dtype)
        return both.clamp(-1.0, 1.0) * self.n_max.to(drive.dtype)

    def force(self, a: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        force: Tensor = self.forces(self.positions(a, command))
        return force


class AzimuthConfig(ServoConfig):
    """The drive that turns a thruster to either side of the bow, not through its limit.

    Attributes:
        limit: largest angle from the bow in rad.
        rate: largest rate of turn in rad/s; None for at once.
    """

    limit: Radians = Field(default=math.pi, gt=0)
    rate: RadiansPerSecond | None = Field(default=None, gt=0)


class AzimuthThrustersConfig(ActuatorConfig):
    """Equal thrusters that turn, commanded by revolutions and angles.

    The commands are cmd_n_<name> [1/s], then cmd_alpha_<name> [rad] from the bow, clockwise.

    Attributes:
        places: of the thrusters.
        thrust: coefficients c0, c1, ... of the force T = c0 + c1 n + c2 n^2 + ... in N, n in 1/s.
        curve_range: revolutions (astern, ahead) that the curve was measured between; it must rise
            between +-n_max.
        shaft: limits of the revolutions.
        azimuth: limits of the angles.
    """

    kind: Literal["azimuth_thrusters"]
    places: Annotated[tuple[PlaceConfig, ...], Field(min_length=1)]
    thrust: Annotated[tuple[float, ...], Field(min_length=2)]
    curve_range: CurveRange | None = None
    shaft: ShaftConfig
    azimuth: AzimuthConfig = AzimuthConfig()

    @model_validator(mode="after")
    def _consistent(self) -> AzimuthThrustersConfig:
        _different([place.name for place in self.places])
        require_range(self.curve_range, self.shaft.n_max)
        n = np.linspace(-self.shaft.n_max, self.shaft.n_max, _TABLE)
        falling = n[np.polynomial.Polynomial(self.thrust).deriv()(n) <= 0]
        if len(falling):
            raise ValueError(
                f"thrust falls with the revolutions at {falling[0] * 60:.0f} rpm: a force has no"
                " one speed there; lower n_max"
            )
        if len({(place.x, place.y) for place in self.places}) == 1:
            raise ValueError(
                "thrusters at one place cannot make surge, sway and yaw independently; give two"
                " places"
            )
        return self

    def build(self) -> AzimuthThrusters:
        return AzimuthThrusters(self)


@final
class AzimuthThrusters(ForceActuators):
    """Revolutions and angles of k thrusters -> tau [..., 3] (document 002 eqs. (5.1), (5.2))."""

    def __init__(self, config: AzimuthThrustersConfig) -> None:
        shaft, azimuth = config.shaft, config.azimuth
        names = [place.name for place in config.places]
        super().__init__(
            shaft.servo(*(f"n_{name}" for name in names)),
            azimuth.follow(azimuth.limit, azimuth.rate, *(f"alpha_{name}" for name in names)),
        )
        self.commands = tuple(f"cmd_{kind}_{name}" for kind in ("n", "alpha") for name in names)
        self.count = len(names)
        self.coefficients = list(config.thrust)
        self.slope = [i * c for i, c in enumerate(config.thrust)][1:]
        # tau = map [3, 2k] of the components forward, then to starboard, of every thruster
        ones, zeros = [1.0] * self.count, [0.0] * self.count
        rows = [
            ones + zeros,
            zeros + ones,
            [-place.y for place in config.places] + [place.x for place in config.places],
        ]
        self.map = nn.Buffer(torch.tensor(rows, dtype=torch.float64), persistent=False)
        self.share = nn.Buffer(torch.linalg.pinv(self.map), persistent=False)
        grid = torch.linspace(-shaft.n_max, shaft.n_max, _TABLE, dtype=torch.float64)
        self.table = nn.Buffer(torch.stack((grid, self.thrust(grid))), persistent=False)
        self.strongest = float(self.table[1, -1])

    def thrust(self, n: Tensor) -> Tensor:
        """Return the force [N] of one thruster along its axis at revolutions n [1/s], any shape."""
        return _polynomial(self.coefficients, n)

    def revolutions(self, force: Tensor) -> Tensor:
        """Return the revolutions n [1/s] within +-n_max that make a force [N], any shape.

        Without gradient.
        """
        # Newton's method from a table of the curve, which rises, within the table's interval
        table = self.table.to(force.dtype)
        after = torch.searchsorted(table[1].contiguous(), force.contiguous())
        after = after.clamp(1, table.shape[1] - 1)
        low, high = table[0][after - 1], table[0][after]
        share = (force - table[1][after - 1]) / (table[1][after] - table[1][after - 1])
        n = low + share.clamp(0.0, 1.0) * (high - low)
        for _ in range(_NEWTON_STEPS):
            n = n - (self.thrust(n) - force) / _polynomial(self.slope, n)
            n = torch.minimum(torch.maximum(n, low), high)
        return n

    def allocate(self, tau: Tensor) -> Tensor:
        """Return the commands [..., 2k] that make forces tau [..., 3] with the least thrust.

        The sum of squared thrusts is smallest; thrusts beyond the largest saturate.
        """
        along, across = (tau @ self.share.to(tau.dtype).T).chunk(2, dim=-1)
        size = torch.hypot(along, across)
        angle = torch.where(size > 0, torch.atan2(across, along), torch.zeros_like(size))
        return torch.cat((self.revolutions(size.clamp(max=self.strongest)), angle), dim=-1)

    def demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return the commands [..., 2k] for drive and steer, each within +-1.

        Drive is surge force and steer the yaw moment, as shares of what the thrusters make
        together; each thruster saturates.
        """
        lever = self.map[2].abs().sum() / 2.0
        surge, yaw = drive.clamp(-1, 1) * self.count, steer.clamp(-1, 1) * lever.to(drive.dtype)
        both = torch.stack((surge, torch.zeros_like(drive), yaw), dim=-1)
        return self.allocate(both * self.strongest)

    def force(self, a: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        return self.asked(self.positions(a, command))

    def asked(self, command: Tensor) -> Tensor:
        n, angle = command.chunk(2, dim=-1)
        thrust = self.thrust(n)
        parts = torch.cat((thrust * torch.cos(angle), thrust * torch.sin(angle)), dim=-1)
        return parts @ self.map.to(parts.dtype).T


def _polynomial(coefficients: Sequence[float], x: Tensor) -> Tensor:
    """Return c0 + c1 x + c2 x^2 + ..., any shape."""
    out = torch.full_like(x, coefficients[-1])
    for c in coefficients[-2::-1]:
        out = c + x * out
    return out


class ForceCommandsConfig(ActuatorConfig):
    """The commands tau_x, tau_y [N], tau_n [N m], each within its limit.

    Attributes:
        x_max: largest surge force of either direction in N.
        y_max: largest sway force of either side in N.
        n_max: largest yaw moment of either side in N m.
        response: lag of the forces behind the commands; immediate by default.
    """

    kind: Literal["forces"] = "forces"
    x_max: Newtons = Field(gt=0)
    y_max: Newtons = Field(ge=0)
    n_max: NewtonMetres = Field(gt=0)
    response: Annotated[
        ImmediateConfig | FirstOrderConfig | SecondOrderConfig, Field(discriminator="kind")
    ] = ImmediateConfig()

    def build(self) -> ForceCommands:
        return ForceCommands(self)


@final
class ForceCommands(ForceActuators):
    """The forces tau [..., 3], which follow the saturated commands [..., 3].

    With a lag the states are the forces, then what else the response needs.
    """

    commands = ("tau_x", "tau_y", "tau_n")

    def __init__(self, config: ForceCommandsConfig) -> None:
        # a lag of second order may overshoot the limits of the commands
        servo = ServoConfig(response=config.response)
        super().__init__(
            servo.follow(math.inf, None, *(f"acting_{name}" for name in self.commands))
        )
        limit = torch.tensor([config.x_max, config.y_max, config.n_max], dtype=torch.float64)
        self.limit = nn.Buffer(limit, persistent=False)

    def demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return tau [..., 3] for drive (surge force) and steer (yaw moment), each within +-1."""
        both = torch.stack((drive, torch.zeros_like(drive), steer), dim=-1)
        return both.clamp(-1.0, 1.0) * self.limit.to(drive.dtype)

    def allocate(self, tau: Tensor) -> Tensor:
        return tau

    def asked(self, command: Tensor) -> Tensor:
        return command

    def force(self, a: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        return self.positions(a, command)

    def followed(self, command: Tensor) -> Tensor:
        limit = self.limit.to(command.dtype)
        return torch.maximum(torch.minimum(command, limit), -limit)


class VectoredThrusterConfig(PlaceConfig):
    """One of several fixed thrusters that push in any direction, its thrust commanded.

    Attributes:
        name: ends its command, cmd_thrust_<name>, in N.
        z: place below the body origin in m.
        push: direction of its force ahead, to starboard and down; made of length one.
    """

    z: Metres = 0.0
    push: tuple[float, float, float]


class VectoredThrustersConfig(ActuatorConfig):
    """Equal thrusters that push a vessel in all six degrees of freedom.

    Their drives follow the demanded thrust: the curve from current to thrust is inverted there.

    Attributes:
        thrusters: the thrusters, in the order of the commands.
        limit: largest thrust of each in either direction.
    """

    kind: Literal["vectored_thrusters"] = "vectored_thrusters"
    thrusters: Annotated[tuple[VectoredThrusterConfig, ...], Field(min_length=1)]
    limit: Newtons = Field(gt=0)

    @model_validator(mode="after")
    def _names(self) -> VectoredThrustersConfig:
        _different([thruster.name for thruster in self.thrusters])
        return self

    def build(self) -> VectoredThrusters:
        return VectoredThrusters(self)


@final
class VectoredThrusters(Actuators):
    """Thrusts T [..., c] in N make forces and moments tau [..., 6] = T map.

    Source: Fossen 2021, section 9.4 (thrust configuration matrix).
    """

    in_flow = False

    def __init__(self, config: VectoredThrustersConfig) -> None:
        names = [f"thrust_{one.name}" for one in config.thrusters]
        super().__init__(ServoConfig().follow(config.limit, None, *names))
        self.commands = tuple(f"cmd_{name}" for name in names)
        place = torch.tensor([[t.x, t.y, t.z] for t in config.thrusters], dtype=torch.float64)
        push = torch.tensor([t.push for t in config.thrusters], dtype=torch.float64)
        push = nn.functional.normalize(push, dim=-1)
        effect = torch.cat((push, torch.linalg.cross(place, push)), dim=-1)
        self.map = nn.Buffer(effect, persistent=False)
        # ahead, about the vertical and down, as far as a thruster does any of it
        wish = torch.stack((effect[:, 0], effect[:, 5], effect[:, 2]))
        wish = torch.where(wish.abs() < 1e-9, 0.0, torch.sign(wish)) * config.limit
        self.wish = nn.Buffer(wish[:2], persistent=False)
        self.diving = wish[2]

    def demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return the thrusts [..., c]: each thruster's share of drive and steer; servos limit."""
        return torch.stack((drive, steer), dim=-1) @ self.wish.to(drive.dtype)

    def force(self, a: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        return self.positions(a, command) @ self.map.to(command.dtype)

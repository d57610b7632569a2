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
    ActuatorSystem,
    CurveRange,
    FirstOrderConfig,
    ForceActuators,
    ImmediateConfig,
    SecondOrderConfig,
    Servo,
    ServoConfig,
    ShaftConfig,
    ThrustConfig,
    require_curve_covers_range,
)

_TABLE_POINTS = 401
"""Points of the thrust curve from which its inverse starts; between them it is known to rise."""
_NEWTON_STEPS = 4
"""Steps of Newton's method; each doubles the digits that a line between two points has."""


def _require_unique_names(names: Sequence[str]) -> None:
    if duplicates := [name for name in names if names.count(name) > 1]:
        raise ValueError(f"two thrusters are named '{duplicates[0]}'")


class ThrusterPositionConfig(Config):
    """The name and place of one thruster.

    Attributes:
        name: what ends the names of its channels, for example `port`.
        x: distance forward of the body origin in m.
        y: distance to starboard of the body origin in m.
    """

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9_]*$")
    x: Metres = 0.0
    y: Metres = 0.0


class ThrusterConfig(ThrusterPositionConfig, ShaftConfig, ThrustConfig):
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
    def _validate_names(self) -> ThrustersConfig:
        _require_unique_names([thruster.name for thruster in self.thrusters])
        return self

    def build(self) -> Thrusters:
        thrusters = self.thrusters
        return Thrusters(
            thrusters, [thruster.build_servo(f"n_{thruster.name}") for thruster in thrusters]
        )


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
        thrusters = [
            ThrusterConfig(
                name=name, y=y, n_max=self.n_max, forward=self.forward, reverse=self.reverse
            )
            for name, y in (("port", -0.5 * self.spacing), ("stbd", 0.5 * self.spacing))
        ]
        return Thrusters(
            thrusters,
            [thrusters[0].build_limited_servo(self.n_max, self.n_rate, "n_port", "n_stbd")],
        )


@final
class ThrusterForces(nn.Module):
    """Revolutions n [..., c] of fixed thrusters in 1/s make forces tau [..., 3] in N, N, N m.

    Source: document 003 eqs. (6), (21), (22), clipped as in correction W5.
    """

    def __init__(self, thrusters: Sequence[ThrusterConfig]) -> None:
        super().__init__()
        coefficient_table = torch.tensor(
            [[thruster.forward, thruster.reverse] for thruster in thrusters], dtype=torch.float64
        )
        self.curve_coefficients = nn.Buffer(
            coefficient_table.permute(1, 2, 0).contiguous(), persistent=False
        )
        geometry = [[thruster.x, thruster.y, thruster.angle] for thruster in thrusters]
        x, y, angle = torch.tensor(geometry, dtype=torch.float64).unbind(-1)
        surge_share = torch.cos(angle)
        sway_share = torch.sin(angle)
        lever = x * sway_share - y * surge_share
        self.thrust_configuration = nn.Buffer(
            torch.stack((surge_share, sway_share, lever), dim=-1), persistent=False
        )

    def thrust_at(self, n: Tensor) -> Tensor:
        """Return the thrusts [N] at revolutions n [..., c] in 1/s."""
        forward, reverse = self.curve_coefficients.to(n.dtype).unbind(0)
        forward_thrust = (forward[0] + n * (forward[1] + n * forward[2])).clamp(min=0.0)
        reverse_thrust = (reverse[0] + n * (reverse[1] + n * reverse[2])).clamp(max=0.0)
        return torch.where(
            n > 0, forward_thrust, torch.where(n < 0, reverse_thrust, torch.zeros_like(n))
        )

    def forward(self, n: Tensor) -> Tensor:
        """Return tau [..., 3] of revolutions n [..., c]."""
        return self.thrust_at(n) @ self.thrust_configuration.to(n.dtype)


@final
class Thrusters(ActuatorSystem):
    """Fixed thrusters, each on a shaft of its own or on equal ones."""

    depends_on_speed = False

    def __init__(self, thrusters: Sequence[ThrusterConfig], servos: Sequence[Servo]) -> None:
        super().__init__(*servos)
        self.command_names = tuple(f"cmd_{thruster.name}" for thruster in thrusters)
        self.thruster_forces = ThrusterForces(thrusters)
        surge_share, _, lever = self.thruster_forces.thrust_configuration.unbind(-1)
        # what a thruster adds to surge and yaw as far as it does so at all
        demand_map = torch.stack((surge_share, torch.sign(lever)))
        is_negligible = torch.stack((surge_share, lever)).abs() < 1e-9
        n_max = torch.tensor([thruster.n_max for thruster in thrusters], dtype=torch.float64)
        self.demand_map = nn.Buffer(torch.where(is_negligible, 0.0, demand_map), persistent=False)
        self.n_max = nn.Buffer(n_max, persistent=False)

    def commands_for_demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return the revolutions [..., c]: each thruster's share of drive and steer, within +-1.

        Of two side by side these are mean and difference (document 003 eqs. (30), (31)).
        """
        shares = torch.stack((drive, steer), dim=-1) @ self.demand_map.to(drive.dtype)
        return shares.clamp(-1.0, 1.0) * self.n_max.to(drive.dtype)

    def force(self, states: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        force: Tensor = self.thruster_forces(self.servo_positions(states, command))
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
    places: Annotated[tuple[ThrusterPositionConfig, ...], Field(min_length=1)]
    thrust: Annotated[tuple[float, ...], Field(min_length=2)]
    curve_range: CurveRange | None = None
    shaft: ShaftConfig
    azimuth: AzimuthConfig = AzimuthConfig()

    @model_validator(mode="after")
    def _validate_thrusters(self) -> AzimuthThrustersConfig:
        _require_unique_names([thruster_position.name for thruster_position in self.places])
        require_curve_covers_range(self.curve_range, self.shaft.n_max)
        n = np.linspace(-self.shaft.n_max, self.shaft.n_max, _TABLE_POINTS)
        decreasing = n[np.polynomial.Polynomial(self.thrust).deriv()(n) <= 0]
        if len(decreasing):
            raise ValueError(
                f"thrust falls with the revolutions at {decreasing[0] * 60:.0f} rpm: a force has no"
                " one speed there; lower n_max"
            )
        if (
            len({(thruster_position.x, thruster_position.y) for thruster_position in self.places})
            == 1
        ):
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
        shaft = config.shaft
        azimuth = config.azimuth
        names = [thruster_position.name for thruster_position in config.places]
        super().__init__(
            shaft.build_servo(*(f"n_{name}" for name in names)),
            azimuth.build_limited_servo(
                azimuth.limit, azimuth.rate, *(f"alpha_{name}" for name in names)
            ),
        )
        self.command_names = tuple(
            f"cmd_{quantity}_{name}" for quantity in ("n", "alpha") for name in names
        )
        self.n_thrusters = len(names)
        self.coefficients = list(config.thrust)
        self.slope_coefficients = [i * c for i, c in enumerate(config.thrust)][1:]
        # tau = map [3, 2k] of the components forward, then to starboard, of every thruster
        unit_row = [1.0] * self.n_thrusters
        zero_row = [0.0] * self.n_thrusters
        matrix_rows = [
            unit_row + zero_row,
            zero_row + unit_row,
            [-thruster_position.y for thruster_position in config.places]
            + [thruster_position.x for thruster_position in config.places],
        ]
        self.thrust_configuration = nn.Buffer(
            torch.tensor(matrix_rows, dtype=torch.float64), persistent=False
        )
        self.allocation_matrix = nn.Buffer(
            torch.linalg.pinv(self.thrust_configuration), persistent=False
        )
        revolutions_grid = torch.linspace(
            -shaft.n_max, shaft.n_max, _TABLE_POINTS, dtype=torch.float64
        )
        self.thrust_table = nn.Buffer(
            torch.stack((revolutions_grid, self.thrust_at(revolutions_grid))), persistent=False
        )
        self.max_thrust = float(self.thrust_table[1, -1])

    def thrust_at(self, n: Tensor) -> Tensor:
        """Return the force [N] of one thruster along its axis at revolutions n [1/s], any shape."""
        return _evaluate_polynomial(self.coefficients, n)

    def revolutions_for_thrust(self, force: Tensor) -> Tensor:
        """Return the revolutions n [1/s] within +-n_max that make a force [N], any shape.

        Without gradient.
        """
        # Newton's method from a table of the curve, which rises, within the table's interval
        thrust_table = self.thrust_table.to(force.dtype)
        upper_index = torch.searchsorted(thrust_table[1].contiguous(), force.contiguous())
        upper_index = upper_index.clamp(1, thrust_table.shape[1] - 1)
        lower = thrust_table[0][upper_index - 1]
        upper = thrust_table[0][upper_index]
        fraction = (force - thrust_table[1][upper_index - 1]) / (
            thrust_table[1][upper_index] - thrust_table[1][upper_index - 1]
        )
        n = lower + fraction.clamp(0.0, 1.0) * (upper - lower)
        for _ in range(_NEWTON_STEPS):
            n = n - (self.thrust_at(n) - force) / _evaluate_polynomial(self.slope_coefficients, n)
            n = torch.minimum(torch.maximum(n, lower), upper)
        return n

    def allocate(self, tau: Tensor) -> Tensor:
        """Return the commands [..., 2k] that make forces tau [..., 3] with the least thrust.

        The sum of squared thrusts is smallest; thrusts beyond the largest saturate.
        """
        thrust_x, thrust_y = (tau @ self.allocation_matrix.to(tau.dtype).T).chunk(2, dim=-1)
        thrust_magnitude = torch.hypot(thrust_x, thrust_y)
        angle = torch.where(
            thrust_magnitude > 0,
            torch.atan2(thrust_y, thrust_x),
            torch.zeros_like(thrust_magnitude),
        )
        return torch.cat(
            (self.revolutions_for_thrust(thrust_magnitude.clamp(max=self.max_thrust)), angle),
            dim=-1,
        )

    def commands_for_demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return the commands [..., 2k] for drive and steer, each within +-1.

        Drive is surge force and steer the yaw moment, as shares of what the thrusters make
        together; each thruster saturates.
        """
        lever = self.thrust_configuration[2].abs().sum() / 2.0
        surge_share = drive.clamp(-1, 1) * self.n_thrusters
        yaw_share = steer.clamp(-1, 1) * lever.to(drive.dtype)
        normalised_force = torch.stack((surge_share, torch.zeros_like(drive), yaw_share), dim=-1)
        return self.allocate(normalised_force * self.max_thrust)

    def force(self, states: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        return self.requested_force(self.servo_positions(states, command))

    def requested_force(self, command: Tensor) -> Tensor:
        n, angle = command.chunk(2, dim=-1)
        thrust = self.thrust_at(n)
        thrust_components = torch.cat(
            (thrust * torch.cos(angle), thrust * torch.sin(angle)), dim=-1
        )
        return thrust_components @ self.thrust_configuration.to(thrust_components.dtype).T


def _evaluate_polynomial(coefficients: Sequence[float], x: Tensor) -> Tensor:
    """Return c0 + c1 x + c2 x^2 + ..., any shape."""
    value = torch.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        value = coefficient + x * value
    return value


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

    command_names = ("tau_x", "tau_y", "tau_n")

    def __init__(self, config: ForceCommandsConfig) -> None:
        # a lag of second order may overshoot the limits of the commands
        servo = ServoConfig(response=config.response)
        super().__init__(
            servo.build_limited_servo(
                math.inf, None, *(f"acting_{name}" for name in self.command_names)
            )
        )
        limit = torch.tensor([config.x_max, config.y_max, config.n_max], dtype=torch.float64)
        self.limit = nn.Buffer(limit, persistent=False)

    def commands_for_demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return tau [..., 3] for drive (surge force) and steer (yaw moment), each within +-1."""
        shares = torch.stack((drive, torch.zeros_like(drive), steer), dim=-1)
        return shares.clamp(-1.0, 1.0) * self.limit.to(drive.dtype)

    def allocate(self, tau: Tensor) -> Tensor:
        return tau

    def requested_force(self, command: Tensor) -> Tensor:
        return command

    def force(self, states: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        return self.servo_positions(states, command)

    def servo_commands(self, command: Tensor) -> Tensor:
        limit = self.limit.to(command.dtype)
        return torch.maximum(torch.minimum(command, limit), -limit)


class VectoredThrusterConfig(ThrusterPositionConfig):
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
    def _validate_names(self) -> VectoredThrustersConfig:
        _require_unique_names([thruster.name for thruster in self.thrusters])
        return self

    def build(self) -> VectoredThrusters:
        return VectoredThrusters(self)


@final
class VectoredThrusters(ActuatorSystem):
    """Thrusts T [..., c] in N make forces and moments tau [..., 6] = T map.

    Source: Fossen 2021, section 9.4 (thrust configuration matrix).
    """

    depends_on_speed = False

    def __init__(self, config: VectoredThrustersConfig) -> None:
        names = [f"thrust_{thruster.name}" for thruster in config.thrusters]
        super().__init__(ServoConfig().build_limited_servo(config.limit, None, *names))
        self.command_names = tuple(f"cmd_{name}" for name in names)
        position = torch.tensor(
            [[thruster.x, thruster.y, thruster.z] for thruster in config.thrusters],
            dtype=torch.float64,
        )
        thrust_direction = torch.tensor(
            [thruster.push for thruster in config.thrusters], dtype=torch.float64
        )
        thrust_direction = nn.functional.normalize(thrust_direction, dim=-1)
        configuration = torch.cat(
            (thrust_direction, torch.linalg.cross(position, thrust_direction)), dim=-1
        )
        self.thrust_configuration = nn.Buffer(configuration, persistent=False)
        # ahead, about the vertical and down, as far as a thruster does any of it
        demand_rows = torch.stack((configuration[:, 0], configuration[:, 5], configuration[:, 2]))
        demand_rows = (
            torch.where(demand_rows.abs() < 1e-9, 0.0, torch.sign(demand_rows)) * config.limit
        )
        self.demand_map = nn.Buffer(demand_rows[:2], persistent=False)
        self.dive_commands = demand_rows[2]

    def commands_for_demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return the thrusts [..., c]: each thruster's share of drive and steer; servos limit."""
        return torch.stack((drive, steer), dim=-1) @ self.demand_map.to(drive.dtype)

    def force(self, states: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        return self.servo_positions(states, command) @ self.thrust_configuration.to(command.dtype)

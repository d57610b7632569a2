"""Thrusters: fixed, differential, azimuth with allocation, vectored, and commanded forces."""

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
"""Number of points of the table that initialises the inverse of the thrust curve."""
_NEWTON_STEPS = 4
"""Number of Newton steps of the inverse; each doubles the digits of the interpolation."""


def _require_unique_names(names: Sequence[str]) -> None:
    if duplicates := [name for name in names if names.count(name) > 1]:
        raise ValueError(f"two thrusters are named '{duplicates[0]}'")


class ThrusterPositionConfig(Config):
    """Name and position of a thruster.

    Attributes:
        name: suffix of the names of its channels, for example `port`.
        x: distance forward of the body origin in m.
        y: distance to starboard of the body origin in m.
    """

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9_]*$")
    x: Metres = 0.0
    y: Metres = 0.0


class ThrusterConfig(ThrusterPositionConfig, ShaftConfig, ThrustConfig):
    """Fixed thruster.

    Attributes:
        name: suffix of its channels n_<name> and cmd_<name>.
        angle: direction of positive thrust, clockwise from the bow; 90 deg for a bow thruster with
            thrust to starboard.
    """

    angle: Radians = 0.0


class ThrustersConfig(ActuatorConfig):
    """Fixed thrusters at any positions of the hull.

    Drive acts on each thruster in proportion to the surge component of its direction. Steer acts on
    it with the sign of its lever about the origin.

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
    """Two fixed thrusters for differential thrust (document 003 section 4.1).

    The thrust curve is clipped to the sign of the rotation, which removes the discontinuity of the
    published polynomials at zero (correction W5).

    Attributes:
        spacing: lateral distance between the thrusters in m.
        n_rate: maximum rate of change of the revolutions in 1/s^2.
    """

    kind: Literal["differential_thrust"] = "differential_thrust"
    spacing: Metres = Field(gt=0)
    n_rate: RevRate = Field(gt=0)

    def build(self) -> Thrusters:
        """Build the port and the starboard thruster, in this order."""
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
    """Forces tau [..., 3] in N, N, N m of fixed thrusters at revolutions n [..., c] in 1/s.

    Source: document 003 eqs. (6), (21), (22), clipped by correction W5.
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
        # moment arm about the vertical, r x f
        lever = x * sway_share - y * surge_share
        self.thrust_configuration = nn.Buffer(
            torch.stack((surge_share, sway_share, lever), dim=-1), persistent=False
        )

    def thrust_at(self, n: Tensor) -> Tensor:
        """Return the thrust [..., c] in N at revolutions n [..., c] in 1/s."""
        forward, reverse = self.curve_coefficients.to(n.dtype).unbind(0)
        forward_thrust = (forward[0] + n * (forward[1] + n * forward[2])).clamp(min=0.0)
        reverse_thrust = (reverse[0] + n * (reverse[1] + n * reverse[2])).clamp(max=0.0)
        return torch.where(
            n > 0, forward_thrust, torch.where(n < 0, reverse_thrust, torch.zeros_like(n))
        )

    def forward(self, n: Tensor) -> Tensor:
        """Return the forces tau [..., 3] at revolutions n [..., c]."""
        return self.thrust_at(n) @ self.thrust_configuration.to(n.dtype)


@final
class Thrusters(ActuatorSystem):
    """Fixed thrusters with their shafts."""

    depends_on_speed = False

    def __init__(self, thrusters: Sequence[ThrusterConfig], servos: Sequence[Servo]) -> None:
        super().__init__(*servos)
        self.command_names = tuple(f"cmd_{thruster.name}" for thruster in thrusters)
        self.thruster_forces = ThrusterForces(thrusters)
        surge_share, _, lever = self.thruster_forces.thrust_configuration.unbind(-1)
        # contribution of each thruster to surge and sign of its contribution to yaw; components at
        # the level of rounding, such as cos(90 deg), are zero
        demand_map = torch.stack((surge_share, torch.sign(lever)))
        is_negligible = torch.stack((surge_share, lever)).abs() < 1e-9
        n_max = torch.tensor([thruster.n_max for thruster in thrusters], dtype=torch.float64)
        self.demand_map = nn.Buffer(torch.where(is_negligible, 0.0, demand_map), persistent=False)
        self.n_max = nn.Buffer(n_max, persistent=False)

    def commands_for_demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return the revolutions [..., c] for drive and steer, limited to n_max.

        With differential thrust, drive is the mean and steer the difference of the revolutions
        (document 003 eqs. (30), (31)).
        """
        shares = torch.stack((drive, steer), dim=-1) @ self.demand_map.to(drive.dtype)
        return shares.clamp(-1.0, 1.0) * self.n_max.to(drive.dtype)

    def force(self, states: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        force: Tensor = self.thruster_forces(self.servo_positions(states, command))
        return force


class AzimuthConfig(ServoConfig):
    """Azimuth drive of a thruster, with a limited angle to either side of the bow.

    Attributes:
        limit: maximum angle from the bow in rad.
        rate: maximum azimuth rate in rad/s; None for no limit.
    """

    limit: Radians = Field(default=math.pi, gt=0)
    rate: RadiansPerSecond | None = Field(default=None, gt=0)


class AzimuthThrustersConfig(ActuatorConfig):
    """Equal azimuth thrusters, commanded by revolutions and angles.

    The commands are cmd_n_<name> [1/s], then cmd_alpha_<name> [rad] clockwise from the bow.

    Attributes:
        places: names and positions of the thrusters.
        thrust: coefficients c0, c1, ... of the thrust T = c0 + c1 n + c2 n^2 + ... in N, n in 1/s.
        curve_range: range of revolutions (astern, ahead) in which the curve was measured; it must
            increase between +-n_max.
        shaft: dynamics and limits of the revolutions.
        azimuth: dynamics and limits of the angles.
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
        # allocation inverts the thrust curve, which must therefore be monotonic
        n = np.linspace(-self.shaft.n_max, self.shaft.n_max, _TABLE_POINTS)
        decreasing = n[np.polynomial.Polynomial(self.thrust).deriv()(n) <= 0]
        if len(decreasing):
            raise ValueError(
                f"thrust decreases with the revolutions at {decreasing[0] * 60:.0f} rpm, so that"
                " its inverse is not unique; lower n_max"
            )
        if (
            len({(thruster_position.x, thruster_position.y) for thruster_position in self.places})
            == 1
        ):
            raise ValueError(
                "thrusters at one position cannot produce surge, sway and yaw independently; give"
                " two positions"
            )
        return self

    def build(self) -> AzimuthThrusters:
        return AzimuthThrusters(self)


@final
class AzimuthThrusters(ForceActuators):
    """Forces tau [..., 3] of k azimuth thrusters (document 002 eqs. (5.1), (5.2))."""

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
        """Return the thrust [N] of a thruster at revolutions n [1/s], any shape."""
        return _evaluate_polynomial(self.coefficients, n)

    def revolutions_for_thrust(self, force: Tensor) -> Tensor:
        """Return the revolutions n [1/s] within +-n_max of a thrust [N], any shape.

        The result has no gradient.
        """
        # Newton's method from linear interpolation in a table, bounded by the table interval
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
            # the bounds keep a step from leaving the interval of the table where the slope is small
            n = n - (self.thrust_at(n) - force) / _evaluate_polynomial(self.slope_coefficients, n)
            n = torch.minimum(torch.maximum(n, lower), upper)
        return n

    def allocate(self, tau: Tensor) -> Tensor:
        """Return the commands [..., 2k] for forces tau [..., 3] by the pseudoinverse.

        The pseudoinverse minimizes the sum of squared thrusts; thrusts above the maximum saturate.
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

        Drive is the surge force and steer the yaw moment relative to their maximum values; each
        thruster saturates.
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
    """Evaluate c0 + c1 x + c2 x^2 + ..., any shape."""
    value = torch.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        value = coefficient + x * value
    return value


class ForceCommandsConfig(ActuatorConfig):
    """Commanded forces tau_x, tau_y [N] and moment tau_n [N m] with limits.

    Attributes:
        x_max: maximum surge force in either direction in N.
        y_max: maximum sway force to either side in N.
        n_max: maximum yaw moment to either side in N m.
        response: dynamic response of the forces; immediate by default.
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
    """Forces tau [..., 3] that follow saturated commands [..., 3].

    With a lag the states are the forces, then other states of the response.
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
        """Return commands [..., 3] for drive (surge force) and steer (yaw moment) within +-1."""
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
    """Fixed thruster with any direction of thrust, whose thrust is commanded.

    Attributes:
        name: suffix of its command cmd_thrust_<name> in N.
        z: distance below the body origin in m.
        push: direction of positive thrust (forward, starboard, down), normalised to length one.
    """

    z: Metres = 0.0
    push: tuple[float, float, float]


class VectoredThrustersConfig(ActuatorConfig):
    """Equal thrusters of a vessel in six degrees of freedom.

    The command is the thrust, because the motor drives invert the thrust curve.

    Attributes:
        thrusters: the thrusters, in the order of the commands.
        limit: maximum thrust of each thruster in either direction.
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
    """Forces and moments tau [..., 6] of vectored thrusters with thrust T [..., c] in N.

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
        # signs of the contributions to surge, yaw and heave; zero at the level of rounding
        demand_rows = torch.stack((configuration[:, 0], configuration[:, 5], configuration[:, 2]))
        demand_rows = (
            torch.where(demand_rows.abs() < 1e-9, 0.0, torch.sign(demand_rows)) * config.limit
        )
        self.demand_map = nn.Buffer(demand_rows[:2], persistent=False)
        self.dive_commands = demand_rows[2]

    def commands_for_demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return the commanded thrust [..., c] for drive and steer, before the limits."""
        return torch.stack((drive, steer), dim=-1) @ self.demand_map.to(drive.dtype)

    def force(self, states: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        return self.servo_positions(states, command) @ self.thrust_configuration.to(command.dtype)

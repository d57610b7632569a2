"""Thrusters: fixed, differential, azimuth with allocation, vectored, and commanded forces."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, final

import torch
from torch import Tensor, nn

from residnet.physics.actuators.base import ActuatorSystem, ForceActuators

if TYPE_CHECKING:
    from residnet.physics.actuators.config import ActuatorConfig
    from residnet.physics.actuators.thrusters_config import (
        AzimuthThrustersConfig,
        ForceCommandsConfig,
        ThrusterConfig,
        VectoredThrustersConfig,
    )

_TABLE_POINTS = 401
"""Number of points of the table that initialises the inverse of the thrust curve."""
_NEWTON_STEPS = 4
"""Number of Newton steps of the inverse; each doubles the digits of the interpolation."""


@final
class ThrusterForces(nn.Module):
    """Forces tau [..., 3] in N, N, N m of fixed thrusters at revolutions n [..., c] in 1/s.

    Source: Woo et al. 2018, eqs. (6), (21), (22). The thrust is clipped to the sign of n, because
    the printed polynomials jump at n = 0 (W5 in docs/documents/corrections.md).
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

    def __init__(self, thrusters: Sequence[ThrusterConfig], config: ActuatorConfig) -> None:
        super().__init__(*config.servo_specs())
        self.command_names = config.command_names()
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
        """Return the revolutions [..., c] for propulsion and steering commands, limited to n_max.

        With differential thrust, the propulsion command is the mean and the steering command the
        difference of the revolutions (Woo et al. 2018, eqs. (30), (31)).
        """
        shares = torch.stack((drive, steer), dim=-1) @ self.demand_map.to(drive.dtype)
        return shares.clamp(-1.0, 1.0) * self.n_max.to(drive.dtype)

    def force(self, states: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        force: Tensor = self.thruster_forces(self.servo_positions(states, command))
        return force


@final
class AzimuthThrusters(ForceActuators):
    """Forces tau [..., 3] of k azimuth thrusters (Jervan 2020, eqs. (5.1), (5.2))."""

    def __init__(self, config: AzimuthThrustersConfig) -> None:
        super().__init__(*config.servo_specs())
        self.command_names = config.command_names()
        self.n_thrusters = len(config.places)
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
        n_max = config.shaft.n_max
        revolutions_grid = torch.linspace(-n_max, n_max, _TABLE_POINTS, dtype=torch.float64)
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

        The pseudoinverse minimises the sum of squared thrusts; thrusts above the maximum saturate.
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
        """Return the commands [..., 2k] for the propulsion and steering commands, each within +-1.

        The propulsion command is the surge force and the steering command the yaw moment, relative
        to their maximum values; each thruster saturates.
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


@final
class ForceCommands(ForceActuators):
    """Forces tau [..., 3] that follow saturated commands [..., 3].

    With a lag the states are the forces, then other states of the response.
    """

    command_names = ("tau_x", "tau_y", "tau_n")

    def __init__(self, config: ForceCommandsConfig) -> None:
        super().__init__(*config.servo_specs())
        limit = torch.tensor([config.x_max, config.y_max, config.n_max], dtype=torch.float64)
        self.limit = nn.Buffer(limit, persistent=False)

    def commands_for_demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return commands [..., 3] for propulsion (surge force) and steering (yaw moment)."""
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


@final
class VectoredThrusters(ActuatorSystem):
    """Forces and moments tau [..., 6] of vectored thrusters with thrust T [..., c] in N.

    Source: Fossen 2021, section 9.4 (thrust configuration matrix).
    """

    depends_on_speed = False

    def __init__(self, config: VectoredThrustersConfig) -> None:
        super().__init__(*config.servo_specs())
        self.command_names = config.command_names()
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
        """Return the commanded thrust [..., c] for both commands, before the limits."""
        return torch.stack((drive, steer), dim=-1) @ self.demand_map.to(drive.dtype)

    def force(self, states: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        return self.servo_positions(states, command) @ self.thrust_configuration.to(command.dtype)

"""Plants: a vessel with its actuators and environment, as a right-hand side that a simulator steps."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import final

import torch
from torch import Tensor, nn

from residnet.physics.actuators import Actuators
from residnet.physics.environment_wind import WIND_INPUTS, WindLoads
from residnet.physics.kinematics import Kinematics


class Plant(nn.Module, ABC):
    """The truth of a simulation.

    Attributes:
        state: names of the columns of x [B, nx]: pose, velocities, then states of the actuators.
        inputs: names of the columns of w [B, m]: commands, then what nobody commands.
        commands: how many of the inputs are commands.
    """

    state: tuple[str, ...]
    inputs: tuple[str, ...]
    commands: int

    @abstractmethod
    def demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Commands [..., c] from the normalised drive and steer [...] of a manoeuvre."""

    @abstractmethod
    def rate(self, x: Tensor, w: Tensor) -> Tensor:
        """x_dot [B, nx] under inputs w [B, m]."""

    def approach(self, rows: int) -> Tensor:
        """State [rows, nx] that trials start from, float64: at rest; a model that only holds near its service speed starts there."""
        return torch.zeros(rows, len(self.state), dtype=torch.float64)

    def settle(self, x: Tensor, w: Tensor, dt: float) -> Tensor:
        """State [B, nx] after what moves once per step of dt seconds has moved."""
        return x


class HullPlant(Plant, ABC):
    """A hull with actuators in current and external forces; a subclass gives the acceleration of the hull.

    Inputs: commands; force_x, force_y, (force_k,) force_n in body axes [N, N, (N m,) N m]; current_north, current_east [m/s];
    force_north, force_east [N], constant in earth axes; where the vessel has wind coefficients, wind_speed [m/s] and wind_dir [rad],
    the true wind and where it comes from. A current is constant in earth axes and acts through the velocity relative to the water.
    """

    def __init__(self, kinematics: Kinematics, actuators: Actuators, wind: WindLoads | None = None) -> None:
        super().__init__()
        self.kinematics = kinematics
        self.actuators = actuators
        self.wind = wind
        self.n = len(kinematics.velocity)
        self.state = (*kinematics.pose, *kinematics.velocity, *actuators.state)
        self.commands = len(actuators.commands)
        forces = tuple(f"force_{axis}" for axis in kinematics.axes)
        self.inputs = (*actuators.commands, *forces, "current_north", "current_east", "force_north", "force_east")
        if wind is not None:
            self.inputs += WIND_INPUTS
        self.register_buffer("blown", torch.tensor(["xykn".index(axis) for axis in kinematics.axes]), persistent=False)
        self.blown: Tensor

    @abstractmethod
    def acceleration(self, pose: Tensor, nu: Tensor, tau: Tensor) -> Tensor:
        """nu_dot [B, n] at pose [B, n] from velocities through the water [B, n] and forces [B, n]."""

    @final
    def demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Commands [..., c] from the normalised drive and steer [...] of a manoeuvre."""
        return self.actuators.demand(drive, steer)

    @final
    def rate(self, x: Tensor, w: Tensor) -> Tensor:
        """x_dot [B, nx] under inputs w [B, m]."""
        n, c = self.n, self.commands
        pose, nu, a = x[:, :n], x[:, n : 2 * n], x[:, 2 * n :]
        command = w[:, :c]
        water, turned = self.kinematics.carried(w[:, c + n], w[:, c + n + 1], pose, nu)
        relative = nu - water
        tau = self.actuators.force(a, command, relative) + w[:, c : c + n] + self.kinematics.pushed(w[:, c + n + 2], w[:, c + n + 3], pose)
        if self.wind is not None:
            tau = tau + self._wind(w[:, c + n + 4], w[:, c + n + 5], pose, nu)
        nu_dot = self.acceleration(pose, relative, tau) + turned
        return torch.cat((self.kinematics.rate(pose, nu), nu_dot, self.actuators.rate(a, command)), dim=-1)

    def _wind(self, speed: Tensor, direction: Tensor, pose: Tensor, nu: Tensor) -> Tensor:
        """Forces [B, n] of the true wind on the vessel that moves over ground with nu [B, n]."""
        assert self.wind is not None
        air = self.kinematics.pushed(-speed * torch.cos(direction), -speed * torch.sin(direction), pose)
        return self.wind(air[:, 0] - nu[:, 0], air[:, 1] - nu[:, 1]).index_select(-1, self.blown)

    @final
    def settle(self, x: Tensor, w: Tensor, dt: float) -> Tensor:
        """State [B, nx] with the actuators moved on by a step of dt seconds (they are held while the hull moves)."""
        after = self.actuators.advance(x[:, 2 * self.n :], w[:, : self.commands], dt)
        return torch.cat((x[:, : 2 * self.n], after), dim=-1)

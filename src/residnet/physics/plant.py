"""Plants: a vessel with actuators and environment, as equations that a simulator integrates."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Self, final

import torch
from torch import Tensor, nn

from residnet.physics.actuators import Actuators
from residnet.physics.environment.wind import WIND_INPUTS, WindLoads
from residnet.physics.kinematics import Kinematics


class Plant(nn.Module, ABC):
    """The true vessel of a simulation.

    Attributes:
        state: names of the columns of x [B, nx]: pose, velocities, then states of the actuators.
        inputs: names of the columns of w [B, m]: commands, then exogenous inputs.
        commands: how many of the inputs are commands.
    """

    state: tuple[str, ...]
    inputs: tuple[str, ...]
    commands: int

    @abstractmethod
    def demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return the commands [..., c] from the normalised drive and steer [...] of a manoeuvre."""

    @abstractmethod
    def rate(self, x: Tensor, w: Tensor) -> Tensor:
        """Return x_dot [B, nx] under inputs w [B, m]."""

    def prepare(self, x: Tensor, w: Tensor) -> Tensor:
        """Return what a step holds fixed, p [B, k].

        Args:
            x: state [B, nx] at the step's start.
            w: inputs [B, m].
        """
        return w

    def held_rate(self, x: Tensor, p: Tensor) -> Tensor:
        """Return x_dot [B, nx] within a step that holds p = prepare(x, w).

        It equals `rate` under the same inputs.

        Equals `rate` under the same inputs.
        """
        return self.rate(x, p)

    def approach(self, rows: int) -> Tensor:
        """Return the state [rows, nx] that trials start from, float64.

        It is at rest; a model that only holds near its service speed starts there.

        a model that only holds near its service speed starts there.
        """
        return torch.zeros(rows, len(self.state), dtype=torch.float64)

    def end_step(self, x: Tensor, w: Tensor, dt: float) -> Tensor:
        """Return the state [B, nx] after what moves once per step of dt seconds has moved."""
        return x


class HullPlant(Plant, ABC):
    """A hull with actuators in current, wind and external forces.

    A subclass gives the acceleration of the hull.

    Inputs: commands; force_x, force_y, (force_k,) force_n in body axes [N, N, (N m,) N m];
    current_north, current_east [m/s]; force_north, force_east [N], constant in earth axes; where
    the vessel has wind coefficients, wind_speed [m/s] and wind_dir [rad], the true wind and where
    it comes from. A current is constant in earth axes and acts through the velocity relative to the
    water.
    """

    def __init__(
        self, kinematics: Kinematics, actuators: Actuators, wind: WindLoads | None = None
    ) -> None:
        super().__init__()
        self.kinematics = kinematics
        self.actuators = actuators
        self.wind = wind
        self.weather = True
        self.n = len(kinematics.velocity)
        self.state = (*kinematics.pose, *kinematics.velocity, *actuators.state)
        self.parts = [self.n, self.n, len(actuators.state)]
        self.commands = len(actuators.commands)
        forces = tuple(f"force_{axis}" for axis in kinematics.axes)
        self.inputs = (
            *actuators.commands,
            *forces,
            "current_north",
            "current_east",
            "force_north",
            "force_east",
        )
        if wind is not None:
            self.inputs += WIND_INPUTS
        self.register_buffer(
            "blown",
            torch.tensor(["xykn".index(axis) for axis in kinematics.axes]),
            persistent=False,
        )
        self.blown: Tensor

    @abstractmethod
    def acceleration(self, pose: Tensor, nu: Tensor, tau: Tensor) -> Tensor:
        """Return nu_dot [B, n].

        Args:
            pose: pose [B, n].
            nu: velocities through the water [B, n].
            tau: forces [B, n] in N and N m.
        """

    @final
    def demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return the commands [..., c] from the normalised drive and steer [...] of a manoeuvre."""
        return self.actuators.demand(drive, steer)

    def in_calm_water(self) -> Self:
        """Return this plant without its exogenous inputs, which is faster.

        There are no body or earth-fixed forces, current, wind or air resistance.
        """
        self.weather = False
        self.inputs = self.actuators.commands
        return self

    @final
    def prepare(self, x: Tensor, w: Tensor) -> Tensor:
        """Return the inputs with the actuators' forces added to the body forces.

        This holds where these forces stay the same over a step; elsewhere it returns w itself.
        """
        if not self.actuators.held:
            return w
        n, c = self.n, self.commands
        force = self.actuators.force(x[:, 2 * n :], w[:, :c], x[:, n : 2 * n])
        if self.weather:
            force = force + w[:, c : c + n]
        return torch.cat((w[:, :c], force, w[:, c + n :]), dim=-1)

    @final
    def held_rate(self, x: Tensor, p: Tensor) -> Tensor:
        """Return x_dot [B, nx] within a step, from p = prepare(x, w)."""
        return self._rate(x, p, self.actuators.held)

    @final
    def rate(self, x: Tensor, w: Tensor) -> Tensor:
        """Return x_dot [B, nx] under inputs w [B, m]."""
        return self._rate(x, w, False)

    def _rate(self, x: Tensor, w: Tensor, held: bool) -> Tensor:
        """Return x_dot [B, nx].

        `held`: the actuators' forces are among the body forces already, and their states stand
        still.
        """
        n, c = self.n, self.commands
        pose, nu, a = torch.split(x, self.parts, dim=-1)
        command = w.narrow(-1, 0, c)
        moving = torch.zeros_like(a) if held else self.actuators.rate(a, command)
        if not self.weather:
            tau = w.narrow(-1, c, n) if held else self.actuators.force(a, command, nu)
            return torch.cat(
                (self.kinematics.rate(pose, nu), self.acceleration(pose, nu, tau), moving), dim=-1
            )
        water, turned = self.kinematics.body_components_and_rate(
            w[:, c + n], w[:, c + n + 1], pose, nu
        )
        relative = nu - water
        body = (
            w[:, c : c + n]
            if held
            else self.actuators.force(a, command, relative) + w[:, c : c + n]
        )
        tau = body + self.kinematics.body_components(w[:, c + n + 2], w[:, c + n + 3], pose)
        if self.wind is not None:
            tau = tau + self._wind(w[:, c + n + 4], w[:, c + n + 5], pose, nu)
        nu_dot = self.acceleration(pose, relative, tau) + turned
        return torch.cat((self.kinematics.rate(pose, nu), nu_dot, moving), dim=-1)

    def _wind(self, speed: Tensor, direction: Tensor, pose: Tensor, nu: Tensor) -> Tensor:
        """Return the forces [B, n] of the true wind on a vessel with velocities over ground nu."""
        assert self.wind is not None
        air = self.kinematics.body_components(
            -speed * torch.cos(direction), -speed * torch.sin(direction), pose
        )
        force: Tensor = self.wind(air[:, 0] - nu[:, 0], air[:, 1] - nu[:, 1]).index_select(
            -1, self.blown
        )
        return force

    @final
    def end_step(self, x: Tensor, w: Tensor, dt: float) -> Tensor:
        """Return the state [B, nx] with the actuators moved on by a step of dt seconds.

        They are held while the hull moves.
        """
        after = self.actuators.advance(x[:, 2 * self.n :], w[:, : self.commands], dt)
        return torch.cat((x[:, : 2 * self.n], after), dim=-1)

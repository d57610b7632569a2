"""Plants: a vessel with actuators and environment, as equations that a simulator integrates."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Self, final

import torch
from torch import Tensor, nn

from residnet.core.errors import ConfigError
from residnet.core.frames import along_axes, cross, to_body, to_earth, upright
from residnet.core.layout import PLANAR, StateLayout
from residnet.core.names import WIND_INPUTS
from residnet.physics.actuators import Actuators
from residnet.physics.environment import WindLoadConfig
from residnet.physics.terms import TermLibrary

ROLLING = StateLayout(("x", "y", "phi", "psi"), ("u", "v", "p", "r"))
"""Surge, sway, roll and yaw, without heave and pitch (document 004 and its corrections)."""
SUBMERGED = StateLayout(("x", "y", "z", "phi", "theta", "psi"), ("u", "v", "w", "p", "q", "r"))
"""All six degrees of freedom, z the depth."""
_LAYOUTS = {one.dof: one for one in (PLANAR, ROLLING, SUBMERGED)}
_AXES = {
    PLANAR.dof: ("x", "y", "n"),
    ROLLING.dof: ("x", "y", "k", "n"),
    SUBMERGED.dof: ("x", "y", "z", "k", "m", "n"),
}


class Plant(nn.Module, ABC):
    """The true vessel of a simulation.

    Attributes:
        state: names of the columns of x [B, nx]: pose, velocities, then states of the actuators.
        inputs: names of the columns of w [B, m]: commands, then exogenous inputs.
        commands: how many of the inputs are commands.
        attitude: columns of roll, pitch and heading, where the vessel turns about all axes. The
            rates that stand there are those about the body axes: whoever integrates them composes
            rotations. Empty where angles add up.
        diving: commands [c] that make the vessel dive with all its force; None where it cannot.
    """

    state: tuple[str, ...]
    inputs: tuple[str, ...]
    commands: int
    attitude: tuple[int, ...] = ()
    diving: Tensor | None = None

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
        """
        return self.rate(x, p)

    def approach(self, rows: int) -> Tensor:
        """Return the state [rows, nx] that trials start from, float64.

        It is at rest; a model that only holds near its service speed starts there.
        """
        return torch.zeros(rows, len(self.state), dtype=torch.float64)

    def end_step(self, x: Tensor, w: Tensor, dt: float) -> Tensor:
        """Return the state [B, nx] after what moves once per step of dt seconds has moved."""
        return x


def inverse_mass(mass: Tensor, vessel: str) -> Tensor:
    """Return the inverse [n, n] of a mass matrix [n, n] in float64.

    Raises:
        ConfigError: where an eigenvalue is zero or has no positive real part, or the matrix is as
            good as singular.
    """
    if bool((torch.linalg.eigvals(mass).real <= 0).any()):
        raise ConfigError(
            f"vessel {vessel}: the mass matrix is not positive definite; added mass (X_udot,"
            " Y_vdot, N_rdot) is negative for a hull"
        )
    scale = mass.diagonal().sqrt()
    condition = float(torch.linalg.cond(mass / torch.outer(scale, scale)))
    if condition > 1e8:
        raise ConfigError(
            f"vessel {vessel}: the mass matrix is singular (condition {condition:.1e} after"
            " scaling); check the coupling terms x_G, Y_rdot, N_vdot"
        )
    inverse: Tensor = torch.linalg.inv(mass)
    return inverse


@final
class Hull(nn.Module):
    """A hull M nu_dot = terms(motion) C + tau, in n degrees of freedom.

    Buffers are float64; results take the dtype of the input.

    Args:
        mass: M with added mass, [n][n].
        rows: for each axis the coefficients C of its force by term; terms that brake are negative.
        channels: of the motion: the velocities through the water, then phi where the hull rolls,
            and theta where it pitches.

    Raises:
        ConfigError: where the mass matrix is not positive definite or is singular.
    """

    def __init__(
        self,
        mass: Sequence[Sequence[float]],
        rows: Sequence[Mapping[str, float]],
        channels: Sequence[str],
        vessel: str,
    ) -> None:
        super().__init__()
        self.terms = TermLibrary(list(dict.fromkeys(t for row in rows for t in row)), channels)
        coefficients = [[row.get(term, 0.0) for row in rows] for term in self.terms.terms]
        table = torch.tensor(coefficients, dtype=torch.float64).view(-1, len(rows))
        self.mass: Tensor = nn.Buffer(torch.tensor(mass, dtype=torch.float64), persistent=False)
        self.coefficients = nn.Buffer(table, persistent=False)
        self.inverse = nn.Buffer(inverse_mass(self.mass, vessel), persistent=False)

    def load(self, motion: Tensor) -> Tensor:
        """Return the forces [..., n] in N and N m of water, weight and rotation."""
        force: Tensor = self.terms(motion) @ self.coefficients.to(motion.dtype)
        return force

    def forward(self, motion: Tensor, tau: Tensor) -> Tensor:
        """Return the acceleration nu_dot [..., n] under the further forces tau [..., n]."""
        if self.terms.count:
            tau = tau + self.load(motion)
        return tau @ self.inverse.to(tau.dtype).T

    def required(self, nu_dot: Tensor, motion: Tensor) -> Tensor:
        """Return the forces [..., n] that accelerate the vessel by nu_dot [..., n].

        Source: document 002 eq. (2.10).
        """
        return nu_dot @ self.mass.to(motion.dtype).T - self.load(motion)

    def equations(self) -> tuple[tuple[str, ...], list[list[float]]]:
        """Return nu_dot as J terms of the motion, and coefficients [n][J + n] on each axis.

        The coefficients of tau stand behind those of the terms.
        """
        response = torch.cat((self.inverse @ self.coefficients.T, self.inverse), dim=1)
        return self.terms.terms, response.tolist()


@final
class HullPlant(Plant):
    """A hull with actuators in current, wind and external forces.

    State x [B, 2 n + k]: pose, velocities over ground, then the actuators' states. In 3 degrees of
    freedom these are x, y, psi and u, v, r; in 4 x, y, phi, psi and u, v, p, r; in 6 those of
    `SUBMERGED`.

    Inputs: commands; force_x, force_y, (force_z, force_k, force_m,) force_n in body axes [N, N m];
    current_north, current_east [m/s]; force_north, force_east [N], constant in earth axes; where
    the vessel file has a section `wind`, the true wind (`WIND_INPUTS`). Hull forces are those of
    the velocities relative to the water, wind loads those of the velocities relative to the air.

    Args:
        hull: of 3, 4 or 6 degrees of freedom.
        wind: loads of the air; None where it feels none.
        start: states that trials start from, where not at rest, by name.
    """

    def __init__(
        self,
        hull: Hull,
        actuators: Actuators,
        wind: WindLoadConfig | None = None,
        start: Mapping[str, float] | None = None,
    ) -> None:
        super().__init__()
        self.hull, self.actuators, self.wind = hull, actuators, wind
        self.n = len(hull.mass)
        self.rolls, self.dives = self.n == ROLLING.dof, self.n == SUBMERGED.dof
        self.weather = True
        self.state = (*_LAYOUTS[self.n].names, *actuators.state)
        self.attitude = tuple(map(self.state.index, ("phi", "theta", "psi"))) if self.dives else ()
        self.diving = actuators.diving
        self.parts = [self.n, self.n, len(actuators.state)]
        self.commands = len(actuators.commands)
        self.inputs = (
            *actuators.commands,
            *(f"force_{axis}" for axis in _AXES[self.n]),
            "current_north",
            "current_east",
            "force_north",
            "force_east",
            *(WIND_INPUTS if wind is not None else ()),
        )
        self.start = {self.state.index(n): v for n, v in (start or {}).items() if n in self.state}

    def demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        return self.actuators.demand(drive, steer)

    def in_calm_water(self) -> Self:
        """Return this plant without its exogenous inputs, which is faster.

        There are no body or earth-fixed forces, current, wind or air resistance.
        """
        self.weather = False
        self.inputs = self.actuators.commands
        return self

    def approach(self, rows: int) -> Tensor:
        x = super().approach(rows)
        for column, value in self.start.items():
            x[:, column] = value
        return x

    def prepare(self, x: Tensor, w: Tensor) -> Tensor:
        """Return the inputs with the actuators' forces added to the body forces.

        This holds where these forces stay the same over a step; elsewhere it returns w itself. A
        recorded step of wam_v_cal takes 162 us so, 221 us without.
        """
        if not self.actuators.held:
            return w
        n, c = self.n, self.commands
        force = self.actuators.force(x[:, 2 * n :], w[:, :c], x[:, n : 2 * n])
        if self.weather:
            force = force + w[:, c : c + n]
        return torch.cat((w[:, :c], force, w[:, c + n :]), dim=-1)

    def held_rate(self, x: Tensor, p: Tensor) -> Tensor:
        return self._rate(x, p, self.actuators.held)

    def rate(self, x: Tensor, w: Tensor) -> Tensor:
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
        moved = self._pose_rate(pose, nu)
        if not self.weather:
            tau = w.narrow(-1, c, n) if held else self.actuators.force(a, command, nu)
            return torch.cat((moved, self.hull(self._motion(pose, nu), tau), moving), dim=-1)
        water, turned = self._water(w[:, c + n], w[:, c + n + 1], pose, nu)
        relative, tau = nu - water, w[:, c : c + n]
        if not held:
            tau = tau + self.actuators.force(a, command, relative)
        tau = tau + self._body(w[:, c + n + 2], w[:, c + n + 3], pose)
        if self.wind is not None:
            tau = tau + self._wind(w[:, c + n + 4], w[:, c + n + 5], pose, nu)
        nu_dot = self.hull(self._motion(pose, relative), tau) + turned
        return torch.cat((moved, nu_dot, moving), dim=-1)

    def _motion(self, pose: Tensor, nu: Tensor) -> Tensor:
        if self.dives:
            return torch.cat((nu, pose[..., 3:5]), dim=-1)
        return torch.cat((nu, pose[..., 2:3]), dim=-1) if self.rolls else nu

    def _pose_rate(self, pose: Tensor, nu: Tensor) -> Tensor:
        """Return the derivative [B, n] of the pose (document 003 eq. (1), document 004).

        Where the vessel turns about all axes, what its angles have is p, q and r.
        """
        u, v = nu[..., 0], nu[..., 1]
        if self.dives:
            forward, starboard, down = upright(u, v, nu[..., 2], pose[..., 3], pose[..., 4])
            north, east = to_earth(forward, starboard, pose[..., 5])
            return torch.cat((torch.stack((north, east, down), dim=-1), nu[..., 3:]), dim=-1)
        if not self.rolls:
            return torch.stack((*to_earth(u, v, pose[..., 2]), nu[..., 2]), dim=-1)
        cos_phi = torch.cos(pose[..., 2])
        north, east = to_earth(u, v * cos_phi, pose[..., 3])
        return torch.stack((north, east, nu[..., 2], nu[..., 3] * cos_phi), dim=-1)

    def _body(self, north: Tensor, east: Tensor, pose: Tensor) -> Tensor:
        """Return an earth-fixed horizontal vector along the (rolled) body axes, [B, n]."""
        zero = torch.zeros_like(pose[..., -1])
        if self.dives:
            return torch.stack((*along_axes(north, east, pose[..., 3:]), zero, zero, zero), dim=-1)
        along, across = to_body(north, east, pose[..., -1])
        if self.rolls:
            return torch.stack((along, across * torch.cos(pose[..., 2]), zero, zero), dim=-1)
        return torch.stack((along, across, zero), dim=-1)

    def _water(
        self, north: Tensor, east: Tensor, pose: Tensor, nu: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the current in body axes and its derivative while the body turns, each [B, n]."""
        if self.dives:
            body = self._body(north, east, pose)
            turned = cross(body[..., :3], nu[..., 3:])
            return body, torch.cat((turned, torch.zeros_like(turned)), dim=-1)
        along, across = to_body(north, east, pose[..., -1])
        zero, r = torch.zeros_like(along), nu[..., -1]
        if not self.rolls:
            body = torch.stack((along, across, zero), dim=-1)
            return body, torch.stack((r * across, -r * along, zero), dim=-1)
        cos_phi, sin_phi = torch.cos(pose[..., 2]), torch.sin(pose[..., 2])
        turning, p = r * cos_phi, nu[..., 2]
        sideways = -turning * along * cos_phi - p * across * sin_phi
        body = torch.stack((along, across * cos_phi, zero, zero), dim=-1)
        return body, torch.stack((turning * across, sideways, zero, zero), dim=-1)

    def _wind(self, speed: Tensor, direction: Tensor, pose: Tensor, nu: Tensor) -> Tensor:
        """Return the forces [B, n] of the true wind on a vessel with velocities over ground nu."""
        assert self.wind is not None
        air = self._body(-speed * torch.cos(direction), -speed * torch.sin(direction), pose)
        force = self.wind.loads(air[:, 0] - nu[:, 0], air[:, 1] - nu[:, 1])
        return force if self.rolls else torch.cat((force[:, :2], force[:, 3:]), dim=-1)

    def end_step(self, x: Tensor, w: Tensor, dt: float) -> Tensor:
        """Return the state [B, nx] with the actuators moved on by a step of dt seconds.

        They are held while the hull moves.
        """
        after = self.actuators.advance(x[:, 2 * self.n :], w[:, : self.commands], dt)
        return torch.cat((x[:, : 2 * self.n], after), dim=-1)

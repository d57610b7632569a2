"""Plants: equations of motion of a vessel with actuators and environment, for simulation."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Self, final

import torch
from torch import Tensor, nn

from residnet.core.frames import cross_product, horizontal_to_body, to_body, to_earth, to_level_axes
from residnet.core.layout import PLANAR_LAYOUT, ROLL_PLANT_LAYOUT, SIX_DOF_PLANT_LAYOUT
from residnet.physics.actuators.base import ActuatorSystem
from residnet.physics.environment_config import WindLoadConfig
from residnet.physics.plant_channels import list_exogenous_inputs, require_invertible_mass
from residnet.physics.term_library import TermLibrary

_LAYOUT_OF_DOF = {
    layout.n_dof: layout for layout in (PLANAR_LAYOUT, ROLL_PLANT_LAYOUT, SIX_DOF_PLANT_LAYOUT)
}


class Plant(nn.Module, ABC):
    """Plant of a simulation, x_dot = f(x, w).

    Attributes:
        state_names: names of the columns of x [B, nx]: pose, velocities, states of the actuators.
        input_names: names of the columns of w [B, m]: commands, then exogenous inputs.
        n_commands: number of commands among the inputs.
        attitude_columns: columns of roll, pitch and heading of a vessel in six degrees of freedom.
            The derivatives in these columns are the rates about the body axes, and the integrator
            composes rotations. Empty if angles are integrated directly.
        dive_commands: commands [c] of full force downwards; None if the vessel cannot dive.
    """

    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    n_commands: int
    attitude_columns: tuple[int, ...] = ()
    dive_commands: Tensor | None = None

    @abstractmethod
    def commands_for_demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return commands [..., c] for normalised propulsion and steering commands [...]."""

    @abstractmethod
    def derivative(self, x: Tensor, w: Tensor) -> Tensor:
        """Compute x_dot [B, nx] at state x [B, nx] and inputs w [B, m]."""

    def prepare(self, x: Tensor, w: Tensor) -> Tensor:
        """Compute the quantities p [B, k] that are constant over a time step.

        Args:
            x: state [B, nx] at the start of the step.
            w: inputs [B, m].
        """
        return w

    def derivative_prepared(self, x: Tensor, p: Tensor) -> Tensor:
        """Compute x_dot [B, nx] within a time step, with p = prepare(x, w).

        The result equals the result of `derivative` with the same inputs.
        """
        return self.derivative(x, p)

    def make_initial_state(self, n_rows: int) -> Tensor:
        """Return the initial state of trials [n_rows, nx], float64.

        The vessel is at rest, or at service speed if the model is valid only near it.
        """
        return torch.zeros(n_rows, len(self.state_names), dtype=torch.float64)

    def finish_step(self, x: Tensor, w: Tensor, dt: float) -> Tensor:
        """Apply the updates at the end of a time step of dt seconds to the state [B, nx]."""
        return x


def invert_mass(mass: Tensor, vessel: str) -> Tensor:
    """Return the inverse [n, n] of a mass matrix [n, n] in float64.

    Raises:
        ConfigError: if an eigenvalue has no positive real part, or the matrix is nearly singular.
    """
    require_invertible_mass(mass.tolist(), vessel)
    inverse: Tensor = torch.linalg.inv(mass)
    return inverse


@final
class Hull(nn.Module):
    """Hull M nu_dot = terms(motion) C + tau in n degrees of freedom.

    Buffers are float64; results have the dtype of the input.

    Args:
        mass: mass matrix M with added mass, [n][n].
        force_rows: coefficients C of the force of each axis by term; damping terms are
            negative.
        channels: channels of the motion: velocities through the water, then phi with roll and theta
            with pitch.
        vessel: name of the vessel, for the message.

    Raises:
        ConfigError: if the mass matrix is not positive definite or is singular.
    """

    def __init__(
        self,
        mass: Sequence[Sequence[float]],
        force_rows: Sequence[Mapping[str, float]],
        channels: Sequence[str],
        vessel: str,
    ) -> None:
        super().__init__()
        self.terms = TermLibrary(
            list(
                dict.fromkeys(
                    term_name for axis_coefficients in force_rows for term_name in axis_coefficients
                )
            ),
            channels,
        )
        coefficients = [
            [axis_coefficients.get(term, 0.0) for axis_coefficients in force_rows]
            for term in self.terms.terms
        ]
        coefficient_table = torch.tensor(coefficients, dtype=torch.float64).view(
            -1, len(force_rows)
        )
        self.mass: Tensor = nn.Buffer(torch.tensor(mass, dtype=torch.float64), persistent=False)
        self.coefficients = nn.Buffer(coefficient_table, persistent=False)
        self.inverse_mass = nn.Buffer(invert_mass(self.mass, vessel), persistent=False)

    def hydrodynamic_force(self, motion: Tensor) -> Tensor:
        """Return hydrodynamic, hydrostatic and Coriolis forces [..., n] in N and N m."""
        force: Tensor = self.terms(motion) @ self.coefficients.to(motion.dtype)
        return force

    def forward(self, motion: Tensor, tau: Tensor) -> Tensor:
        """Compute the acceleration nu_dot [..., n] under external forces tau [..., n]."""
        if self.terms.n_terms:
            tau = tau + self.hydrodynamic_force(motion)
        return tau @ self.inverse_mass.to(tau.dtype).T

    def required_force(self, nu_dot: Tensor, motion: Tensor) -> Tensor:
        """Compute the external forces [..., n] for the acceleration nu_dot [..., n].

        Source: Jervan 2020, eq. (2.10).
        """
        return nu_dot @ self.mass.to(motion.dtype).T - self.hydrodynamic_force(motion)

    def acceleration_equations(self) -> tuple[tuple[str, ...], list[list[float]]]:
        """Return the J terms of nu_dot and the coefficients [n][J + n] of the axes.

        The last n columns are the coefficients of tau.
        """
        # nu_dot = M^-1 C^T terms + M^-1 tau
        coefficients = torch.cat(
            (self.inverse_mass @ self.coefficients.T, self.inverse_mass), dim=1
        )
        return self.terms.terms, coefficients.tolist()


@final
class HullPlant(Plant):
    """Plant of a hull with actuators, current, wind and external forces.

    The state x [B, 2 n + k] is pose, velocities over ground and states of the actuators. In 3
    degrees of freedom pose and velocities are x, y, psi and u, v, r; in 4 they are x, y, phi, psi
    and u, v, p, r; in 6 they are those of `SIX_DOF_PLANT_LAYOUT`.

    The inputs are commands; force_x, force_y, (force_z, force_k, force_m,) force_n in body axes
    [N, N m]; current_north, current_east [m/s]; force_north, force_east [N], constant in earth
    axes; and the true wind (`WIND_INPUTS`) if the vessel file has a section `wind`. Hull forces
    depend on velocities relative to the water, wind loads on velocities relative to the air.

    Args:
        hull: hull in 3, 4 or 6 degrees of freedom.
        actuators: actuators of the vessel.
        wind: wind loads; None without wind.
        initial_values: nonzero initial states of trials by name.
    """

    def __init__(
        self,
        hull: Hull,
        actuators: ActuatorSystem,
        wind: WindLoadConfig | None = None,
        initial_values: Mapping[str, float] | None = None,
    ) -> None:
        super().__init__()
        self.hull = hull
        self.actuators = actuators
        self.wind = wind
        self.n_dof = len(hull.mass)
        self.has_roll_without_pitch = self.n_dof == ROLL_PLANT_LAYOUT.n_dof
        self.is_submerged = self.n_dof == SIX_DOF_PLANT_LAYOUT.n_dof
        self.has_environment = True
        self.state_names = (*_LAYOUT_OF_DOF[self.n_dof].state_names, *actuators.state_names)
        self.attitude_columns = (
            tuple(map(self.state_names.index, ("phi", "theta", "psi"))) if self.is_submerged else ()
        )
        self.dive_commands = actuators.dive_commands
        self.state_sizes = [self.n_dof, self.n_dof, len(actuators.state_names)]
        self.n_commands = len(actuators.command_names)
        self.input_names = (
            *actuators.command_names,
            *list_exogenous_inputs(_LAYOUT_OF_DOF[self.n_dof], has_wind=wind is not None),
        )
        self.initial_values = {
            self.state_names.index(n): value
            for n, value in (initial_values or {}).items()
            if n in self.state_names
        }

    def commands_for_demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        return self.actuators.commands_for_demand(drive, steer)

    def without_environment(self) -> Self:
        """Remove exogenous inputs and air resistance, which makes the step faster; returns self."""
        # traced and compiled plants skip the inputs that are always zero
        self.has_environment = False
        self.input_names = self.actuators.command_names
        return self

    def make_initial_state(self, n_rows: int) -> Tensor:
        x = super().make_initial_state(n_rows)
        for column, value in self.initial_values.items():
            x[:, column] = value
        return x

    def prepare(self, x: Tensor, w: Tensor) -> Tensor:
        """Return the inputs with the actuator forces added to the body forces.

        If the actuator forces are not constant over a time step, the result is w. This reduces the
        time of a traced step of wam_v_cal from 221 to 162 us.
        """
        # forces that depend on lags or on the speed change between the stages of the integrator
        if not self.actuators.is_force_constant_in_step:
            return w
        n = self.n_dof
        c = self.n_commands
        force = self.actuators.force(x[:, 2 * n :], w[:, :c], x[:, n : 2 * n])
        if self.has_environment:
            force = force + w[:, c : c + n]
        return torch.cat((w[:, :c], force, w[:, c + n :]), dim=-1)

    def derivative_prepared(self, x: Tensor, p: Tensor) -> Tensor:
        return self._compute_derivative(x, p, self.actuators.is_force_constant_in_step)

    def derivative(self, x: Tensor, w: Tensor) -> Tensor:
        return self._compute_derivative(x, w, False)

    def _compute_derivative(self, x: Tensor, w: Tensor, is_force_included: bool) -> Tensor:
        """Compute x_dot [B, nx].

        Args:
            x: state [B, nx].
            w: inputs [B, m].
            is_force_included: whether the body forces in w include the actuator forces; the
                derivatives of the actuator states are then zero.
        """
        n = self.n_dof
        c = self.n_commands
        pose, nu, actuator_states = torch.split(x, self.state_sizes, dim=-1)
        command = w.narrow(-1, 0, c)
        actuator_derivative = (
            torch.zeros_like(actuator_states)
            if is_force_included
            else self.actuators.derivative(actuator_states, command)
        )
        pose_derivative = self._pose_derivative(pose, nu)
        # without environment the velocities over ground are those through the water
        if not self.has_environment:
            tau = (
                w.narrow(-1, c, n)
                if is_force_included
                else self.actuators.force(actuator_states, command, nu)
            )
            return torch.cat(
                (
                    pose_derivative,
                    self.hull(self._hull_channels(pose, nu), tau),
                    actuator_derivative,
                ),
                dim=-1,
            )
        current, current_derivative = self._current_in_body_axes(
            w[:, c + n], w[:, c + n + 1], pose, nu
        )
        # hydrodynamic and actuator forces depend on the velocity through the water
        relative_velocity = nu - current
        tau = w[:, c : c + n]
        if not is_force_included:
            tau = tau + self.actuators.force(actuator_states, command, relative_velocity)
        tau = tau + self._to_body_axes(w[:, c + n + 2], w[:, c + n + 3], pose)
        if self.wind is not None:
            tau = tau + self._wind_force(w[:, c + n + 4], w[:, c + n + 5], pose, nu)
        # the hull gives the derivative of the velocity through the water; adding that of the
        # current gives the velocity over ground
        nu_dot = self.hull(self._hull_channels(pose, relative_velocity), tau) + current_derivative
        return torch.cat((pose_derivative, nu_dot, actuator_derivative), dim=-1)

    def _hull_channels(self, pose: Tensor, nu: Tensor) -> Tensor:
        """Return velocities, and roll and pitch of a vessel that has them: the hull's channels."""
        if self.is_submerged:
            return torch.cat((nu, pose[..., 3:5]), dim=-1)
        return torch.cat((nu, pose[..., 2:3]), dim=-1) if self.has_roll_without_pitch else nu

    def _pose_derivative(self, pose: Tensor, nu: Tensor) -> Tensor:
        """Return the derivative [B, n] of the pose (Woo et al. 2018, eq. (1), Gouletas 2020).

        In six degrees of freedom the derivatives of the angles are p, q and r.
        """
        u, v = nu[..., 0], nu[..., 1]
        if self.is_submerged:
            velocity_forward, velocity_starboard, velocity_down = to_level_axes(
                u, v, nu[..., 2], pose[..., 3], pose[..., 4]
            )
            north, east = to_earth(velocity_forward, velocity_starboard, pose[..., 5])
            return torch.cat(
                (torch.stack((north, east, velocity_down), dim=-1), nu[..., 3:]), dim=-1
            )
        if not self.has_roll_without_pitch:
            return torch.stack((*to_earth(u, v, pose[..., 2]), nu[..., 2]), dim=-1)
        # without pitch and heave, roll only tilts the sway velocity and the yaw axis
        cos_phi = torch.cos(pose[..., 2])
        north, east = to_earth(u, v * cos_phi, pose[..., 3])
        return torch.stack((north, east, nu[..., 2], nu[..., 3] * cos_phi), dim=-1)

    def _to_body_axes(self, north: Tensor, east: Tensor, pose: Tensor) -> Tensor:
        """Transform a horizontal vector in earth axes to body axes, [B, n]."""
        zero = torch.zeros_like(pose[..., -1])
        if self.is_submerged:
            return torch.stack(
                (*horizontal_to_body(north, east, pose[..., 3:]), zero, zero, zero), dim=-1
            )
        body_x, body_y = to_body(north, east, pose[..., -1])
        if self.has_roll_without_pitch:
            return torch.stack((body_x, body_y * torch.cos(pose[..., 2]), zero, zero), dim=-1)
        return torch.stack((body_x, body_y, zero), dim=-1)

    def _current_in_body_axes(
        self, north: Tensor, east: Tensor, pose: Tensor, nu: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the current in body axes and its derivative due to rotation, each [B, n]."""
        if self.is_submerged:
            current = self._to_body_axes(north, east, pose)
            # a current that is constant in earth axes rotates in body axes: d/dt nu_c = nu_c x
            # omega
            rotation = cross_product(current[..., :3], nu[..., 3:])
            return current, torch.cat((rotation, torch.zeros_like(rotation)), dim=-1)
        body_x, body_y = to_body(north, east, pose[..., -1])
        zero = torch.zeros_like(body_x)
        r = nu[..., -1]
        if not self.has_roll_without_pitch:
            current = torch.stack((body_x, body_y, zero), dim=-1)
            return current, torch.stack((r * body_y, -r * body_x, zero), dim=-1)
        cos_phi = torch.cos(pose[..., 2])
        sin_phi = torch.sin(pose[..., 2])
        heading_rate = r * cos_phi
        p = nu[..., 2]
        sway_derivative = -heading_rate * body_x * cos_phi - p * body_y * sin_phi
        current = torch.stack((body_x, body_y * cos_phi, zero, zero), dim=-1)
        return current, torch.stack((heading_rate * body_y, sway_derivative, zero, zero), dim=-1)

    def _wind_force(self, speed: Tensor, direction: Tensor, pose: Tensor, nu: Tensor) -> Tensor:
        """Return the wind forces [B, n] at a true wind and velocities over ground nu."""
        assert self.wind is not None
        # the direction is where the wind comes from
        air_velocity = self._to_body_axes(
            -speed * torch.cos(direction), -speed * torch.sin(direction), pose
        )
        force = self.wind.wind_forces(air_velocity[:, 0] - nu[:, 0], air_velocity[:, 1] - nu[:, 1])
        return (
            force
            if self.has_roll_without_pitch
            else torch.cat((force[:, :2], force[:, 3:]), dim=-1)
        )

    def finish_step(self, x: Tensor, w: Tensor, dt: float) -> Tensor:
        """Update the actuator states in x [B, nx] at the end of a time step of dt seconds.

        They are constant during the integration of the hull.
        """
        actuator_states = self.actuators.advance_step(
            x[:, 2 * self.n_dof :], w[:, : self.n_commands], dt
        )
        return torch.cat((x[:, : 2 * self.n_dof], actuator_states), dim=-1)

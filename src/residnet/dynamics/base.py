"""The interface of all models, and the explicit Runge-Kutta step that they share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from residnet.core.columns import (
    all_but_pose,
    dynamic_states,
    heading,
    level_velocities,
    pose,
    roll_angle,
    surge,
    sway,
    yaw_rate,
)
from residnet.core.frames import compose_rotation, cross_product, to_earth
from residnet.core.layout import PLANAR_LAYOUT
from residnet.dynamics.time_steps import Integrator

# Butcher tableaux (nodes, weights) of explicit schemes in which every stage depends on the
# previous stage alone; the first stage is the state itself
_TABLEAUX: dict[str, tuple[list[float], list[float]]] = {
    "rk4": ([0.0, 0.5, 0.5, 1.0], [1 / 6, 1 / 3, 1 / 3, 1 / 6]),
    "heun": ([0.0, 1.0], [0.5, 0.5]),
    "euler": ([0.0], [1.0]),
    "semi_implicit_euler": ([0.0], [1.0]),
}


class Dynamics(nn.Module, ABC):
    """A vessel model in discrete time, `step(x, w, s) -> (next x, next s)` with a fixed time step.

    x is the state, w are the inputs, constant over the step, and s is the memory of the model.

    Subclasses implement `step`, and `state_derivative(x, p, rho)` if they integrate. Both are
    written with torch operations on batches, without Python branches on values: rollouts,
    gradients, Jacobians and exports are derived from a trace of the step.

    Attributes:
        dof: number of dynamic states: u, v, r, and p and phi of a vessel with roll.
        has_roll: whether roll is among them.
        is_spatial: whether the model has roll, pitch and heading, so that rotations are composed.
        has_position: whether x and y are integrated. Velocities and heading do not depend on them:
            a training without positions takes 24 to 33 % less time (float32, one thread, batches
            of 64 and 256 rows, with gradients).
    """

    def __init__(self, dt: float, integrator: Integrator) -> None:
        super().__init__()
        self.dt = dt
        self.integrator: Integrator = integrator
        self.nodes, self.weights = (list(part) for part in _TABLEAUX[integrator])
        self.is_semi_implicit = integrator == "semi_implicit_euler"
        self.n_state = 0
        self.dof = PLANAR_LAYOUT.n_dof
        self.has_roll = False
        self.has_position = True
        self.set_attitude_columns((), 0)

    def set_attitude_columns(self, attitude: Sequence[int], n_states: int) -> None:
        """Declare the columns of roll, pitch and heading in the state.

        Their derivatives are angular velocities about the body axes, and rotations are composed.

        Args:
            attitude: the columns; empty if increments of angles are simply added.
            n_states: number of states.
        """
        self.is_spatial = len(attitude) > 0
        # columns of a state to which three rotated angles are appended
        columns = torch.arange(n_states)
        columns[list(attitude)] = n_states + torch.arange(len(attitude))
        self.attitude = nn.Buffer(torch.tensor(attitude).long(), persistent=False)
        self.columns_with_attitude = nn.Buffer(columns, persistent=False)

    def state_derivative(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        """Return the derivative of the state [B, nx] at a stage.

        Args:
            x: state at the stage [B, nx].
            p: prepared inputs, held over the step [B, k].
            rho: residual, held over the step [B, n].
        """
        raise NotImplementedError

    @abstractmethod
    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the state [B, nx] and the memory [B, n_state] one step later, inputs w [B, m]."""

    def initial_state(self, batch: int) -> Tensor:
        """Return the initial memory [batch, n_state]: zeros."""
        return torch.zeros(batch, self.n_state)

    def kinematics(self, x: Tensor) -> Tensor:
        """Return the derivative of the pose [B, 3] of states [B, nx].

        Source: Woo et al. 2018, eq. (1), and Gouletas 2020 for a vessel that rolls.
        """
        if self.is_spatial:
            # `rotation_vector_derivative` turns the angular velocities into rates of the attitude
            forward, starboard, _ = level_velocities(dynamic_states(x, self.dof))
            north, east = to_earth(forward, starboard, heading(x))
            return torch.stack((north, east, yaw_rate(x)), dim=-1)
        sway_velocity = sway(x)
        heading_rate = yaw_rate(x)
        if self.has_roll:
            cos_roll = torch.cos(roll_angle(x))
            sway_velocity = sway_velocity * cos_roll
            heading_rate = heading_rate * cos_roll
        if not self.has_position:
            zero = torch.zeros_like(heading_rate)
            return torch.stack((zero, zero, heading_rate), dim=-1)
        north, east = to_earth(surge(x), sway_velocity, heading(x))
        return torch.stack((north, east, heading_rate), dim=-1)

    def integrate_angles(self, x: Tensor, next_state: Tensor) -> Tensor:
        """Return the next states [B, nx] with angles integrated by the new velocities.

        Args:
            x: states before the step [B, nx].
            next_state: states after an Euler step [B, nx].
        """
        # models without roll or pitch have no such angles
        return next_state

    def rotation_vector_derivative(self, rotation: Tensor, derivative: Tensor) -> Tensor:
        """Replace the angular velocities in a derivative [B, nx] by rates of the rotation vector.

        The inverse of the derivative of the exponential map is truncated after the second
        commutator, which is enough for the order of the integrators (Munthe-Kaas 1998).

        Args:
            rotation: change of the state since the start of the step [B, nx]; its attitude columns
                are a rotation vector.
            derivative: derivative of the state after that change [B, nx].
        """
        vector = rotation.index_select(-1, self.attitude)
        angular_velocity = derivative.index_select(-1, self.attitude)
        commutator = cross_product(vector, angular_velocity)
        vector_rate = angular_velocity + 0.5 * commutator + cross_product(vector, commutator) / 12.0
        both_derivatives = torch.cat((derivative, vector_rate), dim=-1)
        return both_derivatives.index_select(-1, self.columns_with_attitude)

    def integrate(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        """Integrate over one step and return the state [B, nx]; arguments as `state_derivative`."""
        return self.integrate_from_derivative(self.state_derivative(x, p, rho), x, p, rho)

    def add_change(self, x: Tensor, change: Tensor) -> Tensor:
        """Return states [B, nx] after a change [B, nx] whose angles are a rotation vector."""
        changed = x + change
        if not self.is_spatial:
            return changed
        angles = compose_rotation(
            x.index_select(-1, self.attitude), change.index_select(-1, self.attitude)
        )
        return torch.cat((changed, angles), dim=-1).index_select(-1, self.columns_with_attitude)

    def integrate_from_derivative(self, k: Tensor, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        """Return the state one step later [B, nx], given its derivative k [B, nx] at the start.

        Rotations are integrated as rotation vectors from the start of the step, with the first
        commutator.

        Source: H. Munthe-Kaas, Runge-Kutta methods on Lie groups, BIT 38 (1998).
        """
        # k is the stage derivative; each stage needs the previous one only
        total = self.weights[0] * k
        for i in range(1, len(self.nodes)):
            change = (self.dt * self.nodes[i]) * k
            k = self.state_derivative(self.add_change(x, change), p, rho)
            if self.is_spatial:
                k = self.rotation_vector_derivative(change, k)
            total = total + self.weights[i] * k
        next_state = self.add_change(x, self.dt * total)
        if not self.is_semi_implicit:
            return next_state
        next_state = self.integrate_angles(x, next_state)
        if self.is_spatial:
            return next_state
        # integrating the pose with the new velocities keeps an undamped oscillation bounded
        velocities = all_but_pose(next_state)
        pose_derivative = self.kinematics(torch.cat((pose(x), velocities), dim=-1))
        return torch.cat((pose(x) + self.dt * pose_derivative, velocities), dim=-1)

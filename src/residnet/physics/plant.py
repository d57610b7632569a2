"""Plants: a vessel with its actuators and environment, as a right-hand side that a simulator steps."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from residnet.core.frames import to_body, to_earth
from residnet.core.names import STATE
from residnet.physics.actuators import DifferentialThrust
from residnet.physics.fossen import Fossen3
from residnet.physics.vessel import VesselConfig


class DifferentialThrustVessel(nn.Module):
    """A 3-DOF vessel on two thrusters in current and external force.

    State x [B, 8]: x, y [m], psi [rad], u, v [m/s] over ground, r [rad/s], n_port, n_stbd [1/s].
    Inputs w [B, 7]: cmd_port, cmd_stbd [1/s], force_x, force_y [N], force_n [N m] (body axes), current_north, current_east [m/s].
    """

    state = (*STATE, "n_port", "n_stbd")
    inputs = ("cmd_port", "cmd_stbd", "force_x", "force_y", "force_n", "current_north", "current_east")
    commands = 2

    def __init__(self, vessel: VesselConfig) -> None:
        super().__init__()
        self.hull = Fossen3(vessel)
        self.thrusters: DifferentialThrust = vessel.actuators.build()

    def demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Commands [..., 2] in 1/s from the normalised mean and difference of revolutions (document 003 eqs. (30), (31)), clipped to +-1 per side."""
        both = torch.stack((drive + steer, drive - steer), dim=-1)
        return both.clamp(-1.0, 1.0) * self.thrusters.n_max

    def rate(self, x: Tensor, w: Tensor) -> Tensor:
        """x_dot [B, 8] at held actuator states; a constant current acts through the velocity relative to the water."""
        psi, nu = x[:, 2], x[:, 3:6]
        r = nu[:, 2]
        along, across = to_body(w[:, 5], w[:, 6], psi)
        relative = torch.stack((nu[:, 0] - along, nu[:, 1] - across, r), dim=-1)
        acceleration = self.hull(relative, self.thrusters(x[:, 6:8]) + w[:, 2:5])
        # the current is constant in earth axes, so it turns in body axes
        u_dot = acceleration[:, 0] + r * across
        v_dot = acceleration[:, 1] - r * along
        north, east = to_earth(nu[:, 0], nu[:, 1], psi)
        zero = torch.zeros_like(r)
        return torch.stack((north, east, r, u_dot, v_dot, acceleration[:, 2], zero, zero), dim=-1)

    def settle(self, x: Tensor, w: Tensor, dt: float) -> Tensor:
        """State [B, 8] with the actuators moved on by a step of dt seconds (they are held while the hull moves)."""
        return torch.cat((x[:, :6], self.thrusters.advance(x[:, 6:8], w[:, :2], dt)), dim=-1)

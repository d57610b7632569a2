"""The truth of a steering model: exact steps of its linear motion under a held rudder."""

from __future__ import annotations

from typing import final

import torch
from torch import Tensor

from residnet.core.columns import heading, surge
from residnet.core.frames import to_earth
from residnet.dynamics.base import Dynamics
from residnet.physics.nomoto import NomotoVessel


@final
class NomotoDynamics(Dynamics):
    """An exact step of heading, sway and yaw of a `SteeringVessel`, then of its rudder.

    The motion is stepped by the matrix exponential.

    The position is the integral of the exact velocities by Simpson's rule over the step: its error
    is O(dt^4), that of heading and velocities is rounding at any dt.
    """

    def __init__(self, plant: NomotoVessel, dt: float) -> None:
        super().__init__(dt, "rk4")
        self.plant = plant
        size = plant.n_steering_states + 2
        # psi, then v, r and internal states, then the rudder angle, which is constant
        system = torch.zeros(size, size, dtype=torch.float64)
        system[0, 2] = 1.0
        system[1:-1, 1:-1] = plant.a
        system[1:-1, -1] = plant.b
        for name, value in (
            ("to_middle", torch.linalg.matrix_exp(0.5 * dt * system)[:-1].T.contiguous()),
            ("to_end", torch.linalg.matrix_exp(dt * system)[:-1].T.contiguous()),
            ("simpson", torch.tensor([1.0, 4.0, 1.0], dtype=torch.float64) * dt / 6.0),
        ):
            self.register_buffer(name, value, persistent=False)
        self.to_middle: Tensor
        self.to_end: Tensor
        self.simpson: Tensor

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the state after a step; the memory passes through."""
        plant = self.plant
        speed = surge(x)
        rudder = x[:, plant.rudder_columns]
        start = torch.cat(
            (
                heading(x).unsqueeze(-1),
                x[:, plant.steering_columns],
                plant.rudder_angle(x, w).unsqueeze(-1),
            ),
            dim=-1,
        )
        middle = start @ self.to_middle.to(x.dtype)
        end = start @ self.to_end.to(x.dtype)
        # psi and v stand first in the linear system
        psi, v = torch.stack((start[:, :2], middle[:, :2], end[:, :2]), dim=1).unbind(-1)
        north, east = to_earth(speed.unsqueeze(-1), v, psi)
        simpson = self.simpson.to(x.dtype)
        north = x[:, 0] + north @ simpson
        east = x[:, 1] + east @ simpson
        after = torch.cat(
            (torch.stack((north, east, end[:, 0], speed), dim=-1), end[:, 1:], rudder), dim=-1
        )
        return plant.finish_step(after, w, self.dt), s

"""Nomoto steering models at constant speed: first and second order, and with sideslip.

Source: Gouletas 2020, section 5.1.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, final

import torch
from torch import Tensor, nn

from residnet.core.columns import heading, surge, sway, yaw_rate
from residnet.core.frames import to_earth
from residnet.core.layout import SURGE, SWAY
from residnet.physics.actuators.base import Servo
from residnet.physics.plant import Plant

if TYPE_CHECKING:
    from residnet.physics.nomoto_config import NomotoVesselConfig


@final
class NomotoVessel(Plant):
    """Plant of a steering model at constant speed.

    The state x [B, 6 + k] is x, y [m], psi [rad], u, v [m/s], r [rad/s], the internal states of the
    model, then the states of the rudder. The input is cmd_delta [rad].
    """

    def __init__(self, config: NomotoVesselConfig) -> None:
        super().__init__()
        a, b, internal_states = config.state_space()
        self.speed = config.speed
        self.delta_max = config.rudder.limit
        self.servo = Servo(config.rudder.servo_spec("delta"))
        self.n_steering_states = 2 + len(internal_states)
        self.steering_columns = slice(SWAY, SWAY + self.n_steering_states)
        self.rudder_columns = slice(SWAY + self.n_steering_states, None)
        channels = config.plant_channels()
        self.state_names = channels.state_names
        self.input_names = channels.input_names
        self.n_commands = 1
        self.a = nn.Buffer(torch.from_numpy(a), persistent=False)
        self.b = nn.Buffer(torch.from_numpy(b), persistent=False)

    def commands_for_demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return the rudder command [..., 1] for a normalised steering command [...]."""
        return (steer.clamp(-1.0, 1.0) * self.delta_max).unsqueeze(-1)

    def rudder_angle(self, x: Tensor, w: Tensor) -> Tensor:
        """Return the rudder angle [B] in rad."""
        return self.servo.position(x[:, self.rudder_columns], w[:, :1])[:, 0]

    def derivative(self, x: Tensor, w: Tensor) -> Tensor:
        z = x[:, self.steering_columns]
        rudder_states = x[:, self.rudder_columns]
        steering_derivative = z @ self.a.to(x.dtype).T + self.rudder_angle(x, w).unsqueeze(
            -1
        ) * self.b.to(x.dtype)
        north, east = to_earth(surge(x), sway(x), heading(x))
        pose_derivative = torch.stack((north, east, yaw_rate(x), torch.zeros_like(north)), dim=-1)
        return torch.cat(
            (pose_derivative, steering_derivative, self.servo.derivative(rudder_states, w[:, :1])),
            dim=-1,
        )

    def finish_step(self, x: Tensor, w: Tensor, dt: float) -> Tensor:
        rudder_states = self.servo.advance_step(x[:, self.rudder_columns], w[:, :1], dt)
        return torch.cat((x[:, : self.rudder_columns.start], rudder_states), dim=-1)

    def make_initial_state(self, rows: int) -> Tensor:
        """Return the initial state [rows, nx]: straight-ahead motion at the speed of the model."""
        x = super().make_initial_state(rows)
        x[:, SURGE] = self.speed
        return x

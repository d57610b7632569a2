"""Input channels of baselines and heads (residual models).

They are velocities, commands, forces and relative wind. Position and heading are not channels,
because the dynamics in body axes do not depend on them. The true wind is transformed to wind
relative to the vessel with the predicted heading and velocity.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar, final

import torch
from torch import Tensor, nn

from residnet.core.columns import dynamic_states
from residnet.core.frames import to_body
from residnet.core.layout import (
    PLANAR_LAYOUT,
)
from residnet.core.renamed_state import RenamedStateModule
from residnet.core.samples import Samples
from residnet.physics.actuators.thrusters_config import DifferentialThrustConfig

if TYPE_CHECKING:
    from residnet.physics.signals_config import SignalsConfig


class Signals(nn.Module):
    """Computes the channels z [B, nz] from state x [B, nx] and inputs w [B, m].

    `prepare` evaluates the part that depends on the inputs only, once per time step; `forward`
    evaluates the other part at every stage of the integrator.

    Attributes:
        names: names of the columns of z.
    """

    def __init__(self, config: SignalsConfig) -> None:
        super().__init__()
        self.n_inputs = len(config.inputs)
        self.has_wind = len(config.exogenous) > 0
        thrusters = config.forces if isinstance(config.forces, DifferentialThrustConfig) else None
        self.has_forces = thrusters is not None
        input_columns = config.input_columns
        # unused indices are 0, because TorchScript takes no optional attributes
        self.speed_column = input_columns.index("wind_speed") if self.has_wind else 0
        self.direction_column = input_columns.index("wind_dir") if self.has_wind else 0
        self.thrusters: nn.Module = (
            nn.Identity() if thrusters is None else thrusters.build().thruster_forces
        )
        self.n_dof = config.dof.n_dynamic
        self.is_six_dof = config.dof.is_six_dof
        is_used = torch.tensor(
            [name not in config.dof.unmodelled_states for name in config.dof.dynamic_states]
        )
        self.used_velocities = nn.Buffer(is_used.double(), persistent=False)
        self.names: tuple[str, ...] = config.channel_names()
        self.n_channels = len(self.names)

    def prepare(self, w: Tensor) -> Tensor:
        """Compute the quantities [..., k] that are constant over a time step from w [..., m].

        They are inputs, forces and the wind velocity over ground (north, east).
        """
        # commands are constant over a step, so that the thrust and the true wind are evaluated once
        # per step and not at each stage of the integrator
        columns = [w[..., : self.n_inputs]]
        if self.has_forces:
            columns.append(self.thrusters(w[..., : self.n_inputs]))
        if self.has_wind:
            speed = w[..., self.speed_column]
            direction = w[..., self.direction_column]
            columns.append(
                # the direction is where the wind comes from: its velocity points the other way
                torch.stack((-speed * torch.cos(direction), -speed * torch.sin(direction)), dim=-1)
            )
        # joining a single part would copy it
        return columns[0] if len(columns) == 1 else torch.cat(columns, dim=-1)

    def forward(self, x: Tensor, p: Tensor) -> Tensor:
        """Compute the channels z [..., nz].

        Args:
            x: state [..., nx]: pose, then dynamic states.
            p: result of `prepare` for the inputs of the time step.
        """
        if self.is_six_dof:
            # depth and attitude are no channels; velocities that the model lacks are set to zero
            return torch.cat(
                (dynamic_states(x, self.n_dof) * self.used_velocities.to(x.dtype), p), dim=-1
            )
        if not self.has_wind:
            return torch.cat((dynamic_states(x, self.n_dof), p), dim=-1)
        n_inputs_and_forces = p.shape[-1] - 2
        wind_north = p[..., n_inputs_and_forces]
        wind_east = p[..., n_inputs_and_forces + 1]
        relative_x, relative_y = to_body(wind_north, wind_east, x[..., 2])
        relative_x = relative_x - x[..., 3]
        relative_y = relative_y - x[..., 4]
        # the offset keeps the gradient finite in a calm
        magnitude = torch.sqrt(relative_x * relative_x + relative_y * relative_y + 1e-8)
        return torch.cat(
            (
                dynamic_states(x, self.n_dof),
                p[..., :n_inputs_and_forces],
                torch.stack((relative_x, relative_y, magnitude), dim=-1),
            ),
            dim=-1,
        )


_MAX_ACCELERATION_STD = 10.0
"""Restoring acceleration half a training range outside the training range.

In standard deviations of the accelerations in the training data.
"""
_MIN_RATE = 0.05
"""Lower limit of the restoring rate of the velocity guard, 1/s."""
_MAX_RATE = 2.0
"""Upper limit of the restoring rate of the velocity guard, 1/s."""
_MIN_RANGE = 1e-9
"""Lower bound of the width of a range, for constant channels."""


@final
class SoftVelocityLimit(RenamedStateModule):
    """Acceleration [..., n] that returns velocities to their training range; zero inside the range.

    It is proportional to the excess of a velocity over its range. A fitted model is not valid
    outside the training range: without damping, its clamped acceleration would be integrated
    without limit. This is no hydrostatic restoring force, which depends on the position.

    Args:
        margin: widening of the training range on either side, as a share of its width.
        n_channels: number of channels, the velocities first, that are clamped to their ranges.
        n_dof: number of velocities n.
    """

    legacy_parameter_names: ClassVar[Mapping[str, str]] = {"rate": "restoring_rate"}

    def __init__(
        self,
        margin: float = 0.0,
        n_channels: int = PLANAR_LAYOUT.n_dof,
        n_dof: int = PLANAR_LAYOUT.n_dof,
    ) -> None:
        super().__init__()
        self.margin = margin
        self.n_channels = n_channels
        self.n_dof = n_dof
        self.low = nn.Buffer(torch.zeros(n_channels, dtype=torch.float64))
        self.high = nn.Buffer(torch.zeros(n_channels, dtype=torch.float64))
        self.restoring_rate = nn.Buffer(torch.zeros(n_dof, dtype=torch.float64))

    def calibrate(self, samples: Samples) -> None:
        """Compute the ranges of the channels, and the restoring rate from the accelerations."""
        channel_moments, target_moments = samples.running_moments()
        lower = channel_moments.minimum[: self.n_channels]
        upper = channel_moments.maximum[: self.n_channels]
        width = (upper - lower).clamp(min=_MIN_RANGE)
        self.low.copy_(lower - self.margin * width)
        self.high.copy_(upper + self.margin * width)
        acceleration_std = target_moments.std()
        self.restoring_rate.copy_(
            # rate * (half a range) = 10 standard deviations of the acceleration; the limits keep
            # the restoring term slower than a time step and faster than a drift
            (_MAX_ACCELERATION_STD * acceleration_std / (0.5 * width[: self.n_dof])).clamp(
                min=_MIN_RATE, max=_MAX_RATE
            )
        )

    def clamp(self, z: Tensor) -> Tensor:
        """Clamp channels z [..., nz] to their ranges."""
        lower = self.low.to(z.dtype)
        upper = self.high.to(z.dtype)
        clamped = z[..., : self.n_channels]
        # a refit differentiates this, and derivatives of minimum and maximum are slow
        clamped = torch.where(clamped > upper, upper, torch.where(clamped < lower, lower, clamped))
        return torch.cat((clamped, z[..., self.n_channels :]), dim=-1)

    def restoring_acceleration(self, clamped: Tensor, z: Tensor) -> Tensor:
        """Return the acceleration at channels z [..., nz], given the clamped channels."""
        return self.restoring_rate.to(z.dtype) * (clamped[..., : self.n_dof] - z[..., : self.n_dof])

    def forward(self, z: Tensor) -> Tensor:
        """Return the restoring acceleration at channels z [..., nz]."""
        return self.restoring_acceleration(self.clamp(z), z)

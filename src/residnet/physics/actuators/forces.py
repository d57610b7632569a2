"""Forces as commands: for plants whose actuators are not modelled but for their limits and their
lag.
"""

from __future__ import annotations

from typing import Annotated, Literal, final

import torch
from pydantic import Field
from torch import Tensor

from residnet.core.config import NewtonMetres, Newtons
from residnet.physics.actuators.base import ActuatorConfig, Actuators
from residnet.physics.actuators.servo import FirstOrderConfig, ImmediateConfig, SecondOrderConfig


class ForceCommandsConfig(ActuatorConfig):
    """Commands tau_x, tau_y [N], tau_n [N m], each within its limit; without `response` they act at
    once, with it their forces lag behind.
    """

    kind: Literal["forces"] = "forces"
    x_max: Newtons = Field(gt=0)
    y_max: Newtons = Field(ge=0)
    n_max: NewtonMetres = Field(gt=0)
    response: Annotated[
        ImmediateConfig | FirstOrderConfig | SecondOrderConfig, Field(discriminator="kind")
    ] = ImmediateConfig()

    def build(self) -> ForceCommands:
        """Return the module."""
        return ForceCommands(self)


@final
class ForceCommands(Actuators):
    """tau [..., 3] follows the saturated command [..., 3]; with a lag the states are the forces,
    then what else the response needs.
    """

    commands = ("tau_x", "tau_y", "tau_n")

    def __init__(self, config: ForceCommandsConfig) -> None:
        super().__init__()
        self.response = config.response.build(None)
        axes = ("x", "y", "n")
        self.state = tuple(
            f"{'_' if suffix else ''}acting_tau_{axis}{suffix}"
            for suffix in self.response.suffixes
            for axis in axes
        )
        self.held = not self.state
        self.register_buffer(
            "limit",
            torch.tensor([config.x_max, config.y_max, config.n_max], dtype=torch.float64),
            persistent=False,
        )
        self.limit: Tensor

    def demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Drive is surge force, steer the yaw moment, as shares of their limits."""
        both = torch.stack((drive, torch.zeros_like(drive), steer), dim=-1)
        return both.clamp(-1.0, 1.0) * self.limit.to(drive.dtype)

    def force(self, a: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        """Return tau [..., 3]."""
        return self.response.value(self._by_axis(a), self._target(command))

    def rate(self, a: Tensor, command: Tensor) -> Tensor:
        """Return the derivative [..., k] of the states."""
        return self.response.rate(self._by_axis(a), self._target(command)).mT.reshape(a.shape)

    def _target(self, command: Tensor) -> Tensor:
        """Return the command [..., 3] within the limits."""
        limit = self.limit.to(command.dtype)
        return torch.maximum(torch.minimum(command, limit), -limit)

    def _by_axis(self, a: Tensor) -> Tensor:
        """Return the states [..., k] as [..., 3, k / 3]: a row for each axis."""
        by_axis: Tensor = a.unflatten(-1, (len(self.response.suffixes), 3)).mT
        return by_axis

"""Forces as commands, for plants whose actuators are known by their limits and lag only."""

from __future__ import annotations

from typing import Annotated, Literal, final

import torch
from pydantic import Field
from torch import Tensor

from residnet.core.config import NewtonMetres, Newtons
from residnet.physics.actuators.base import ActuatorConfig, ForceActuators
from residnet.physics.actuators.servo import FirstOrderConfig, ImmediateConfig, SecondOrderConfig


class ForceCommandsConfig(ActuatorConfig):
    """The commands tau_x, tau_y [N], tau_n [N m], each within its limit.

    Attributes:
        x_max: largest surge force of either direction in N.
        y_max: largest sway force of either side in N.
        n_max: largest yaw moment of either side in N m.
        response: lag of the forces behind the commands; immediate by default.
    """

    kind: Literal["forces"] = "forces"
    x_max: Newtons = Field(gt=0)
    y_max: Newtons = Field(ge=0)
    n_max: NewtonMetres = Field(gt=0)
    response: Annotated[
        ImmediateConfig | FirstOrderConfig | SecondOrderConfig, Field(discriminator="kind")
    ] = ImmediateConfig()

    def build(self) -> ForceCommands:
        """Build the module that turns commands into forces."""
        return ForceCommands(self)


@final
class ForceCommands(ForceActuators):
    """The forces tau [..., 3], which follow the saturated commands [..., 3].

    With a lag the states are the forces, then what else the response needs.
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
        """Return tau [..., 3] for drive (surge force) and steer (yaw moment), each within +-1."""
        both = torch.stack((drive, torch.zeros_like(drive), steer), dim=-1)
        return both.clamp(-1.0, 1.0) * self.limit.to(drive.dtype)

    def allocate(self, tau: Tensor) -> Tensor:
        """Return the forces tau [..., 3] themselves."""
        return tau

    def asked(self, command: Tensor) -> Tensor:
        """Return the commands [..., 3] themselves."""
        return command

    def force(self, a: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        """Return the forces tau [..., 3] in N, N, N m."""
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

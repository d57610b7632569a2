"""Forces as commands: for plants whose actuators are not modelled, within their limits."""

from __future__ import annotations

from typing import Literal, final

import torch
from pydantic import Field
from torch import Tensor

from residnet.core.config import NewtonMetres, Newtons
from residnet.physics.actuators.base import ActuatorConfig, Actuators


class ForceCommandsConfig(ActuatorConfig):
    """Commands tau_x, tau_y [N], tau_n [N m] that act at once, each within its limit."""

    kind: Literal["forces"] = "forces"
    x_max: Newtons = Field(gt=0)
    y_max: Newtons = Field(ge=0)
    n_max: NewtonMetres = Field(gt=0)

    def build(self) -> ForceCommands:
        """The module."""
        return ForceCommands(self)


@final
class ForceCommands(Actuators):
    """tau [..., 3] = command [..., 3], saturated."""

    commands = ("tau_x", "tau_y", "tau_n")
    held = True

    def __init__(self, config: ForceCommandsConfig) -> None:
        super().__init__()
        self.register_buffer("limit", torch.tensor([config.x_max, config.y_max, config.n_max], dtype=torch.float64), persistent=False)
        self.limit: Tensor

    def demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Drive is surge force, steer the yaw moment, as shares of their limits."""
        both = torch.stack((drive, torch.zeros_like(drive), steer), dim=-1)
        return both.clamp(-1.0, 1.0) * self.limit.to(drive.dtype)

    def force(self, a: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        """tau [..., 3]."""
        limit = self.limit.to(command.dtype)
        return torch.maximum(torch.minimum(command, limit), -limit)

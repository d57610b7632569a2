"""An unknown slowly varying force, such as unmeasured wind: estimated from a measured past.

Along a measured past each step's velocities are compared with those that the step before predicted.
What is left over moves the estimate, as an observer does. In a free run the velocities are the
predicted ones, nothing is left over, and the estimate is held or decays. So one and the same step
serves both, and nothing has to tell it which is which.
"""

from __future__ import annotations

import math
from typing import final

import torch
from pydantic import Field
from torch import Tensor, nn

from residnet.core.config import Config, Seconds
from residnet.core.frames import to_body, to_earth
from residnet.core.layout import heading, velocities

SIZE = 7
"""Entries of the memory: whether there is a prediction, the predicted u, v, r, the estimate."""
_FARTHEST = 100.0
"""Largest velocity or acceleration that a memory may hold, SI."""


class DisturbanceConfig(Config):
    """Settings of an unknown force that a model estimates from the measured past.

    Attributes:
        settle: time constant at which the estimate follows what the model does not explain.
        decay: time constant at which it is forgotten; null holds it over the whole prediction.
    """

    settle: Seconds = Field(default=20.0, gt=0)
    decay: Seconds | None = Field(default=None, gt=0)

    def build(self, dt: float) -> Disturbance:
        """Return the observer for a step of dt."""
        return Disturbance(self, dt)


@final
class Disturbance(nn.Module):
    """The observer: an acceleration north and east and one in yaw, kept in the memory.

    Args:
        config: time constants.
        dt: step in s.
    """

    def __init__(self, config: DisturbanceConfig, dt: float) -> None:
        super().__init__()
        self.gain = (1.0 - math.exp(-dt / config.settle)) / dt
        self.keep = 1.0 if config.decay is None else math.exp(-dt / config.decay)

    def forward(self, x: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the acceleration in body axes [B, 3] and the new estimate [B, 3].

        Args:
            x: states at the step's start, measured or predicted [B, nx].
            s: memory of the step before [B, 7].
        """
        left = (velocities(x) - s[:, 1:4]) * s[:, :1]
        north, east = to_earth(left[:, 0], left[:, 1], heading(x))
        seen = torch.stack((north, east, left[:, 2]), dim=-1)
        estimate = self.keep * s[:, 4:7] + self.gain * seen
        ahead, across = to_body(estimate[:, 0], estimate[:, 1], heading(x))
        return torch.stack((ahead, across, estimate[:, 2]), dim=-1), estimate

    def remembered(self, after: Tensor, estimate: Tensor) -> Tensor:
        """Return the memory [B, 7] from the predicted states [B, nx] and the estimate [B, 3]."""
        return torch.cat((torch.ones_like(after[:, :1]), velocities(after), estimate), dim=-1)


def memory_range() -> tuple[Tensor, Tensor]:
    """Return the least and largest memory [7]."""
    most = torch.full((SIZE,), _FARTHEST, dtype=torch.float64)
    most[0] = 1.0
    least = -most
    least[0] = 0.0
    return least, most

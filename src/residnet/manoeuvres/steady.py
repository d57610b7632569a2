"""Recognition of a steady turn from the yaw rate, sample by sample."""

from __future__ import annotations

from typing import final

import torch
from pydantic import Field
from torch import Tensor, nn

from residnet.core.config import Config, Seconds


class SteadyConfig(Config):
    """The condition that a turn is steady: for `window` seconds r stays near its running mean.

    Attributes:
        window: how long it must stay, and time constant of the running mean; a few times what the
            vessel needs to sail its length.
        tolerance: how far it may be off, as a share of the largest yaw rate of the manoeuvre so
            far.
    """

    window: Seconds = Field(default=10.0, gt=0)
    tolerance: float = Field(default=0.005, gt=0)


@final
class Steady(nn.Module):
    """The recognition of a steady yaw rate.

    Memory [B, 3]: running mean of r, largest |r| so far, and for how long r has been near the mean.
    """

    width = 3

    def __init__(self, configs: list[SteadyConfig], dt: float) -> None:
        super().__init__()
        self.window = torch.tensor([c.window for c in configs], dtype=torch.float64)
        self.tolerance = torch.tensor([c.tolerance for c in configs], dtype=torch.float64)
        self.dt = dt

    def initial(self, r: Tensor) -> Tensor:
        """Return the memory [B, 3] at the first yaw rate [B]."""
        return torch.stack((r, r.abs(), torch.zeros_like(r)), dim=-1)

    def forward(self, r: Tensor, memory: Tensor) -> Tensor:
        """Return the memory one step later, with yaw rate r [B]."""
        mean, largest, calm = memory.unbind(-1)
        mean = mean + (self.dt / self.window).clamp(max=1.0).to(r.dtype) * (r - mean)
        largest = torch.maximum(largest, r.abs())
        near = (r - mean).abs() <= self.tolerance.to(r.dtype) * largest
        return torch.stack(
            (mean, largest, torch.where(near, calm + self.dt, torch.zeros_like(calm))), dim=-1
        )

    def reached(self, memory: Tensor) -> Tensor:
        """Return which rows [B] are steady."""
        return memory[:, 2] >= self.window.to(memory.dtype) - 1e-9

    def restart(self, memory: Tensor, where: Tensor) -> Tensor:
        """Return the memory with the wait begun anew in rows [B] bool."""
        return torch.cat(
            (memory[:, :2], memory[:, 2:].masked_fill(where.unsqueeze(-1), 0.0)), dim=-1
        )

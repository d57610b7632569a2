"""Velocities kept near their training range by models that know nothing beyond it."""

from __future__ import annotations

from typing import final

import torch
from torch import Tensor, nn

from residnet.core.layout import PLANAR
from residnet.core.samples import Samples

_STRONG = 10.0
"""Accelerations, in standard deviations, that are balanced half a range beyond the edge."""
_SLOWEST, _FASTEST = 0.05, 2.0
"""Limits of the rate in 1/s at which velocities are pulled back."""
_LEAST = 1e-9


@final
class VelocityBound(nn.Module):
    """An acceleration [..., 3] that pulls velocities back which left their range, else zero.

    Beyond the range of the training data a fitted model knows nothing: with nothing to damp it,
    what it last said would drive the vessel on for ever.

    Args:
        margin: share of the training range by which it is widened on either side.
        channels: number of channels, the velocities first, that `held` keeps in their range: what
            an input does far beyond it is as little known.
    """

    def __init__(self, margin: float = 0.0, channels: int = PLANAR.dof) -> None:
        super().__init__()
        self.margin = margin
        self.channels = channels
        for name, count in (("low", channels), ("high", channels), ("rate", PLANAR.dof)):
            self.register_buffer(name, torch.zeros(count, dtype=torch.float64))
        self.low: Tensor
        self.high: Tensor
        self.rate: Tensor

    def calibrate(self, samples: Samples) -> None:
        """Take the ranges of the channels, and the rate from the accelerations."""
        seen, target = samples.tally()
        low, high = seen.low[: self.channels], seen.high[: self.channels]
        wide = (high - low).clamp(min=_LEAST)
        self.low.copy_(low - self.margin * wide)
        self.high.copy_(high + self.margin * wide)
        spread = target.std()
        self.rate.copy_(
            (_STRONG * spread / (0.5 * wide[: PLANAR.dof])).clamp(min=_SLOWEST, max=_FASTEST)
        )

    def held(self, z: Tensor) -> Tensor:
        """Return channels z [..., nz], where those that left their range stand at its edge."""
        low, high = self.low.to(z.dtype), self.high.to(z.dtype)
        near = z[..., : self.channels]
        # a refit differentiates this, and derivatives of minimum and maximum are slow
        near = torch.where(near > high, high, torch.where(near < low, low, near))
        return torch.cat((near, z[..., self.channels :]), dim=-1)

    def back(self, held: Tensor, z: Tensor) -> Tensor:
        """Return the acceleration at channels z [..., nz] whose held ones are known."""
        return self.rate.to(z.dtype) * (held[..., :3] - z[..., :3])

    def along(self, z: Tensor, ahead: Tensor) -> Tensor:
        """Return directions [D, B, nz] from channels z [B, nz] as the held ones go along them."""
        near = z[:, : self.channels]
        inside = (near >= self.low.to(z.dtype)) & (near <= self.high.to(z.dtype))
        held = ahead[..., : self.channels] * inside
        return torch.cat((held, ahead[..., self.channels :]), dim=-1)

    def forward(self, z: Tensor) -> Tensor:
        """Return the acceleration at channels z [..., nz]."""
        return self.back(self.held(z), z)

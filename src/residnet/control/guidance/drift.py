"""Integral action of line-of-sight guidance against an unmeasured current."""

from __future__ import annotations

from typing import final

import torch
from torch import Tensor, nn

from residnet.core.errors import ConfigError

_MOST = 1.0
"""Tangent of the largest crab angle."""


@final
class DriftEstimate(nn.Module):
    """An estimate of how a steady current sets the vessel across its way.

    It is the integral of E. Borhaug, A. Pavlov and K. Y. Pettersen (Integral LOS control for path
    following of underactuated marine surface vessels in the presence of constant ocean currents,
    CDC 2008; T. I. Fossen, Handbook of Marine Craft Hydrodynamics and Motion Control, section
    12.3).

    heading_d = direction - atan(e / distance + D), dD/dt = gain e / (distance^2 + (e + distance
    D)^2), their D being sigma e_int / distance. At rest e = 0 and D is the tangent of the crab
    angle asin(V_c / U) for a current V_c across the way of a vessel at speed U.

    A current keeps its direction over ground while the way bends. So D is kept as a vector, north
    and east, that only its part across the way steers by and that grows only there: what one leg
    has taught is known on the next.

    Memory s [B, 2]: the vector, at most one long.

    Args:
        distance: look-ahead in m.
        gain: sigma in m/s. With a quarter of the speed both poles of the error lie at U / (2
            distance).
        dt: step in s.

    Raises:
        ConfigError: where one of them is not above zero.
    """

    def __init__(self, distance: float, gain: float, dt: float) -> None:
        super().__init__()
        if distance <= 0 or gain <= 0 or dt <= 0:
            raise ConfigError(
                "integral line of sight: distance, gain and step must be above zero, given"
                f" {distance:g} m, {gain:g} m/s, {dt:g} s"
            )
        self.distance, self.gain, self.dt = distance, gain, dt
        self.most = _MOST

    def across(self, direction: Tensor, s: Tensor) -> Tensor:
        """Return the part [B] to starboard of a direction [B] in rad."""
        return torch.cos(direction) * s[:, 1] - torch.sin(direction) * s[:, 0]

    def along(self, direction: Tensor, s: Tensor) -> Tensor:
        """Return the part [B] along a direction [B] in rad."""
        return torch.cos(direction) * s[:, 0] + torch.sin(direction) * s[:, 1]

    def forward(self, error: Tensor, direction: Tensor, s: Tensor) -> Tensor:
        """Return the memory after a step.

        Args:
            s: memory [B, 2].
            error: cross-track error [B] in m.
            direction: of the way [B] in rad.
        """
        aim = error + self.distance * self.across(direction, s)
        grown = self.dt * self.gain * error / (self.distance**2 + aim.square())
        s = s + grown.unsqueeze(-1) * torch.stack(
            (-torch.sin(direction), torch.cos(direction)), dim=-1
        )
        return s / (s.square().sum(dim=-1, keepdim=True).sqrt() / self.most).clamp(min=1.0)

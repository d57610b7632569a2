"""Thrust over revolutions: a polynomial per direction and the range it was measured in.

Thrust never opposes the sense of rotation.
"""

from __future__ import annotations

from typing import Protocol, final

import torch
from torch import Tensor, nn

from residnet.core.config import RevsPerSecond

Coefficients = tuple[float, float, float]
CurveRange = tuple[RevsPerSecond, RevsPerSecond]
"""Revolutions (astern, ahead) between which a curve was measured."""


class Curved(Protocol):
    """A config with a thrust curve and the limits of its shaft."""

    @property
    def n_max(self) -> float:
        """Largest revolutions of either direction in 1/s."""

    @property
    def curve_range(self) -> CurveRange | None:
        """Revolutions (astern, ahead) that the curve was measured between."""


def require_range(config: Curved) -> None:
    """Stop where a shaft may turn faster than its thrust curve is known.

    Raises:
        ValueError: naming both.
    """
    if config.curve_range is None:
        return
    low, high = config.curve_range
    if low > -config.n_max or high < config.n_max:
        raise ValueError(
            f"curve_range {low * 60:g} to {high * 60:g} rpm does not reach n_max"
            f" (+-{config.n_max * 60:g} rpm); lower n_max or measure the curve further"
        )


@final
class ThrustCurve(nn.Module):
    """The curve T = c0 + c1 n + c2 n^2 [N], with coefficients of its own for n < 0 [1/s].

    It is clipped at zero (correction W5).
    """

    def __init__(self, forward: Coefficients, reverse: Coefficients) -> None:
        super().__init__()
        self.register_buffer("ahead", torch.tensor(forward, dtype=torch.float64), persistent=False)
        self.register_buffer("astern", torch.tensor(reverse, dtype=torch.float64), persistent=False)
        self.ahead: Tensor
        self.astern: Tensor

    def forward(self, n: Tensor) -> Tensor:
        """Return the thrust [N] at revolutions n [1/s], any shape."""
        f, b = self.ahead.to(n.dtype), self.astern.to(n.dtype)
        ahead = (f[0] + n * (f[1] + n * f[2])).clamp(min=0.0)
        astern = (b[0] + n * (b[1] + n * b[2])).clamp(max=0.0)
        return torch.where(n > 0, ahead, torch.where(n < 0, astern, torch.zeros_like(n)))

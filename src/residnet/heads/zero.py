"""The head of a model without a residual."""

from __future__ import annotations

from typing import final

import torch
from torch import Tensor

from residnet.heads.base import ResidualHead


@final
class ZeroHead(ResidualHead):
    """A head without a residual, rho = 0: the baseline alone."""

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return zeros [..., 3]."""
        return torch.zeros_like(z[..., :3]), s

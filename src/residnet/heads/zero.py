"""The head of a model without a residual."""

from __future__ import annotations

from typing import final

from torch import Tensor

from residnet.core.columns import zero_acceleration
from residnet.heads.base import ResidualHead


@final
class ZeroHead(ResidualHead):
    """A head without a residual, rho = 0: the baseline alone."""

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        return zero_acceleration(z, self.dof), s

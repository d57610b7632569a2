"""A head with an intentional defect: the result of a row depends on the other rows of the batch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, final

from torch import Tensor, nn

from residnet.heads.base import Features, ResidualHead, ResidualScale
from residnet.heads.config import BaseHeadConfig


class CrowdedConfig(BaseHeadConfig):
    """Linear map of features that are centred over the batch, which violates the contract.

    Attributes:
        kind: name of this head in a config.
    """

    kind: Literal["crowded"] = "crowded"

    def build(self, names: Sequence[str]) -> ResidualHead:
        """Build the head for channels `names`."""
        return CrowdedHead(self, names)


@final
class CrowdedHead(ResidualHead):
    """Head with the residual rho = std * W (f - mean of f over the batch)."""

    def __init__(self, config: CrowdedConfig, names: Sequence[str]) -> None:
        super().__init__(names)
        self.features = Features(config.select_features(names), names, config.margin)
        self.scale = ResidualScale(self.n_dof)
        self.readout = nn.Linear(self.features.n_features, self.n_dof)

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return a residual [B, n] that depends on all rows of the batch."""
        f = self.features(z)
        return self.scale(self.readout(f - f.mean(dim=0))), s

"""A head that is wrong on purpose: the answer for one vessel depends on all others of the batch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, final

from torch import Tensor, nn

from residnet.core.samples import Samples
from residnet.heads.base import BaseHeadConfig, Features, ResidualHead, ResidualScale


class CrowdedConfig(BaseHeadConfig):
    """A linear map of channels that are centred over the batch, which no head may do.

    Attributes:
        kind: names this head in a config.
    """

    kind: Literal["crowded"] = "crowded"

    def build(self, names: Sequence[str]) -> ResidualHead:
        """Return the head for channels `names`."""
        return CrowdedHead(self, names)


@final
class CrowdedHead(ResidualHead):
    """rho = spread * W (f - mean of f over the batch)."""

    def __init__(self, config: CrowdedConfig, names: Sequence[str]) -> None:
        super().__init__()
        self.features = Features(config.select_features(names), names, config.margin)
        self.scale = ResidualScale()
        self.readout = nn.Linear(self.features.n_features, 3)

    def calibrate(self, samples: Samples) -> None:
        """Take the scales of features and residual from the samples."""
        self.features.calibrate(samples)
        self.scale.calibrate(samples)

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return a residual [B, 3] that changes with the company that a row is in."""
        f = self.features(z)
        return self.scale(self.readout(f - f.mean(dim=0))), s

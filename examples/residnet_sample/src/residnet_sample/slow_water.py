"""A recurrent head: the residual depends on low-pass filtered channels, such as entrained water."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal, final

import torch
from pydantic import Field
from torch import Tensor, nn

from residnet.core.config import Seconds
from residnet.heads.base import Features, ResidualHead, ResidualScale
from residnet.heads.config import BaseHeadConfig


class SlowWaterConfig(BaseHeadConfig):
    """Linear map of the features and of their low-pass filtered values.

    Attributes:
        kind: name of this head in a config.
        time_constant: time constant of the low-pass filter.
    """

    kind: Literal["slow_water"] = "slow_water"
    time_constant: Annotated[Seconds, Field(gt=0)] = 2.0

    def build(self, names: Sequence[str]) -> ResidualHead:
        """Build the head for channels `names`."""
        return SlowWaterHead(self, names)


@final
class SlowWaterHead(ResidualHead):
    """Head with the residual rho = std * W [f, s], where s are filtered features f."""

    def __init__(self, config: SlowWaterConfig, names: Sequence[str]) -> None:
        super().__init__(names)
        self.features = Features(config.select_features(names), names, config.margin)
        self.scale = ResidualScale(self.n_dof)
        self.n_state = self.features.n_features
        self.time_constant = config.time_constant
        self.share = 1.0
        self.readout = nn.Linear(2 * self.features.n_features, self.n_dof)
        # start near the baseline
        with torch.no_grad():
            self.readout.weight.mul_(0.1)
            self.readout.bias.zero_()

    def set_step(self, dt: float) -> None:
        """Set the time step of the model in s, which determines the filter coefficient."""
        self.share = min(dt / self.time_constant, 1.0)

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the residual [B, n] at channels z [B, nz], and the filtered features after it."""
        f = self.features(z)
        s = s + self.share * (f - s)
        return self.scale(self.readout(torch.cat((f, s), dim=-1))), s

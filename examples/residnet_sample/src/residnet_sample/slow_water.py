"""A head with a memory: the water that a turning hull has set in motion follows it slowly."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal, final

import torch
from pydantic import Field
from torch import Tensor, nn

from residnet.core.config import Seconds
from residnet.core.samples import Samples
from residnet.heads.base import BaseHeadConfig, Features, ResidualHead, ResidualScale


class SlowWaterConfig(BaseHeadConfig):
    """A linear map of the channels and of their running means.

    Attributes:
        kind: names this head in a config.
        time_constant: of the running means, in s.
        step: of the model, in s; the head is stepped once per step of the model.
    """

    kind: Literal["slow_water"] = "slow_water"
    time_constant: Annotated[Seconds, Field(gt=0)] = 2.0
    step: Annotated[Seconds, Field(gt=0)] = 0.1

    def build(self, names: Sequence[str]) -> ResidualHead:
        """Return the head for channels `names`."""
        return SlowWaterHead(self, names)


@final
class SlowWaterHead(ResidualHead):
    """rho = spread * (W [f, s]), where s follows the features f with a first-order lag."""

    def __init__(self, config: SlowWaterConfig, names: Sequence[str]) -> None:
        super().__init__()
        self.features = Features(config.select_features(names), names, config.margin)
        self.scale = ResidualScale()
        self.n_state = self.features.n_features
        self.share = min(config.step / config.time_constant, 1.0)
        self.readout = nn.Linear(2 * self.features.n_features, 3)
        with torch.no_grad():
            self.readout.weight.mul_(0.1)
            self.readout.bias.zero_()

    def calibrate(self, samples: Samples) -> None:
        """Take the scales of features and residual from the samples."""
        self.features.calibrate(samples)
        self.scale.calibrate(samples)

    def spread(self) -> Tensor:
        """Return the spread of the residual on the training samples, [3]."""
        return self.scale.std

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the residual [B, 3] at channels z [B, nz] and the running means one step later."""
        f = self.features(z)
        s = s + self.share * (f - s)
        return self.scale(self.readout(torch.cat((f, s), dim=-1))), s

    def teacher_forced_residuals(self, z: Tensor) -> Tensor:
        """Return residuals [B, T, 3] along channels [B, T, nz], from an empty memory."""
        s = torch.zeros(z.shape[0], self.n_state, dtype=z.dtype, device=z.device)
        residuals = []
        for k in range(z.shape[1]):
            rho, s = self.forward(z[:, k], s)
            residuals.append(rho)
        return torch.stack(residuals, dim=1)

    def warmup(self, z: Tensor) -> Tensor:
        """Return the running means [B, n_state] that past channels [B, T, nz] leave."""
        s = torch.zeros(z.shape[0], self.n_state, dtype=z.dtype, device=z.device)
        for k in range(z.shape[1]):
            s = s + self.share * (self.features(z[:, k]) - s)
        return s

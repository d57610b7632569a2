"""Recurrent networks that run side by side: K sets of weights in one program."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, final

import torch
from pydantic import Field
from torch import Tensor, nn

from residnet.core.config import Seconds
from residnet.heads.base import FeatureConfig, Features, ResidualHead, ResidualScale
from residnet.physics.signals import VelocityBound

_FAR = 4.0
"""Standard deviations of the residual at which what was predicted wrong counts no further."""
_LEAST = 1e-13
"""Least share of a memory that is kept: float32 knows its logarithm."""


class RecurrentConfig(FeatureConfig):
    """K gated recurrent units (Cho and others 2014) whose weights are found side by side.

    Their gates are shares of a memory kept over `step`; over a shorter step of the model as many
    roots of them are taken. So networks that are trained in coarse steps run in fine ones.

    Beside the channels they see by what the measured past was predicted wrong: the error of the
    acceleration, low-passed over two of their steps. In a free run it decays, and the memory holds
    what it told.

    Attributes:
        members: number of networks; each runs on states of its own, and velocities are averaged.
        hidden_size: number of hidden units of each.
        step: that the gates belong to.
        restoring: velocities that leave their training range are pulled back into it, so that
            networks that stand alone cannot run away.
    """

    kind: Literal["recurrent"] = "recurrent"
    members: int = Field(default=1, ge=1, le=100)
    hidden_size: int = Field(default=32, ge=1, le=1_000)
    step: Seconds = Field(default=0.5, gt=0)
    restoring: bool = False

    def build(self, names: Sequence[str]) -> ResidualHead:
        """Return the module for channels `names`."""
        return RecurrentHead(self, names)


@final
class RecurrentHead(ResidualHead):
    """K networks with leading axes of weights; rows are those of one network after the other.

    Rows of z [K B, nz (+ n)] and s [K B, H] belong to the network that their K-th part belongs to.
    Behind the channels may stand the errors of accelerations that the past was predicted with.
    """

    def __init__(self, config: RecurrentConfig, names: Sequence[str]) -> None:
        super().__init__(names)
        self.copies, self.n_state = config.members, config.hidden_size
        self.coarse, self.settle = config.step, 2.0 * config.step
        self.share, self.far, self.least = 1.0, _FAR, _LEAST
        self.channels = len(names)
        self.features = Features(config.chosen(names), names, config.margin)
        self.scale = ResidualScale(self.dof)
        self.restoring: VelocityBound | None = (
            VelocityBound(channels=self.dof, dof=self.dof) if config.restoring else None
        )
        self.seen = seen = self.features.count + self.dof
        hidden = config.hidden_size

        def drawn(*shape: int) -> nn.Parameter:
            bound = 1.0 / math.sqrt(hidden)
            return nn.Parameter(torch.empty(config.members, *shape).uniform_(-bound, bound))

        self.w_input, self.w_hidden = drawn(seen, 3 * hidden), drawn(hidden, 3 * hidden)
        self.bias, self.bias_hidden = drawn(1, 3 * hidden), drawn(1, hidden)
        self.w_out, self.w_skip = drawn(hidden, self.dof), drawn(seen, self.dof)
        self.bias_out = nn.Parameter(torch.zeros(config.members, 1, self.dof))
        with torch.no_grad():
            for weight in (self.w_out, self.w_skip):
                weight.mul_(0.1)

    def set_step(self, dt: float) -> None:
        self.share = dt / self.coarse

    def residual_std(self) -> Tensor:
        return self.scale.spread

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return residuals [K B, n] at channels z [K B, nz (+ n)] and memories for the next step.

        Where no errors stand behind the channels they are zero.
        """
        if z.shape[-1] > self.channels:
            z, wrong = z.split([self.channels, self.dof], dim=-1)
            wrong = self.far * torch.tanh(wrong / (self.far * self.scale.spread.to(z.dtype)))
        else:
            wrong = torch.zeros_like(z[..., : self.dof])
        f = torch.cat((self.features(z), wrong), dim=-1).view(self.copies, -1, self.seen)
        h = self.gated(torch.baddbmm(self.bias, f, self.w_input), s)
        out = torch.baddbmm(torch.baddbmm(self.bias_out, f, self.w_skip), h, self.w_out)
        rho: Tensor = self.scale(out.reshape(-1, self.dof))
        if self.restoring is not None:
            rho = rho + self.restoring(z)
        return rho, h.reshape(-1, self.n_state)

    def gated(self, share: Tensor, s: Tensor) -> Tensor:
        """Return the outputs [K, B, H] from the features' share [K, B, 3 H] and memories."""
        hidden = self.n_state
        h = s.reshape(self.copies, -1, hidden)
        # splits in place of slices: their gradients are joined and not added up
        gates, new = share.split([2 * hidden, hidden], dim=-1)
        held, old = torch.bmm(h, self.w_hidden).split([2 * hidden, hidden], dim=-1)
        kept, reset = torch.sigmoid(gates + held).chunk(2, dim=-1)
        if self.share != 1.0:
            kept = torch.exp(self.share * torch.log(kept.clamp(min=self.least)))
        new = torch.tanh(new + reset * (old + self.bias_hidden))
        return new + kept * (h - new)

    def sequence(self, z: Tensor) -> Tensor:
        s = torch.zeros(z.shape[0], self.n_state, dtype=z.dtype, device=z.device)
        residuals: list[Tensor] = []
        for k in range(z.shape[1]):
            rho, s = self.forward(z[:, k], s)
            residuals.append(rho)
        return torch.stack(residuals, dim=1)

    def warmup(self, z: Tensor) -> Tensor:
        s = torch.zeros(z.shape[0], self.n_state, dtype=z.dtype, device=z.device)
        for k in range(z.shape[1]):
            s = self.forward(z[:, k], s)[1]
        return s

    def memory_range(self) -> tuple[Tensor, Tensor]:
        """Return the least and largest memory [H]: units are mixtures of hyperbolic tangents."""
        limit = self.bias.detach().new_ones(self.n_state)
        return -limit, limit

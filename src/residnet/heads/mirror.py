"""Heads (residual models) that are mirror-symmetric by construction, and a fast hyperbolic tangent.

Hulls are symmetric between port and starboard within the accuracy of the data. Building in this
symmetry halves the range of states that a network has to learn.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import ClassVar, final

import torch
from torch import Tensor, nn

from residnet.core.renamed_state import RenamedStateModule
from residnet.core.samples import Samples
from residnet.heads.base import ResidualHead
from residnet.physics.symmetry import get_axis_parities, require_mirror_image


def fast_tanh(x: Tensor, min_size: int = 8_192) -> Tensor:
    """Compute the hyperbolic tangent of x [...], for large tensors from the logistic function.

    On CPUs the sigmoid of torch is several times as fast as its tanh; with gradients this takes
    55 % of the time. Results agree within rounding errors. Traced graphs and tensors of fewer than
    `min_size` elements use the tanh of torch, where one operation is faster than three.
    """
    is_traced = False
    if not torch.jit.is_scripting():  # type: ignore[attr-defined]
        is_traced = torch.compiler.is_compiling()
    if is_traced or x.device.type != "cpu" or x.numel() < min_size:
        return torch.tanh(x)
    return 2.0 * torch.sigmoid(2.0 * x) - 1.0


@final
class Tanh(nn.Module):
    """Layer of the fast hyperbolic tangent, without parameters."""

    def forward(self, x: Tensor) -> Tensor:
        """Return the hyperbolic tangent of x [...]."""
        return fast_tanh(x)


@final
class MirroredHead(RenamedStateModule, ResidualHead):
    """Head with the residual rho = (g(z) + M g(M z)) / 2 of an inner head g.

    M mirrors port and starboard. Channels and mirror images are evaluated as one batch of twice the
    size, and the memory is the concatenation of both memories.
    """

    legacy_parameter_names: ClassVar[Mapping[str, str]] = {"inner": "inner_head"}

    def __init__(self, inner: ResidualHead, names: Sequence[str]) -> None:
        super().__init__(names)
        mirror = require_mirror_image(names)
        self.inner_head = inner
        self.inner_state_size = inner.n_state
        self.n_state = 2 * inner.n_state
        self.mirror_index = nn.Buffer(torch.tensor(mirror[0], dtype=torch.long), persistent=False)
        self.mirror_sign = nn.Buffer(torch.tensor(mirror[1], dtype=torch.float64), persistent=False)
        self.axis_sign = nn.Buffer(
            torch.tensor(get_axis_parities(names), dtype=torch.float64), persistent=False
        )

    def calibrate(self, samples: Samples) -> None:
        """Calibrate the inner head on the samples and their mirror images.

        The range of channel values that the head records as seen in training is then symmetric.
        """
        self.inner_head.calibrate(add_mirror_images(samples))

    def residual_scale(self) -> Tensor:
        return self.inner_head.residual_scale()

    def stack_mirrored(self, z: Tensor) -> Tensor:
        """Return channels and their mirror images, [2 B, ...]."""
        return torch.cat(
            (z, z.index_select(-1, self.mirror_index) * self.mirror_sign.to(z.dtype)), dim=0
        )

    def average_mirrored(self, rho: Tensor) -> Tensor:
        """Return the mean of residuals [2 B, ..., n] and their mirror images, [B, ..., n]."""
        batch_size = rho.shape[0] // 2
        return 0.5 * (rho[:batch_size] + rho[batch_size:] * self.axis_sign.to(rho.dtype))

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        rho, next_memory = self.inner_head(
            self.stack_mirrored(z),
            # columns of the memory become rows of the doubled batch
            torch.cat((s[:, : self.inner_state_size], s[:, self.inner_state_size :]), dim=0),
        )
        batch_size = z.shape[0]
        return self.average_mirrored(rho), torch.cat(
            (next_memory[:batch_size], next_memory[batch_size:]), dim=-1
        )

    def teacher_forced_residuals(self, z: Tensor) -> Tensor:
        return self.average_mirrored(
            self.inner_head.teacher_forced_residuals(self.stack_mirrored(z))
        )

    def warmup(self, z: Tensor) -> Tensor:
        s = self.inner_head.warmup(self.stack_mirrored(z))
        batch_size = z.shape[0]
        return torch.cat((s[:batch_size], s[batch_size:]), dim=-1)

    def memory_bounds(self) -> tuple[Tensor, Tensor]:
        """Return the bounds of the memory [n_state]: the bounds of the inner head twice."""
        lower, upper = self.inner_head.memory_bounds()
        return lower.repeat(2), upper.repeat(2)


def add_mirror_images(samples: Samples) -> Samples:
    """Return samples followed by their mirror images.

    Raises:
        ConfigError: if the image of a channel is unknown.
    """
    index, signs = require_mirror_image(samples.names)
    axis_signs = samples.target.new_tensor(get_axis_parities(samples.names))
    return replace(
        samples,
        z=torch.cat((samples.z, samples.z[:, index] * samples.z.new_tensor(signs))),
        target=torch.cat((samples.target, samples.target * axis_signs)),
        group=torch.cat((samples.group, samples.group)),
        t=torch.cat((samples.t, samples.t)),
    )

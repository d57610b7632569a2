"""The hyperbolic tangent of large batches in a fraction of the time of torch's own."""

from __future__ import annotations

from typing import final

import torch
from torch import Tensor, nn


def quick_tanh(x: Tensor, many: int = 8_192) -> Tensor:
    """Return the hyperbolic tangent of x [...], by way of the logistic function where x is large.

    On processors torch computes its sigmoid several times as fast as its tanh. Both ways agree to
    the rounding of numbers near one. Gradients and traced graphs keep to torch's own, and so do
    fewer than `many` numbers, for which three operations take longer than one.
    """
    traced = False
    if not torch.jit.is_scripting():  # type: ignore[attr-defined]
        traced = torch.compiler.is_compiling()
    if traced or torch.is_grad_enabled() or x.device.type != "cpu" or x.numel() < many:
        return torch.tanh(x)
    return (2.0 * x).sigmoid_().mul_(2.0).sub_(1.0)


@final
class Tanh(nn.Module):
    """The hyperbolic tangent as a layer, without parameters."""

    def forward(self, x: Tensor) -> Tensor:
        """Return the hyperbolic tangent of x [...]."""
        return quick_tanh(x)

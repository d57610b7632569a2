"""Training losses over windows; pure tensor code."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from residnet.core.layout import velocities
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.rollout import FreeRun

Shared = Callable[[Tensor], Tensor]
"""A sum over this process's windows to the mean of the sums of all processes."""


def alone(value: Tensor) -> Tensor:
    """Return the mean over one process: the value itself."""
    return value


def one_step_loss(
    model: HybridDynamics,
    y: Tensor,
    w: Tensor,
    nu_dot: Tensor,
    good: Tensor,
    spread: Tensor,
    shared: Shared = alone,
) -> Tensor:
    """Return the mean squared error of accelerations along windows (document 003 eq. (20)).

    In units of the residual's spread.

    Args:
        model: the hybrid model.
        y: smoothed states [B, T, 6].
        w: inputs at the same samples [B, T, m].
        nu_dot: accelerations [B, T, 3].
        good: samples that count: acceleration known, memory filled [B, T].
        spread: of the residual, [3].
        shared: over the processes of a training, whose mean loss is that of all windows.
    """
    error = (nu_dot - model.one_step(model.channels(y, w))) / spread
    weight = good.to(error.dtype).unsqueeze(-1)
    return (error.square() * weight).sum() / shared(3.0 * weight.sum()).clamp(min=1.0)


def rollout_loss(
    rollout: FreeRun,
    x0: Tensor,
    w: Tensor,
    s: Tensor,
    y: Tensor,
    usable: Tensor,
    scales: Tensor,
    robust: float,
    shared: Shared = alone,
) -> Tensor:
    """Return the error of free-run velocities, in units of the metrics' scales.

    The mean square, or the mean over windows of their root mean square.

    Args:
        rollout: the free run of the model, as `Rollout` gives it.
        x0: initial states [B, 6].
        w: inputs [B, T, m].
        s: initial memory [B, n_state].
        y: measured states after each step [B, T, 6].
        usable: measured samples that may be scored [B, T].
        scales: [3].
        robust: 0 for the mean square; else windows count by sqrt(mean square + robust^2), as the
            metrics do, so that few bad ones do not rule.
        shared: over the processes of a training, whose mean loss is that of all windows.
    """
    states, _, _ = rollout(x0, w, s)
    error = (velocities(states[:, 1:]) - velocities(y)) / scales
    weight = usable.to(error.dtype).unsqueeze(-1)
    if robust > 0:
        square = (error.square() * weight).sum((1, 2)) / (3.0 * weight.sum((1, 2))).clamp(min=1.0)
        return torch.sqrt(square + robust**2).sum() / shared(torch.ones_like(square).sum())
    # a rollout that runs away must pull back, not drown the batch
    square = 2.0 * torch.nn.functional.huber_loss(
        error, torch.zeros_like(error), reduction="none", delta=5.0
    )
    return (square * weight).sum() / shared(3.0 * weight.sum()).clamp(min=1.0)

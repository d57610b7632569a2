"""Coefficients of a baseline that move with a network, by steps that their refit leaves open."""

from __future__ import annotations

from typing import final

import torch
from torch import Tensor, nn

from residnet.baselines import ParametricBaseline
from residnet.dynamics.hybrid import HybridDynamics

PACE = 20.0
"""Step of a coefficient, in standard errors, for a step of one of a network's weight."""


@final
class Calibration(nn.Module):
    """The coefficients theta = theta_0 + root q; q [P] is what is trained, and starts at zero.

    The root is that of the covariance of the coefficients, so that one unit of q is one standard
    error along a direction that the data see as independent of the others. A coefficient in SI
    units knows no learning rate: what is much for one is nothing for the next.

    Args:
        model: whose baseline has the coefficients, as they are now.
        covariance: of the P coefficients that may move, [P, P].
    """

    def __init__(self, model: HybridDynamics, covariance: Tensor) -> None:
        super().__init__()
        baseline = model.baseline
        assert isinstance(baseline, ParametricBaseline), "the settings were validated"
        values, vectors = torch.linalg.eigh(0.5 * (covariance + covariance.T).to(torch.float64))
        root = vectors * values.clamp(min=0.0).sqrt()
        dtype = baseline.theta.dtype
        self.moved = nn.Parameter(torch.zeros(root.shape[1], dtype=dtype))
        self.register_buffer("root", root.to(dtype), persistent=False)
        self.register_buffer("start", baseline.theta.detach().clone(), persistent=False)
        self.register_buffer("active", baseline.free_indices(), persistent=False)
        self.root: Tensor
        self.start: Tensor
        self.active: Tensor

    def forward(self) -> Tensor:
        """Return theta, of the shape that the baseline keeps it in."""
        change = torch.zeros_like(self.start).flatten()
        moved = change.index_add(0, self.active, self.root @ self.moved)
        return self.start + moved.reshape(self.start.shape)

    @torch.no_grad()
    def place(self, model: HybridDynamics) -> None:
        """Put the coefficients as they are now into a model."""
        assert isinstance(model.baseline, ParametricBaseline)
        model.baseline.theta.copy_(self())

"""The interface of baselines: the part of the dynamics that is known or identified first."""

from __future__ import annotations

from abc import ABC, abstractmethod

from torch import Tensor, nn


class Baseline(nn.Module, ABC):
    """Acceleration from channels: z [..., nz] -> nu_dot [..., 3] (m/s^2, m/s^2, rad/s^2); memoryless."""

    @abstractmethod
    def forward(self, z: Tensor) -> Tensor:
        """nu_dot [..., 3] at channels z [..., nz] (see `residnet.physics.signals`)."""

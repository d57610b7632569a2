"""Froude number and speed regimes of hulls."""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor

from residnet.physics.parameters import GRAVITY

SpeedRegime = Literal["displacement", "semi_displacement", "planing"]
SPEED_REGIMES: tuple[SpeedRegime, ...] = ("displacement", "semi_displacement", "planing")
REGIME_BOUNDARIES = (0.4, 1.0)
"""Froude numbers at the boundaries of the speed regimes (Halvorsen 2019, appendix D).

In this source, planing begins between 1.0 and 1.2.
"""


def compute_froude_number(u: Tensor, v: Tensor, length: float) -> Tensor:
    """Compute the Froude number sqrt(u^2 + v^2) / sqrt(g L) (9.10), any shape.

    Args:
        u: surge velocity in m/s.
        v: sway velocity in m/s.
        length: length of the hull in m.

    Raises:
        ValueError: if the length is not positive.
    """
    if not length > 0:
        raise ValueError(f"the Froude number needs a positive length of the hull, got {length:g} m")
    return torch.hypot(u, v) / math.sqrt(GRAVITY * length)


def classify_speed_regime(froude: Tensor) -> Tensor:
    """Return the index in `SPEED_REGIMES` at each Froude number, integers of the same shape.

    A Froude number on a boundary belongs to the regime above it.
    """
    edges = torch.tensor(REGIME_BOUNDARIES, dtype=froude.dtype, device=froude.device)
    return torch.bucketize(froude, edges, right=True)

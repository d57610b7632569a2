"""Froude number and the phases of a marine craft (document 000, appendix D)."""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor

Phase = Literal["displacement", "semi_displacement", "planing"]
PHASES: tuple[Phase, ...] = ("displacement", "semi_displacement", "planing")
BOUNDARIES = (0.4, 1.0)
"""Froude numbers at which the phases meet; the document puts the beginning of planing between 1.0
and 1.2.
"""
GRAVITY = 9.81


def froude_number(u: Tensor, v: Tensor, length: float) -> Tensor:
    """Return the fn = sqrt(u^2 + v^2) / sqrt(g L) (9.10), any shape, for a hull of `length` in m.

    Raises:
        ValueError: where the length is not positive.
    """
    if not length > 0:
        raise ValueError(f"the Froude number needs the length of a hull, given {length:g} m")
    return torch.hypot(u, v) / math.sqrt(GRAVITY * length)


def phase_of(froude: Tensor, boundaries: tuple[float, float] = BOUNDARIES) -> Tensor:
    """Return the number of the phase in `PHASES` at each Froude number, integers of the same shape.

    A boundary belongs to the phase above it.

    a boundary belongs to the phase above it.
    """
    return torch.bucketize(
        froude, torch.tensor(boundaries, dtype=froude.dtype, device=froude.device), right=True
    )

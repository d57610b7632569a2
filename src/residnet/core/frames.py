"""Frames and angles: NED, and body axes x forward, y starboard, z down (SNAME, Fossen).

Angles are unwrapped in logs and states; only differences of angles are wrapped.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def wrap(angle: Tensor) -> Tensor:
    """Bring angles [rad] of any shape to [-pi, pi)."""
    return torch.remainder(angle + torch.pi, 2.0 * torch.pi) - torch.pi


def wrap_array(angle: np.ndarray) -> np.ndarray:
    """Bring angles [rad] of a NumPy array to [-pi, pi)."""
    return np.remainder(angle + np.pi, 2.0 * np.pi) - np.pi


def to_body(north: Tensor, east: Tensor, psi: Tensor) -> tuple[Tensor, Tensor]:
    """Return the components of an earth-fixed vector along body x and y; shapes broadcast.

    Args:
        north: component along north.
        east: component along east.
        psi: heading [rad].

    Source: document 003 eq. (4), transposed.
    """
    c, s = torch.cos(psi), torch.sin(psi)
    return c * north + s * east, c * east - s * north


def to_earth(forward: Tensor, starboard: Tensor, psi: Tensor) -> tuple[Tensor, Tensor]:
    """Return the components of a body-fixed vector along north and east; shapes broadcast.

    Args:
        forward: component along body x.
        starboard: component along body y.
        psi: heading [rad].

    Source: document 003 eq. (4).
    """
    c, s = torch.cos(psi), torch.sin(psi)
    return c * forward - s * starboard, s * forward + c * starboard

"""How a contract complains: one line that names the part, what it does, and what it should do."""

from __future__ import annotations

import torch
from torch import Tensor


def require(condition: bool, message: str) -> None:
    """Stop where a contract is broken.

    Raises:
        AssertionError: with the message, where the condition does not hold.
    """
    if not condition:
        raise AssertionError(message)


def require_equal(found: Tensor, expected: Tensor, tolerance: float, message: str) -> None:
    """Stop where two tensors of one shape differ by more than a share of the larger number.

    Raises:
        AssertionError: with the message and the largest difference.
    """
    require(found.shape == expected.shape, f"{message} (shapes {found.shape}, {expected.shape})")
    if found.numel() == 0:
        return
    scale = 1.0 + float(expected.abs().max())
    difference = float((found - expected).abs().max()) / scale
    require(difference <= tolerance, f"{message} (largest difference {difference:.2g})")


def require_finite(values: Tensor, message: str) -> None:
    """Stop where a tensor holds what is no number.

    Raises:
        AssertionError: with the message.
    """
    require(bool(torch.isfinite(values).all()), message)

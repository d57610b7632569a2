"""Samples of a made residual, for all tests of heads."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from residnet.core.samples import Samples

NAMES = ("u", "v", "r", "tau_x", "tau_n")
SPREAD = np.array([0.6, 0.15, 0.25, 300.0, 150.0])
CENTRE = np.array([1.2, 0.0, 0.02, 400.0, 10.0])


def channels(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, len(NAMES))) * SPREAD + CENTRE


def residual(z: np.ndarray) -> np.ndarray:
    u, v, r, tau_x, tau_n = np.moveaxis(z, -1, 0)
    return np.stack(
        (
            0.1 * u * np.abs(u) - 0.3 * v * r + 1e-4 * tau_x,
            0.2 * u * v - 0.1 * np.abs(v) * v + 0.05,
            -0.3 * r * np.abs(r) + 1e-4 * tau_n * u,
        ),
        axis=-1,
    )


def sampled(
    z: Any,
    target: Any,
    names: Sequence[str],
    *,
    groups: int = 1,
    t: Any = None,
    kinds: Sequence[str] = (),
) -> Samples:
    """Samples of channels [N, nz] and targets [N, n], dealt out to groups of one size."""
    count = len(z)
    return Samples(
        torch.as_tensor(z),
        torch.as_tensor(target),
        torch.arange(count) * groups // count,
        torch.zeros(count) if t is None else torch.as_tensor(t),
        tuple(kinds) or ("made",) * groups,
        tuple(names),
    )


def made(count: int = 600, groups: int = 12, noise: float = 0.02, seed: int = 0) -> Samples:
    z = channels(count, seed)
    target = residual(z) + noise * np.random.default_rng(seed + 1).normal(size=(count, 3))
    # manoeuvres of unequal length
    group = np.sort(np.random.default_rng(seed + 2).integers(0, groups, size=count))
    return Samples(
        torch.from_numpy(z),
        torch.from_numpy(target),
        torch.from_numpy(group),
        torch.zeros(count),
        ("zigzag",) * groups,
        NAMES,
    )

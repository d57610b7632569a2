"""What an exported controller makes of bad measurements."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from residnet.testing.checks import damage, require, require_finite


def check_bad_measurements(
    step: Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]],
    initial_state: Callable[[Tensor], Tensor],
    low: Tensor,
    high: Tensor,
    memory: tuple[Tensor, Tensor],
    limit: float,
    *,
    cases: int = 200,
    seed: int = 0,
) -> None:
    """Check that an exported controller commands finite angles and flags what is wrong.

    Among good measurements stand bad ones, bad memories, and memories whose entries lie within
    their ranges but do not belong together.

    Args:
        step: command [B, 1], memory and fault [B] from measurements y [B, k] and memory.
        initial_state: the memory from measurements.
        low: smallest accepted measurements [k].
        high: largest accepted measurements [k].
        memory: smallest and largest accepted memory [n].
        limit: of the command.
        cases: number of rows.
        seed: of the cases.
    """
    random = torch.Generator().manual_seed(seed)
    least, most = memory

    def between(a: Tensor, b: Tensor) -> Tensor:
        return a + torch.rand(cases, a.numel(), generator=random) * (b - a)

    s = initial_state(damage(between(low, high), high, 0.2, random))
    require_finite(s, "the memory at a bad measurement is not finite")
    for k in range(30):
        y, given = between(low, high), s
        if k % 5 == 1:
            y = damage(y, high, 0.3, random)
        if k % 5 == 3:
            given = damage(s, most, 0.2, random)
        if k == 20:
            given = between(least, most)
        command, s, fault = step(y, given)
        who = f"exported controller, step {k}"
        require_finite(command, f"{who}: a command is not finite")
        require_finite(s, f"{who}: a memory is not finite")
        require(bool((command.abs() <= 1.001 * limit).all()), f"{who}: a command exceeds its limit")
        good = ((y >= low) & (y <= high)).all(dim=-1)
        good &= ((given >= least) & (given <= most)).all(dim=-1)
        require(bool((fault | good).all()), f"{who}: a bad sample raises no flag")
        if k < 20:
            require(not bool((fault & good).any()), f"{who}: a good sample raises a flag")
        kept = ((s >= least) & (s <= most)).all()
        require(bool(kept), f"{who}: leaves a memory that it would not accept")

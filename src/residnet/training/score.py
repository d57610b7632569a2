"""How a training tells how good a model is: its free runs over the validation logs."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

from torch import Tensor


class Shown(NamedTuple):
    """A free run for TensorBoard: times [T], and columns by name, measured and predicted [T]."""

    t: Tensor
    columns: dict[str, tuple[Tensor, Tensor]]


@dataclass(frozen=True, order=True)
class Score:
    """How a model does in free runs over the validation logs; the lesser score is the better one.

    The error of windows that diverged says little, so that fewer of them count first.

    Attributes:
        diverged: number of windows that diverged.
        error: mean nrmse over u, v, r; a diverged window counts with the error of `constant_velocity`.
        axes: nrmse of each axis by name.
        shown: one of the free runs.
    """

    diverged: int
    error: float
    axes: dict[str, float] = field(default_factory=dict, compare=False)
    shown: Shown | None = field(default=None, compare=False)

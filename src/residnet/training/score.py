"""Validation score of a model: errors of its free runs over the validation logs."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

from torch import Tensor


class ExampleRun(NamedTuple):
    """Example free run for TensorBoard.

    Attributes:
        t: times in s [T].
        columns: measured and predicted values [T] of each column by name.
    """

    t: Tensor
    columns: dict[str, tuple[Tensor, Tensor]]


@dataclass(frozen=True, order=True)
class Score:
    """Error of a model's free runs over the validation logs; the lower score is better.

    Scores are compared by the number of diverged windows first, because the error of a diverged
    window is arbitrary.

    Attributes:
        diverged: number of windows that diverged.
        error: mean normalised RMSE over u, v, r; a diverged window has the error of
            `constant_velocity`.
        axes: normalised RMSE of each axis by name.
        example: one of the free runs.
    """

    diverged: int
    error: float
    axes: dict[str, float] = field(default_factory=dict, compare=False)
    example: ExampleRun | None = field(default=None, compare=False)

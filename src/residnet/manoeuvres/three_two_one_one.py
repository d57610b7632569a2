"""3-2-1-1: steering steps of 3, 2, 1 and 1 units to alternating sides, rich over a broad band.

Source: document 003 section 4.2.2.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from residnet.core.config import Config, Seconds
from residnet.manoeuvres.base import Manoeuvre, Range, Scheduled, Steering

_PATTERN = (1.0, 1.0, 1.0, -1.0, -1.0, 1.0, -1.0)


class ThreeTwoOneOne(Steering, Scheduled):
    """The 3-2-1-1 pattern in units of `unit` seconds; zero steer after it.

    Attributes:
        unit: length of the shortest step in s.
        repeat: whether the pattern is repeated to the end.
    """

    kind: Literal["three_two_one_one"] = "three_two_one_one"
    unit: Seconds = Field(gt=0)
    repeat: bool = True

    def demands(self, t: Tensor) -> tuple[Tensor, Tensor]:
        """Return constant drive and patterned steer [T]."""
        # times on the grid must not fall short of their unit by rounding
        units = torch.floor((t - self.start) / self.unit + 1e-9).long()
        pattern = torch.tensor(_PATTERN, dtype=t.dtype)
        steer = self.steer * pattern[units.clamp(min=0) % len(_PATTERN)]
        active = (units >= 0) & (self.repeat | (units < len(_PATTERN)))
        return torch.full_like(t, self.drive), torch.where(active, steer, torch.zeros_like(t))


class ThreeTwoOneOneFamily(Config):
    """3-2-1-1 manoeuvres with unit, steer and drive uniform in their ranges, repeated.

    Attributes:
        count: how many manoeuvres.
        unit: range of the shortest step in s.
        steer: range of the share of full steer.
        drive: range of the share of full drive.
        start: when the steering begins in s.
    """

    kind: Literal["three_two_one_one"] = "three_two_one_one"
    count: int = Field(ge=1, le=10_000)
    unit: tuple[Seconds, Seconds] = (2.0, 4.0)
    steer: Range = (0.4, 1.0)
    drive: Range = (0.1, 0.9)
    start: Seconds = 5.0

    def draw(self, random: np.random.Generator, duration: float) -> list[Manoeuvre]:
        """Draw `count` manoeuvres with a random generator."""
        return [
            ThreeTwoOneOne(
                unit=float(random.uniform(*self.unit)),
                steer=float(random.uniform(*self.steer)),
                drive=float(random.uniform(*self.drive)),
                start=self.start,
            )
            for _ in range(self.count)
        ]

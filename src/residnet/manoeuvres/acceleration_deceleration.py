"""Acceleration-deceleration: speed steps straight ahead (document 003 section 4.2.2)."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

from residnet.core.config import Config, Seconds
from residnet.manoeuvres.base import Manoeuvre, Range, Scheduled


class AccelerationDeceleration(Scheduled):
    """Drive levels, each held from its time on; the steer is zero.

    Attributes:
        times: when each level begins in s, ascending.
        levels: drive from -1 to 1 from that time on.
    """

    kind: Literal["acceleration_deceleration"] = "acceleration_deceleration"
    times: tuple[Seconds, ...] = Field(min_length=1)
    levels: tuple[float, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _pairs(self) -> AccelerationDeceleration:
        if len(self.times) != len(self.levels) or list(self.times) != sorted(self.times):
            raise ValueError("times and levels need the same number of entries, times ascending")
        return self

    def demands(self, t: Tensor) -> tuple[Tensor, Tensor]:
        """Return the stepped drive [T], zero before the first time; zero steer [T]."""
        index = torch.searchsorted(torch.tensor(self.times, dtype=t.dtype), t, right=True)
        return torch.tensor((0.0, *self.levels), dtype=t.dtype)[index], torch.zeros_like(t)


class AccelerationDecelerationFamily(Config):
    """Steps between a high and a low level, drawn at random.

    The high level is lowered by a quarter and by half in turn; all is uniform in its range.

    Attributes:
        count: how many manoeuvres.
        high: range of the high level of the drive.
        low: range of the low level of the drive.
        hold: range of the time for which a level is held in s.
    """

    kind: Literal["acceleration_deceleration"] = "acceleration_deceleration"
    count: int = Field(ge=1, le=10_000)
    high: Range = (0.4, 1.0)
    low: Range = (0.0, 0.3)
    hold: tuple[Seconds, Seconds] = (6.0, 12.0)

    def draw(self, random: np.random.Generator, duration: float) -> list[Manoeuvre]:
        """Draw `count` manoeuvres of `duration` seconds with a random generator."""
        most = int(duration / self.hold[0]) + 2
        out: list[Manoeuvre] = []
        for _ in range(self.count):
            high, low = random.uniform(*self.high), random.uniform(*self.low)
            holds = random.uniform(*self.hold, size=most)
            times = np.concatenate(([0.0], np.cumsum(holds)[:-1]))
            peaks = high * np.array([1.0, 0.75, 0.5])[(np.arange(most) // 2) % 3]
            levels = np.where(np.arange(most) % 2 == 0, peaks, low)
            keep = times < duration
            out.append(
                AccelerationDeceleration(
                    times=tuple(times[keep].tolist()), levels=tuple(levels[keep].tolist())
                )
            )
        return out

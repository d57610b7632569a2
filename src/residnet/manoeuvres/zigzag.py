"""Zigzag: the steering command changes side whenever the heading reaches its bound (document 003 section 4.2.2)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, final

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from residnet.core.config import Config, Radians, Seconds
from residnet.dynamics.rollout import Source
from residnet.manoeuvres.base import Helm, Manoeuvre, Range, Side, Steering


class Zigzag(Steering, Manoeuvre):
    """Steer to one side until the heading has changed by `heading`, then to the other, and so on."""

    kind: Literal["zigzag"] = "zigzag"
    heading: Radians = Field(gt=0)
    first: Side = "starboard"

    @classmethod
    def source(cls, manoeuvres: Sequence[Manoeuvre], helm: Helm, t: Tensor) -> Source:
        """Closed loop on the heading of each row."""
        chosen = [m for m in manoeuvres if isinstance(m, Zigzag)]
        return ZigzagSource(chosen, helm, t)


@final
class ZigzagSource(Source):
    """Memory [B, 2]: side of the command (+1 starboard, -1 port) and heading at the start."""

    def __init__(self, manoeuvres: Sequence[Zigzag], helm: Helm, t: Tensor) -> None:
        super().__init__()
        columns = [[m.drive, m.steer, m.start, m.heading, 1.0 if m.first == "starboard" else -1.0] for m in manoeuvres]
        self.drive, self.steer, self.start, self.heading, self.first = torch.tensor(columns, dtype=torch.float64).unbind(-1)
        self.demand = helm.demand
        self.psi = helm.column("psi")
        self.times = t.tolist()

    def initial(self, x: Tensor) -> Tensor:
        """First side and present heading, [B, 2]."""
        return torch.stack((self.first.to(x.dtype), x[:, self.psi]), dim=-1)

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Inputs [B, m]; the bound is tested on the heading at the start of the step."""
        side, origin = memory[:, 0], memory[:, 1]
        reached = side * (x[:, self.psi] - origin) >= self.heading.to(x.dtype)
        side = torch.where(reached, -side, side)
        steer = torch.where(self.times[k] >= self.start, side * self.steer.to(x.dtype), torch.zeros_like(side))
        command = self.demand(self.drive.to(x.dtype), steer)
        return torch.cat((command, w[:, command.shape[-1] :]), dim=-1), torch.stack((side, origin), dim=-1)


class ZigzagFamily(Config):
    """Zigzags drawn at random: one of the headings, steer and drive uniform in their ranges, either side first."""

    kind: Literal["zigzag"] = "zigzag"
    count: int = Field(ge=1)
    heading: tuple[Radians, ...] = Field(min_length=1)
    steer: Range = (0.25, 1.0)
    drive: Range = (0.2, 1.0)
    start: Seconds = 5.0

    def draw(self, random: np.random.Generator, duration: float) -> list[Manoeuvre]:
        """`count` manoeuvres."""
        return [
            Zigzag(
                heading=float(random.choice(self.heading)),
                steer=float(random.uniform(*self.steer)),
                drive=float(random.uniform(*self.drive)),
                start=self.start,
                first="starboard" if random.random() < 0.5 else "port",
            )
            for _ in range(self.count)
        ]

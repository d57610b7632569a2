"""Zigzag: the steering changes side whenever the heading reaches its bound.

Source: document 003 section 4.2.2.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal, final

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from residnet.core.config import Config, Radians, Seconds
from residnet.core.log import Log
from residnet.dynamics.rollout import Source
from residnet.manoeuvres import imo, indices
from residnet.manoeuvres.base import Helm, Manoeuvre, Range, RudderSteering, Side


class Zigzag(RudderSteering, Manoeuvre):
    """Steering to one side until the heading has changed by `heading`, then to the other, repeated.

    Attributes:
        heading: change of heading at which the steering is reversed.
        first: side of a positive steer or rudder.
        reversals: ends when the heading is back on its initial course after so many reversals;
            None: lasts as long as it is given time.
    """

    kind: Literal["zigzag"] = "zigzag"
    heading: Radians = Field(gt=0)
    first: Side = "starboard"
    reversals: int | None = Field(default=None, ge=1)

    @classmethod
    def source(cls, manoeuvres: Sequence[Manoeuvre], helm: Helm, t: Tensor) -> Source:
        """Return the closed loop on the heading of each row."""
        chosen = [m for m in manoeuvres if isinstance(m, Zigzag)]
        return ZigzagSource(chosen, helm, t)

    @property
    def goal(self) -> str | None:
        """The end of the manoeuvre: a number of reversals, and the way back."""
        if self.reversals is None:
            return None
        return (
            f"{self.reversals} reversals at {math.degrees(self.heading):.4g} deg of heading and the"
            " way back"
        )

    @property
    def begins(self) -> float:
        """The side of the first execute, +1 starboard or -1 port."""
        return self.side if self.first == "starboard" else -self.side

    def indices(self, log: Log, length: float | None = None) -> dict[str, Any]:
        """Return the overshoots, times and distances; see `indices.zigzag`."""
        return indices.zigzag(log, self.start, self.begins, self.heading, length)

    def limits(self, helm: Helm, length: float, speed: float) -> dict[str, float]:
        """Return IMO's limits of the 10/10 and 20/20 zigzag.

        Where there is no rudder the heading alone tells which of them it is.
        """
        angle = self.heading if helm.hard_over is None else abs(self.share(helm)) * helm.hard_over
        for nominal, limits in ((10.0, imo.zigzag_10(length, speed)), (20.0, imo.zigzag_20())):
            if (
                max(abs(math.degrees(self.heading) - nominal), abs(math.degrees(angle) - nominal))
                < 0.05 * nominal
            ):
                return limits
        return {}


@final
class ZigzagSource(Source):
    """The source of zigzags.

    Memory [B, 3]: side of the command (+1 starboard, -1 port), heading at the start, reversals so
    far.
    """

    def __init__(self, manoeuvres: Sequence[Zigzag], helm: Helm, t: Tensor) -> None:
        super().__init__()
        columns = [
            [m.drive, m.share(helm), m.start, m.heading, 1.0 if m.first == "starboard" else -1.0]
            for m in manoeuvres
        ]
        self.drive, self.steer, self.start, self.heading, self.first = torch.tensor(
            columns, dtype=torch.float64
        ).unbind(-1)
        self.most = torch.tensor(
            [math.inf if m.reversals is None else m.reversals for m in manoeuvres],
            dtype=torch.float64,
        )
        self.may_stop = any(m.reversals is not None for m in manoeuvres)
        # a negative steer turns to the other side
        self.sense = torch.where(self.steer < 0, -1.0, 1.0).to(torch.float64)
        self.demand = helm.demand
        self.psi = helm.column("psi")
        self.times = t.tolist()

    def initial(self, x: Tensor) -> Tensor:
        """Return the first side, present heading and no reversals, [B, 3]."""
        return torch.stack(
            (self.first.to(x.dtype), x[:, self.psi], torch.zeros_like(x[:, 0])), dim=-1
        )

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the inputs [B, m]; the bound is tested on the heading at the start of the step."""
        side, origin, count = memory.unbind(-1)
        reached = side * self.sense.to(x.dtype) * (x[:, self.psi] - origin) >= self.heading.to(
            x.dtype
        )
        side = torch.where(reached, -side, side)
        steer = torch.where(
            self.times[k] >= self.start, side * self.steer.to(x.dtype), torch.zeros_like(side)
        )
        command = self.demand(self.drive.to(x.dtype), steer)
        memory = torch.stack((side, origin, count + reached.to(x.dtype)), dim=-1)
        return torch.cat((command, w[:, command.shape[-1] :]), dim=-1), memory

    def finished(self, x: Tensor, k: int, memory: Tensor) -> Tensor:
        """Return the rows whose heading is back after their last reversal."""
        side, origin, count = memory.unbind(-1)
        return (count >= self.most.to(x.dtype)) & (
            side * self.sense.to(x.dtype) * (x[:, self.psi] - origin) >= 0
        )


class ZigzagFamily(Config):
    """Zigzags drawn at random.

    The heading is one of some, steer and drive are uniform in their ranges, either side comes
    first.

    Attributes:
        count: how many manoeuvres.
        heading: changes of heading to choose from in rad.
        steer: range of the share of full steer.
        drive: range of the share of full drive.
        start: time of the first execute in s.
    """

    kind: Literal["zigzag"] = "zigzag"
    count: int = Field(ge=1, le=10_000)
    heading: tuple[Radians, ...] = Field(min_length=1)
    steer: Range = (0.25, 1.0)
    drive: Range = (0.2, 1.0)
    start: Seconds = 5.0

    def draw(self, random: np.random.Generator, duration: float) -> list[Manoeuvre]:
        """Draw `count` manoeuvres with a random generator."""
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

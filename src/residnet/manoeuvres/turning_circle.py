"""Turning circle: approach, then helm over until the heading has changed by an angle.

A pull-out may follow.
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
from residnet.manoeuvres.base import Helm, Manoeuvre, Range, RudderSteering
from residnet.manoeuvres.steady import Steady, SteadyConfig


class TurningCircle(RudderSteering, Manoeuvre):
    """Straight ahead until `start`, then the helm held until the heading has changed by `until`.

    IMO asks for 540 deg and full rudder.

    Attributes:
        until: change of heading.
        pull_out: the helm then goes amidships until the yaw rate is steady: a vessel that is
            straight-line stable stops turning.
        steady: when it is.
    """

    kind: Literal["turning_circle"] = "turning_circle"
    until: Radians = Field(default=3.0 * math.pi, gt=0)
    pull_out: bool = False
    steady: SteadyConfig = SteadyConfig()

    @classmethod
    def source(cls, manoeuvres: Sequence[Manoeuvre], helm: Helm, t: Tensor) -> Source:
        """Return the closed loop on the heading of each row."""
        return TurningSource([m for m in manoeuvres if isinstance(m, TurningCircle)], helm, t)

    @property
    def goal(self) -> str:
        """The heading change, and the end of the pull-out."""
        turned = f"a heading change of {math.degrees(self.until):.4g} deg"
        return f"{turned} and a steady pull-out" if self.pull_out else turned

    def indices(self, log: Log, length: float | None = None) -> dict[str, Any]:
        """Return the advance, transfer, diameters and the steady turn; see `indices.turning`."""
        found = indices.turning(log, self.start, self.side, self.until, length)
        if self.pull_out and "advance" in found:
            found["pull_out_yaw_rate"] = self.side * float(log["r"][np.isfinite(log["r"])][-1])
        return found

    def limits(self, helm: Helm, length: float, speed: float) -> dict[str, float]:
        """Return IMO's limits, which hold for 35 deg of rudder or as much as it goes."""
        share = abs(self.share(helm))
        angle = share * (helm.hard_over or 0.0)
        return imo.turning(length) if share > 0.999 or math.degrees(angle) > 34.9 else {}


@final
class TurningSource(Source):
    """The source of turning circles.

    Memory [B, 2 + 3]: heading at the helm order; 0 before the heading change is reached, then 1,
    then 2; the memory of `Steady`.
    """

    def __init__(self, manoeuvres: Sequence[TurningCircle], helm: Helm, t: Tensor) -> None:
        super().__init__()
        columns = [
            [m.drive, m.share(helm), m.start, m.until, m.side, float(m.pull_out)]
            for m in manoeuvres
        ]
        self.drive, self.steer, self.start, self.until, self.side, self.pull_out = torch.tensor(
            columns, dtype=torch.float64
        ).unbind(-1)
        self.steady = Steady([m.steady for m in manoeuvres], float(t[1] - t[0]))
        self.demand = helm.demand
        self.psi, self.r = helm.column("psi"), helm.column("r")
        self.times = t.tolist()
        self.may_stop = True

    def initial(self, x: Tensor) -> Tensor:
        """Return the memory [B, 5] at the present heading, in the approach."""
        return torch.cat(
            (x[:, self.psi, None], torch.zeros_like(x[:, :1]), self.steady.initial(x[:, self.r])),
            dim=-1,
        )

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the inputs [B, m]; the heading change is tested at the start of the step."""
        origin, phase = memory[:, 0], memory[:, 1]
        steadiness = self.steady(x[:, self.r], memory[:, 2:])
        over = self.times[k] >= self.start
        origin = torch.where(over, origin, x[:, self.psi])
        turned = (
            (phase == 0)
            & over
            & (self.side.to(x.dtype) * (x[:, self.psi] - origin) >= self.until.to(x.dtype))
        )
        steadiness = self.steady.restart(steadiness, turned)
        settled = (phase == 1) & self.steady.reached(steadiness)
        # without a pull-out the heading change is the end
        phase = torch.where(
            turned, 2.0 - self.pull_out.to(x.dtype), torch.where(settled, 2.0, phase)
        )
        steer = torch.where(over & (phase == 0), self.steer.to(x.dtype), torch.zeros_like(phase))
        command = self.demand(self.drive.to(x.dtype), steer)
        memory = torch.cat((torch.stack((origin, phase), dim=-1), steadiness), dim=-1)
        return torch.cat((command, w[:, command.shape[-1] :]), dim=-1), memory

    def finished(self, x: Tensor, k: int, memory: Tensor) -> Tensor:
        """Return the rows that have turned, and pulled out."""
        return memory[:, 1] == 2


class TurningCircleFamily(Config):
    """Turning circles drawn at random: steer and drive uniform in their ranges, to either side.

    Attributes:
        count: how many manoeuvres.
        steer: range of the share of full steer.
        drive: range of the share of full drive.
        start: time of the helm order in s.
        until: change of heading that ends the manoeuvre in rad.
    """

    kind: Literal["turning_circle"] = "turning_circle"
    count: int = Field(ge=1, le=10_000)
    steer: Range = (0.25, 1.0)
    drive: Range = (0.2, 1.0)
    start: Seconds = 5.0
    until: Radians = Field(default=3.0 * math.pi, gt=0)

    def draw(self, random: np.random.Generator, duration: float) -> list[Manoeuvre]:
        """Draw `count` manoeuvres with a random generator."""
        out: list[Manoeuvre] = []
        for _ in range(self.count):
            side = 1.0 if random.random() < 0.5 else -1.0
            steer, drive = (
                side * float(random.uniform(*self.steer)),
                float(random.uniform(*self.drive)),
            )
            out.append(TurningCircle(steer=steer, drive=drive, start=self.start, until=self.until))
        return out

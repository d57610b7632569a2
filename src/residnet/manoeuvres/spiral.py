"""Dieudonne's spiral: a sequence of helm angles, each held until the yaw rate is steady.

It shows whether a vessel is stable on a straight course.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, final

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

from residnet.core.config import Radians, Seconds
from residnet.core.log import Log
from residnet.dynamics.rollout import Source
from residnet.manoeuvres.base import Helm, Manoeuvre, rudder_share
from residnet.manoeuvres.steady import Steady, SteadyConfig

_DOWN = (1.0, 0.6, 0.4, 0.2, 0.1, 0.0, -0.1, -0.2, -0.4, -0.6, -1.0)


class Spiral(Manoeuvre):
    """Helm angles from one side to the other and back.

    An unstable vessel shows a loop of yaw rate over angle.

    Attributes:
        drive: held throughout.
        steers: shares of full steer in their order.
        rudders: the same as rudder angles, for vessels that have one; instead of `steers`.
        start: of the first; an approach straight ahead before.
        steady: when the next follows.
    """

    kind: Literal["spiral"] = "spiral"
    drive: float = Field(ge=-1, le=1)
    steers: tuple[float, ...] = ()
    rudders: tuple[Radians, ...] = ()
    start: Seconds = Field(default=5.0, ge=0)
    steady: SteadyConfig = SteadyConfig()

    @model_validator(mode="after")
    def _steers_or_rudders(self) -> Spiral:
        if self.steers and self.rudders:
            raise ValueError("give steers or rudders, not both")
        if any(abs(steer) > 1 for steer in self.steers):
            raise ValueError("steers are shares of full steer from -1 to 1")
        return self

    def shares(self, helm: Helm) -> tuple[float, ...]:
        """Return the shares of full steer.

        From one side to the other and back where none are given.
        """
        if self.rudders:
            return tuple(rudder_share(angle, helm) for angle in self.rudders)
        return self.steers or _DOWN + _DOWN[-2::-1]

    @property
    def goal(self) -> str:
        """The steady yaw rate at all of the angles."""
        count = len(self.steers or self.rudders) or 2 * len(_DOWN) - 1
        return f"a steady yaw rate at each of {count} helm angles"

    @classmethod
    def source(cls, manoeuvres: Sequence[Manoeuvre], helm: Helm, t: Tensor) -> Source:
        """Return the closed loop on the yaw rate of each row."""
        return SpiralSource([m for m in manoeuvres if isinstance(m, Spiral)], helm, t)

    def indices(self, log: Log, length: float | None = None) -> dict[str, Any]:
        """Return the steady yaw rate of each angle that was finished, and the height of the loop.

        The height is the largest difference of the yaw rates that the angle nearest to zero had;
        `steers` are shares of full steer (rad where the log has a rudder).
        """
        commands = [name for name in log.channels if name.startswith("cmd_")]
        table = log.stack(commands)
        active = log.t - log.t[0] >= self.start - 1e-9
        changes = np.flatnonzero((np.abs(np.diff(table, axis=0)) > 1e-12).any(axis=1) & active[1:])
        angles = list(self.rudders or self.steers or _DOWN + _DOWN[-2::-1])
        # the first change is the order of the first angle, unless that is amidships as the approach
        # is
        held = changes if angles[0] == 0 else changes[1:]
        ends = [*held.tolist(), len(log) - 1][: len(angles)]
        rates = [float(log["r"][i]) for i in ends]
        angles = angles[: len(rates)]
        middle = min(angles, key=abs)
        amidships = [rate for angle, rate in zip(angles, rates, strict=True) if angle == middle]
        found: dict[str, Any] = {"steers": angles, "yaw_rates": rates}
        return found | (
            {"loop_height": max(amidships) - min(amidships)} if len(amidships) > 1 else {}
        )


@final
class SpiralSource(Source):
    """The source of spirals.

    Memory [B, 1 + 3]: number of the present angle, and the memory of `Steady`.
    """

    def __init__(self, manoeuvres: Sequence[Spiral], helm: Helm, t: Tensor) -> None:
        super().__init__()
        shares = [m.shares(helm) for m in manoeuvres]
        most = max(map(len, shares))
        self.shares = torch.tensor(
            [[*row, *[0.0] * (most + 1 - len(row))] for row in shares], dtype=torch.float64
        )
        self.count = torch.tensor([len(row) for row in shares], dtype=torch.float64)
        self.drive, self.start = torch.tensor(
            [[m.drive, m.start] for m in manoeuvres], dtype=torch.float64
        ).unbind(-1)
        self.steady = Steady([m.steady for m in manoeuvres], float(t[1] - t[0]))
        self.demand = helm.demand
        self.r = helm.column("r")
        self.times = t.tolist()
        self.may_stop = True

    def initial(self, x: Tensor) -> Tensor:
        """Return the memory at the first angle."""
        return torch.cat((torch.zeros_like(x[:, :1]), self.steady.initial(x[:, self.r])), dim=-1)

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the inputs [B, m] and the memory one step later."""
        over = self.times[k] >= self.start
        steadiness = self.steady.restart(self.steady(x[:, self.r], memory[:, 1:]), ~over)
        settled = self.steady.reached(steadiness)
        number = torch.minimum(memory[:, 0] + settled.to(x.dtype), self.count.to(x.dtype))
        steadiness = self.steady.restart(steadiness, settled)
        share = self.shares.to(x.dtype).gather(1, number.long().unsqueeze(-1))[:, 0]
        command = self.demand(
            self.drive.to(x.dtype), torch.where(over, share, torch.zeros_like(share))
        )
        return torch.cat((command, w[:, command.shape[-1] :]), dim=-1), torch.cat(
            (number.unsqueeze(-1), steadiness), dim=-1
        )

    def finished(self, x: Tensor, k: int, memory: Tensor) -> Tensor:
        """Return the rows that have held their last angle."""
        return memory[:, 0] >= self.count.to(x.dtype)

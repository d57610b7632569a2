"""Stopping trial: full astern from an approach straight ahead until the vessel makes no way."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, final

import torch
from pydantic import Field
from torch import Tensor

from residnet.core.config import Seconds
from residnet.core.log import Log
from residnet.dynamics.rollout import Source
from residnet.manoeuvres import imo, indices
from residnet.manoeuvres.base import Helm, Manoeuvre


class Stopping(Manoeuvre):
    """Stopping: `drive` until `start`, then `astern` until the surge velocity is zero.

    The steer is zero.

    Attributes:
        drive: share of full drive of the approach.
        astern: share of full drive after the order, negative.
        start: time of the order in s.
    """

    kind: Literal["stopping"] = "stopping"
    drive: float = Field(gt=0, le=1)
    astern: float = Field(default=-1.0, ge=-1, le=0)
    start: Seconds = Field(default=5.0, ge=0)

    @classmethod
    def source(cls, manoeuvres: Sequence[Manoeuvre], helm: Helm, t: Tensor) -> Source:
        """Return the closed loop on the surge velocity of each row."""
        return StoppingSource([m for m in manoeuvres if isinstance(m, Stopping)], helm, t)

    @property
    def goal(self) -> str:
        """The end of the manoeuvre: rest."""
        return "a surge velocity of zero"

    def indices(self, log: Log, length: float | None = None) -> dict[str, Any]:
        """Return the track reach, head reach, deviation, time; see `indices.stopping`."""
        return indices.stopping(log, self.start, length)

    def limits(self, helm: Helm, length: float, speed: float) -> dict[str, float]:
        """Return IMO's limit, which holds for full astern."""
        return imo.stopping(length) if self.astern <= -0.999 else {}


@final
class StoppingSource(Source):
    """The source of stopping trials; time and surge velocity tell all, without memory."""

    def __init__(self, manoeuvres: Sequence[Stopping], helm: Helm, t: Tensor) -> None:
        super().__init__()
        columns = [[m.drive, m.astern, m.start] for m in manoeuvres]
        self.drive, self.astern, self.start = torch.tensor(columns, dtype=torch.float64).unbind(-1)
        self.demand = helm.demand
        self.u = helm.column("u")
        self.times = t.tolist()
        self.may_stop = True

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the inputs [B, m]; there is no memory."""
        drive = torch.where(self.times[k] >= self.start, self.astern, self.drive).to(x.dtype)
        command = self.demand(drive, torch.zeros_like(drive))
        return torch.cat((command, w[:, command.shape[-1] :]), dim=-1), memory

    def finished(self, x: Tensor, k: int, memory: Tensor) -> Tensor:
        """Return which rows [B] make no way any more."""
        stopped: Tensor = (self.times[k] > self.start) & (x[:, self.u] <= 0)
        return stopped

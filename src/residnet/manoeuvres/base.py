"""The interface of manoeuvres.

A manoeuvre demands a normalised drive (mean thrust or revolutions) and steer (difference, or rudder) over time, open
loop or by the heading that it sees. The vessel turns the two into its own commands, so one manoeuvre drives any plant.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, final

import torch
from pydantic import Field
from torch import Tensor

from residnet.core.config import Config, Seconds
from residnet.core.errors import UsageError
from residnet.dynamics.rollout import Source
from residnet.physics.plant import Plant

Demand = Callable[[Tensor, Tensor], Tensor]
"""Turns drive [...] and steer [...] into commands [..., c], the first c columns of the inputs."""


@dataclass(frozen=True)
class Helm:
    """What a manoeuvre needs to know of the vessel that it steers.

    Attributes:
        demand: turns its normalised demands into the vessel's commands.
        state: names of the columns of the vessel's state.
    """

    demand: Demand
    state: tuple[str, ...]

    @classmethod
    def of(cls, plant: Plant) -> Helm:
        """The helm of a plant."""
        return cls(plant.demand, plant.state)

    def column(self, name: str) -> int:
        """Column of a state.

        Raises:
            UsageError: where the vessel has no such state.
        """
        if name not in self.state:
            raise UsageError(f"the manoeuvre watches '{name}', which the vessel does not have; it has {', '.join(self.state)}")
        return self.state.index(name)


@final
class ScheduleSource(Source):
    """Open-loop demands given in advance."""

    def __init__(self, drive: Tensor, steer: Tensor, demand: Demand) -> None:
        super().__init__()
        self.commands = demand(drive, steer)

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Inputs [B, m] with the scheduled commands in the first columns."""
        command = self.commands[:, k].to(w.dtype)
        return torch.cat((command, w[:, command.shape[-1] :]), dim=-1), memory


@final
class StackedSource(Source):
    """Different manoeuvres side by side in one batch: each source drives its own rows."""

    def __init__(self, sources: Sequence[Source], rows: Sequence[int]) -> None:
        super().__init__()
        self.sources: Sequence[Source] = torch.nn.ModuleList(sources)  # type: ignore[assignment]
        self.rows = list(rows)

    def initial(self, x: Tensor) -> Tensor:
        """Memories of all sources, padded to the widest, [B, k]."""
        parts = [source.initial(part) for source, part in zip(self.sources, x.split(self.rows), strict=True)]
        width = max(part.shape[1] for part in parts)
        return torch.cat([torch.nn.functional.pad(part, (0, width - part.shape[1])) for part in parts])

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Inputs [B, m], each block of rows from its source."""
        inputs, memories = [], []
        for source, xs, ws, ms in zip(self.sources, x.split(self.rows), w.split(self.rows), memory.split(self.rows), strict=True):
            acting, after = source(xs, ws, k, ms)
            inputs.append(acting)
            # a source may need less memory than the widest of the batch
            memories.append(torch.nn.functional.pad(after, (0, memory.shape[1] - after.shape[1])))
        return torch.cat(inputs), torch.cat(memories)


class Manoeuvre(Config, ABC):
    """One manoeuvre of normalised demands; `kind` names it in logs and metrics."""

    kind: str

    @classmethod
    @abstractmethod
    def source(cls, manoeuvres: Sequence[Manoeuvre], helm: Helm, t: Tensor) -> Source:
        """The source that flies several manoeuvres of this kind side by side; t [T] are the times of the steps."""


class Scheduled(Manoeuvre):
    """An open-loop manoeuvre: its demands are known in advance."""

    @abstractmethod
    def demands(self, t: Tensor) -> tuple[Tensor, Tensor]:
        """Drive and steer [T] at times t [T] in s."""

    @classmethod
    def source(cls, manoeuvres: Sequence[Manoeuvre], helm: Helm, t: Tensor) -> Source:
        """Playback of the demands."""
        pairs = [manoeuvre.demands(t) for manoeuvre in manoeuvres if isinstance(manoeuvre, Scheduled)]
        return ScheduleSource(torch.stack([d for d, _ in pairs]), torch.stack([s for _, s in pairs]), helm.demand)


class Steering(Config):
    """What manoeuvres share that hold the drive and steer from `start` on."""

    drive: float = Field(ge=-1, le=1)
    steer: float = Field(ge=-1, le=1)
    start: Seconds = Field(default=5.0, ge=0)


Range = tuple[float, float]
Side = Literal["starboard", "port"]

"""The interface of manoeuvres.

A manoeuvre demands a normalised drive (mean thrust or revolutions) and steer (difference, or
rudder) over time, open loop or by the motion that it sees. The vessel turns the two into its own
commands, so one manoeuvre drives any plant and any learned model that has actuators. A manoeuvre
with a stop condition ends its row of the rollout there.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, final

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

from residnet.core.config import Config, Radians, Seconds
from residnet.core.errors import UsageError
from residnet.core.log import Log
from residnet.dynamics.rollout import Source
from residnet.physics.actuators import ForceActuators, ForceCommands
from residnet.physics.plant import HullPlant, Plant

Demand = Callable[[Tensor, Tensor], Tensor]
"""Turns drive [...] and steer [...] into commands [..., c], the first c columns of the inputs."""

Range = tuple[float, float]

RUDDERS = ("cmd_delta", "delta")
"""Names of the input that is a rudder angle."""


@dataclass(frozen=True)
class Helm:
    """What a manoeuvre needs to know of the vessel that it steers.

    Attributes:
        demand: turns its normalised demands into the vessel's commands.
        state: names of the columns of the vessel's state.
        inputs: names of the columns of its inputs, commands first.
        forces: turns forces tau [..., 3] in surge, sway and yaw into its commands; None for a
            vessel that cannot make all three.
        side_force: largest commanded sway force in N; None for a vessel whose commands are no
            forces.
        diving: commands [c] that make the vessel dive with all its force; None where it cannot.
    """

    demand: Demand
    state: tuple[str, ...]
    inputs: tuple[str, ...] = ()
    forces: Callable[[Tensor], Tensor] | None = None
    side_force: float | None = None
    diving: Tensor | None = None

    def commanded(self, drive: Tensor, steer: Tensor, *dive: Tensor) -> Tensor:
        """Return the commands [..., c] for shares of drive and steer, and of diving if any [...].

        Raises:
            UsageError: where the vessel cannot dive.
        """
        commands = self.demand(drive, steer)
        for share in dive:
            if self.diving is None:
                raise UsageError(
                    "the manoeuvre dives, and the vessel does not; give a vessel with all six"
                    " degrees of freedom, or a manoeuvre without dive"
                )
            commands = commands + share.unsqueeze(-1) * self.diving.to(commands.dtype)
        return commands

    @classmethod
    def from_plant(cls, plant: Plant) -> Helm:
        """Return the helm of a plant."""
        forces: Callable[[Tensor], Tensor] | None = None
        side_force: float | None = None
        if isinstance(plant, HullPlant) and isinstance(plant.actuators, ForceCommands):
            side_force = float(plant.actuators.limit[1])
        if plant.inputs[: plant.commands] == ForceCommands.commands:
            forces = torch.Tensor.clone
        elif isinstance(plant, HullPlant) and isinstance(plant.actuators, ForceActuators):
            forces = plant.actuators.allocate
        return cls(plant.demand, plant.state, plant.inputs, forces, side_force, plant.diving)

    def column(self, name: str) -> int:
        """Return the column of a state.

        Raises:
            UsageError: where the vessel has no such state.
        """
        if name not in self.state:
            raise UsageError(
                f"the manoeuvre watches '{name}', which the vessel does not have; it has"
                f" {', '.join(self.state)}"
            )
        return self.state.index(name)

    @property
    def hard_over(self) -> float | None:
        """Rudder angle of full steer in rad; None where the vessel has no rudder."""
        name = next((name for name in RUDDERS if name in self.inputs), None)
        if name is None:
            return None
        full = self.demand(torch.zeros(1, dtype=torch.float64), torch.ones(1, dtype=torch.float64))
        return float(full[0, self.inputs.index(name)])


def commanded(command: Tensor, w: Tensor) -> Tensor:
    """Return the inputs [B, m] with commands [B, c] in the place of their first columns."""
    return torch.cat((command, w[:, command.shape[-1] :]), dim=-1)


@final
class ScheduleSource(Source):
    """Open-loop commands given in advance."""

    def __init__(self, commands: Tensor) -> None:
        """From the commands [B, T, c]."""
        super().__init__()
        self.commands = commands

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        return commanded(self.commands[:, k].to(w.dtype), w), memory


Numbers = dict[str, Tensor]
"""What rows of a batch are told by their manoeuvres, each [B] or [B, n]."""


@final
class LawSource(Source):
    """Manoeuvres of one kind that steer by the motion, side by side."""

    def __init__(self, manoeuvres: Sequence[ClosedLoop], helm: Helm, t: Tensor) -> None:
        super().__init__()
        self.kind = type(manoeuvres[0])
        rows = [manoeuvre.numbers(helm) for manoeuvre in manoeuvres]
        self.numbers: Numbers = {
            name: torch.nn.utils.rnn.pad_sequence(
                [torch.tensor(row[name], dtype=torch.float64) for row in rows], batch_first=True
            )
            if isinstance(rows[0][name], list)
            else torch.tensor([row[name] for row in rows], dtype=torch.float64)
            for name in rows[0]
        }
        self.numbers["dt"] = t[1] - t[0]
        self.columns = {name: helm.column(name) for name in self.kind.watches}
        self.commands = helm.commanded
        self.times = t.tolist()
        self.may_stop = any(manoeuvre.goal is not None for manoeuvre in manoeuvres)

    def initial(self, x: Tensor) -> Tensor:
        return self.kind.memory(*self._seen(x))

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the inputs [B, m]; what the motion says is tested at the start of the step."""
        seen, numbers = self._seen(x)
        *demands, memory = self.kind.law(seen, numbers, self.times[k], memory)
        return commanded(self.commands(*demands), w), memory

    def finished(self, x: Tensor, k: int, memory: Tensor) -> Tensor:
        """Return the rows [B] whose manoeuvre has come to its end."""
        return self.kind.ended(*self._seen(x), self.times[k], memory)

    def _seen(self, x: Tensor) -> tuple[Numbers, Numbers]:
        seen = {name: x[:, column] for name, column in self.columns.items()}
        return seen, {name: value.to(x.dtype) for name, value in self.numbers.items()}


@final
class StackedSource(Source):
    """Different manoeuvres side by side in one batch: each source drives its own rows."""

    def __init__(self, sources: Sequence[Source], rows: Sequence[int]) -> None:
        super().__init__()
        self.sources: Sequence[Source] = torch.nn.ModuleList(sources)  # type: ignore[assignment]
        self.rows = list(rows)
        self.widths = [0] * len(self.rows)
        self.may_stop = any(source.may_stop for source in sources)

    def initial(self, x: Tensor) -> Tensor:
        """Return the memories of all sources, padded to the widest, [B, k]."""
        parts = zip(self.sources, x.split(self.rows), strict=True)
        memories = [source.initial(part) for source, part in parts]
        self.widths = [memory.shape[1] for memory in memories]
        return torch.cat([self._padded(memory, max(self.widths)) for memory in memories])

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the inputs [B, m], each block of rows from its source."""
        inputs, memories = [], []
        for source, xs, ws, ms in zip(
            self.sources, x.split(self.rows), w.split(self.rows), self._split(memory), strict=True
        ):
            acting, after = source(xs, ws, k, ms)
            inputs.append(acting)
            memories.append(self._padded(after, memory.shape[1]))
        return torch.cat(inputs), torch.cat(memories)

    def finished(self, x: Tensor, k: int, memory: Tensor) -> Tensor:
        """Return which rows [B] have finished, each block of rows by its source."""
        parts = zip(self.sources, x.split(self.rows), self._split(memory), strict=True)
        return torch.cat([source.finished(xs, k, ms) for source, xs, ms in parts])

    @staticmethod
    def _padded(memory: Tensor, width: int) -> Tensor:
        return torch.nn.functional.pad(memory, (0, width - memory.shape[1]))

    def _split(self, memory: Tensor) -> list[Tensor]:
        parts = zip(memory.split(self.rows), self.widths, strict=True)
        return [part[:, :width] for part, width in parts]


@final
class Watched(Source):
    """A source that remembers when its rows stopped.

    `stopped` [B] is the sample at which each did, -1 where it did not.
    """

    def __init__(self, source: Source, rows: int) -> None:
        super().__init__()
        self.source = source
        self.may_stop = source.may_stop
        self.stopped = torch.full((rows,), -1)

    def initial(self, x: Tensor) -> Tensor:
        self.stopped = torch.full((x.shape[0],), -1)
        return self.source.initial(x)

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        out: tuple[Tensor, Tensor] = self.source(x, w, k, memory)
        return out

    def finished(self, x: Tensor, k: int, memory: Tensor) -> Tensor:
        """Return the rows that have stopped now or before."""
        now = self.source.finished(x, k, memory) & (self.stopped < 0)
        self.stopped = torch.where(now, k, self.stopped)
        return self.stopped >= 0


class Manoeuvre(Config, ABC):
    """One manoeuvre of normalised demands; `kind` names it in logs and metrics.

    Attributes:
        name: of its log; the kind with a number where None.
        duration: its length, or for a manoeuvre with a stop condition the time after which it has
            failed; that of the programme where None.
        kind: kind of the manoeuvre.
    """

    kind: str
    name: str | None = Field(default=None, pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")
    duration: Seconds | None = Field(default=None, gt=0)

    @classmethod
    @abstractmethod
    def source(cls, manoeuvres: Sequence[Manoeuvre], helm: Helm, t: Tensor) -> Source:
        """Build the source that flies several manoeuvres of this kind side by side.

        Args:
            manoeuvres: of this kind, one for each row.
            t: times [T] of the steps in s.
        """

    @property
    def goal(self) -> str | None:
        """What the manoeuvre ends at, in words; None where it lasts as long as it is given time."""
        return None

    def lasts(self, duration: float) -> float:
        """Return the seconds that the manoeuvre is given, in a programme of `duration`."""
        return duration if self.duration is None else self.duration

    def begin(self, x: Tensor, state: tuple[str, ...]) -> Tensor:
        """Return the state [nx] that the manoeuvre starts from.

        Args:
            x: state [nx] that trials of the vessel start from.
        """
        return x

    def indices(self, log: Log, length: float | None = None) -> dict[str, Any]:
        """Return the manoeuvring indices by name, SI and rad (units in `indices.UNITS`).

        Those that the log is too short for are left out.

        Args:
            log: what was flown: t, x, y, psi, u, v, r.
            length: of the hull in m, for distances in lengths; None where unknown.
        """
        return {}

    def limits(self, helm: Helm, length: float, speed: float) -> dict[str, float]:
        """Return the largest values of indices that IMO resolution MSC.137(76) allows, by index.

        Args:
            length: of the ship in m.
            speed: approach speed in m/s.
        """
        return {}


class Scheduled(Manoeuvre):
    """An open-loop manoeuvre: its demands are known in advance."""

    @abstractmethod
    def demands(self, t: Tensor) -> tuple[Tensor, ...]:
        """Return drive and steer, and dive where it dives, [T] at times t [T] in s."""

    @classmethod
    def source(cls, manoeuvres: Sequence[Manoeuvre], helm: Helm, t: Tensor) -> Source:
        pairs = [
            manoeuvre.demands(t) for manoeuvre in manoeuvres if isinstance(manoeuvre, Scheduled)
        ]
        return ScheduleSource(helm.commanded(*map(torch.stack, zip(*pairs, strict=True))))


class ClosedLoop(Manoeuvre):
    """A manoeuvre that demands drive and steer by the motion that it sees.

    Its class methods work on all rows of a batch at once. `seen` holds the states that the kind
    `watches`, [B] each; `numbers` what the rows' manoeuvres say, and the step `dt` in s.
    """

    watches: ClassVar[tuple[str, ...]]
    told: ClassVar[tuple[str, ...]] = ("drive", "start")
    """Settings that the law needs to know as they are."""

    def numbers(self, helm: Helm) -> dict[str, Any]:
        """Return what the law needs to know of this manoeuvre, numbers or lists of them."""
        return {name: getattr(self, name) for name in self.told}

    @classmethod
    @abstractmethod
    def memory(cls, seen: Numbers, numbers: Numbers) -> Tensor:
        """Return the memory [B, k] at the start."""

    @classmethod
    @abstractmethod
    def law(
        cls, seen: Numbers, numbers: Numbers, time: float, memory: Tensor
    ) -> tuple[Tensor, ...]:
        """Return drive [B], steer [B] and the memory [B, k] for the step that begins at `time`.

        Before the memory stands dive [B] where it dives.
        """

    @classmethod
    def ended(cls, seen: Numbers, numbers: Numbers, time: float, memory: Tensor) -> Tensor:
        """Return the rows [B] that have reached their goal."""
        return torch.zeros(len(memory), dtype=torch.bool)

    @classmethod
    def source(cls, manoeuvres: Sequence[Manoeuvre], helm: Helm, t: Tensor) -> Source:
        return LawSource([m for m in manoeuvres if isinstance(m, ClosedLoop)], helm, t)


class Family(Config, ABC):
    """Manoeuvres of one kind that are drawn at random.

    Attributes:
        count: how many.
    """

    count: int = Field(ge=1, le=10_000)

    @abstractmethod
    def one(self, random: np.random.Generator, duration: float) -> Manoeuvre:
        """Draw a manoeuvre of at most `duration` seconds with a random generator."""

    def draw(self, random: np.random.Generator, duration: float) -> list[Manoeuvre]:
        """Draw `count` manoeuvres of `duration` seconds with a random generator."""
        return [self.one(random, duration) for _ in range(self.count)]


def drawn(random: np.random.Generator, span: Range) -> float:
    """Return a number that is uniform in a range."""
    return float(random.uniform(*span))


class RudderSteering(Config):
    """The part that manoeuvres share which a vessel with a rudder may fly by its angle.

    Attributes:
        drive: held from the beginning, as the approach.
        steer: share of full steer; positive turns to starboard.
        rudder: the same as a rudder angle, for vessels that have one; instead of `steer`.
        start: when the steering begins.
    """

    drive: float = Field(ge=-1, le=1)
    steer: float | None = Field(default=None, ge=-1, le=1)
    rudder: Radians | None = None
    start: Seconds = Field(default=5.0, ge=0)

    @model_validator(mode="after")
    def _steer_or_rudder(self) -> RudderSteering:
        if (self.steer is None) == (self.rudder is None):
            raise ValueError(
                "give either steer (share of full steer, -1 to 1) or rudder (an angle such as '10"
                " deg')"
            )
        return self

    @property
    def side(self) -> float:
        """The side of the demand: +1 where it is positive, -1 where it is negative."""
        return -1.0 if (self.steer if self.steer is not None else self.rudder or 0.0) < 0 else 1.0

    def share(self, helm: Helm) -> float:
        """Return the share of full steer on a vessel.

        Raises:
            UsageError: where an angle is asked of a vessel without rudder, or more than its
                largest.
        """
        return self.steer if self.steer is not None else rudder_share(self.rudder or 0.0, helm)


def rudder_share(angle: float, helm: Helm) -> float:
    """Return the share of full steer that commands a rudder angle [rad].

    Raises:
        UsageError: where the vessel has no rudder or one that does not go so far.
    """
    most = helm.hard_over
    if most is None:
        raise UsageError(
            "the manoeuvre gives a rudder angle, but the vessel has no rudder; give steer, a share"
            " of full steer from -1 to 1"
        )
    share = angle / most
    if abs(share) > 1.0 + 1e-9:
        raise UsageError(
            f"the manoeuvre asks for {abs(angle) * 57.29578:.4g} deg of rudder, the vessel's goes"
            f" to {most * 57.29578:.4g} deg"
        )
    return share

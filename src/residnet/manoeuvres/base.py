"""The interface of manoeuvres.

A manoeuvre demands a normalised propulsion command (`drive`: mean thrust or revolutions) and a
normalised steering command (`steer`: difference of these, or rudder) over time, in open loop or as
a function of the motion. The vessel converts the two into its own commands, so that one manoeuvre
works with any plant and any learned model that has actuators. Several manoeuvres are simulated as
the rows of one batch; a row whose manoeuvre has a stop condition ends when the condition is met.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np
from pydantic import Field, model_validator

from residnet.core.config import Config, Radians, Seconds
from residnet.core.errors import UsageError
from residnet.core.log import Log
from residnet.physics.actuators.config import RUDDER_INPUTS
from residnet.physics.plant_channels import PlantChannels

if TYPE_CHECKING:
    from torch import Tensor

    from residnet.engine.rollout import Source
    from residnet.physics.plant import Plant

    DemandFunction = Callable[[Tensor, Tensor], Tensor]
    """Converts propulsion and steering command [...] to commands [..., c] of the vessel."""
    BatchValues = dict[str, Tensor]
    """Quantities of the rows of a batch by name, [B] or [B, n] each."""

Range = tuple[float, float]
"""Lower and upper bound of a uniform distribution."""


@dataclass(frozen=True)
class Helm:
    """Properties of a vessel that a manoeuvre needs.

    Attributes:
        demand: converts normalised demands to the commands of the vessel.
        state: names of the columns of the state.
        inputs: names of the columns of the inputs, commands first.
        forces: converts forces tau [..., 3] in surge, sway and yaw to commands; None for a vessel
            that cannot produce all three.
        side_force: largest commanded sway force in N; None for a vessel whose commands are not
            forces.
        dive_commands: commands [c] for a full dive; None for a vessel that cannot dive.
    """

    demand: DemandFunction
    state: tuple[str, ...]
    inputs: tuple[str, ...] = ()
    forces: Callable[[Tensor], Tensor] | None = None
    side_force: float | None = None
    dive_commands: Tensor | None = None

    def commands_for(self, drive: Tensor, steer: Tensor, *dive: Tensor) -> Tensor:
        """Return the commands [..., c] of the vessel for normalised demands [...].

        The demands are propulsion, steering and, for a diving manoeuvre, diving.

        Raises:
            UsageError: if dive is demanded of a vessel that cannot dive.
        """
        commands = self.demand(drive, steer)
        for dive_demand in dive:
            require_dive(can_dive=self.dive_commands is not None)
            assert self.dive_commands is not None
            dive_commands = self.dive_commands.to(commands.dtype)
            commands = commands + dive_demand.unsqueeze(-1) * dive_commands
        return commands

    @classmethod
    def from_plant(cls, plant: Plant) -> Helm:
        """Build the conversion of demands to commands for the actuators of a plant."""
        import torch

        from residnet.physics.actuators.base import ForceActuators
        from residnet.physics.actuators.thrusters import ForceCommands
        from residnet.physics.plant import HullPlant

        forces: Callable[[Tensor], Tensor] | None = None
        side_force: float | None = None
        if isinstance(plant, HullPlant) and isinstance(plant.actuators, ForceCommands):
            # order of the limits: surge, sway, yaw
            side_force = float(plant.actuators.limit[1])
        if plant.input_names[: plant.n_commands] == ForceCommands.command_names:
            # commands that are forces need no allocation
            forces = torch.Tensor.clone
        elif isinstance(plant, HullPlant) and isinstance(plant.actuators, ForceActuators):
            forces = plant.actuators.allocate
        return cls(
            plant.commands_for_demand,
            plant.state_names,
            plant.input_names,
            forces,
            side_force,
            plant.dive_commands,
        )

    def state_column(self, name: str) -> int:
        """Return the index of the column of a state in x.

        Raises:
            UsageError: if the vessel has no such state.
        """
        require_state(name, self.state)
        return self.state.index(name)

    @property
    def max_rudder(self) -> float | None:
        """Rudder angle of the full steering command in rad; None for a vessel without rudder."""
        import torch

        name = next((name for name in RUDDER_INPUTS if name in self.inputs), None)
        if name is None:
            return None
        full_commands = self.demand(
            torch.zeros(1, dtype=torch.float64), torch.ones(1, dtype=torch.float64)
        )
        return float(full_commands[0, self.inputs.index(name)])


class SupportsMaxRudder(Protocol):
    """A vessel whose largest rudder angle is known: a `Helm`, or the channels of a plant."""

    @property
    def max_rudder(self) -> float | None:
        """Rudder angle of the full steering command in rad; None for a vessel without rudder."""


def require_state(name: str, state_names: Sequence[str]) -> None:
    """Check that a vessel has a state that a manoeuvre observes.

    Raises:
        UsageError: if it does not have the state.
    """
    if name not in state_names:
        raise UsageError(
            f"the manoeuvre needs the state '{name}', which the vessel does not have; its"
            f" states are {', '.join(state_names)}"
        )


def require_dive(*, can_dive: bool) -> None:
    """Check that a vessel can dive.

    Raises:
        UsageError: if it cannot.
    """
    if not can_dive:
        raise UsageError(
            "the manoeuvre demands a dive, but the vessel cannot dive; give a vessel with"
            " six degrees of freedom, or a manoeuvre without dive"
        )


class Manoeuvre(Config, ABC):
    """One manoeuvre of normalised demands; `kind` names it in logs and metrics.

    Attributes:
        name: name of the log; None for the kind with a number.
        duration: duration in s, or the time limit of a manoeuvre with a stop condition; None for
            the duration of the programme of trials.
        kind: kind of the manoeuvre.
    """

    kind: str
    name: str | None = Field(default=None, pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")
    duration: Seconds | None = Field(default=None, gt=0)

    @classmethod
    @abstractmethod
    def build_source(cls, manoeuvres: Sequence[Manoeuvre], helm: Helm, t: Tensor) -> Source:
        """Build the source of several manoeuvres of this kind, one for each row.

        Args:
            manoeuvres: manoeuvres of this kind.
            helm: properties of the vessel.
            t: times [T] of the steps in s.
        """

    @property
    def end_condition(self) -> str | None:
        """Description of the end condition; None if the manoeuvre lasts for its full duration."""
        return None

    @property
    def marked_positions(self) -> Sequence[tuple[float, float]]:
        """Positions (north, east) in m that figures of the track mark, such as way-points."""
        return ()

    def check_vessel(self, channels: PlantChannels) -> None:
        """Check that a vessel has the states and commands that the manoeuvre needs.

        The check of a config calls this; `build_source` checks the same at the start of a
        simulation. The default accepts any vessel.

        Raises:
            UsageError: if the vessel lacks a state or a command.
        """

    def duration_within(self, duration: float) -> float:
        """Return the duration of the manoeuvre in s, within trials of `duration` seconds."""
        return duration if self.duration is None else self.duration

    def initial_state(self, x: Tensor, state: tuple[str, ...]) -> Tensor:
        """Return the initial state [nx] of the manoeuvre.

        Args:
            x: default initial state of trials with the vessel [nx].
            state: names of the states.
        """
        return x

    def compute_indices(self, log: Log, length: float | None = None) -> dict[str, Any]:
        """Return the manoeuvring indices by name, SI and rad (units in `indices.INDEX_UNITS`).

        Indices for which the log is too short are omitted.

        Args:
            log: simulated or measured motion: t, x, y, psi, u, v, r.
            length: length of the hull in m, for distances in lengths; None if unknown.
        """
        return {}

    def imo_limits(self, helm: Helm, length: float, speed: float) -> dict[str, float]:
        """Return the upper limits of indices by IMO resolution MSC.137(76); empty without limits.

        Args:
            helm: properties of the vessel.
            length: length of the ship in m.
            speed: approach speed in m/s.
        """
        return {}


class ScheduledManoeuvre(Manoeuvre):
    """An open-loop manoeuvre, whose demands are functions of time."""

    @abstractmethod
    def demands_at(self, t: Tensor) -> tuple[Tensor, ...]:
        """Return the propulsion and steering commands, [T] each, at times t [T] in s.

        A diving manoeuvre also returns the dive command [T].
        """

    @classmethod
    def build_source(cls, manoeuvres: Sequence[Manoeuvre], helm: Helm, t: Tensor) -> Source:
        import torch

        from residnet.manoeuvres.sources import ScheduleSource

        demands = [
            manoeuvre.demands_at(t)
            for manoeuvre in manoeuvres
            if isinstance(manoeuvre, ScheduledManoeuvre)
        ]
        return ScheduleSource(helm.commands_for(*map(torch.stack, zip(*demands, strict=True))))


class ClosedLoopManoeuvre(Manoeuvre):
    """A manoeuvre that computes propulsion and steering commands from the motion.

    Its class methods evaluate all manoeuvres of a batch at once. Their argument `motion` has the
    states of `observed_states` by name, [B] each. Their argument `parameters` has the values of
    `law_parameters` by name, [B] or [B, n] each, and the time step `dt` in s.
    """

    observed_states: ClassVar[tuple[str, ...]]
    parameter_names: ClassVar[tuple[str, ...]] = ("drive", "start")
    """Attributes of the config that `law_parameters` returns unchanged."""

    def check_vessel(self, channels: PlantChannels) -> None:
        for name in self.observed_states:
            require_state(name, channels.state_names)
        self.law_parameters(channels)

    def law_parameters(self, helm: SupportsMaxRudder) -> dict[str, Any]:
        """Return the parameters of the control law, numbers or lists of numbers."""
        return {name: getattr(self, name) for name in self.parameter_names}

    @classmethod
    @abstractmethod
    def initial_memory(cls, motion: BatchValues, parameters: BatchValues) -> Tensor:
        """Return the memory [B, k] of the control law at the start, of k numbers for each row."""

    @classmethod
    @abstractmethod
    def step_law(
        cls, motion: BatchValues, parameters: BatchValues, time: float, memory: Tensor
    ) -> tuple[Tensor, ...]:
        """Return propulsion and steering commands [B], and the memory [B, k] after the step.

        The commands hold during the step that begins at `time` in s. A diving manoeuvre returns
        the dive command [B] before the memory.
        """

    @classmethod
    def has_ended(
        cls, motion: BatchValues, parameters: BatchValues, time: float, memory: Tensor
    ) -> Tensor:
        """Return whether each row has reached its goal, [B] bool."""
        import torch

        return torch.zeros(len(memory), dtype=torch.bool)

    @classmethod
    def build_source(cls, manoeuvres: Sequence[Manoeuvre], helm: Helm, t: Tensor) -> Source:
        from residnet.manoeuvres.sources import ClosedLoopSource

        return ClosedLoopSource(
            [m for m in manoeuvres if isinstance(m, ClosedLoopManoeuvre)], helm, t
        )


class ManoeuvreFamily(Config, ABC):
    """Manoeuvres of one kind that are drawn at random.

    Attributes:
        count: number of manoeuvres.
    """

    count: int = Field(ge=1, le=10_000)

    @abstractmethod
    def sample_one(self, generator: np.random.Generator, duration: float) -> Manoeuvre:
        """Draw a manoeuvre of at most `duration` seconds with a random generator."""

    def sample_all(self, generator: np.random.Generator, duration: float) -> list[Manoeuvre]:
        """Draw `count` manoeuvres of at most `duration` seconds each with a random generator."""
        return [self.sample_one(generator, duration) for _ in range(self.count)]


def sample_uniform(generator: np.random.Generator, limits: Range) -> float:
    """Return a number that is uniform in a range."""
    return float(generator.uniform(*limits))


class SteeringConfig(Config):
    """Common settings of manoeuvres with a constant steering command or rudder angle.

    Attributes:
        drive: constant fraction of the full propulsion command, also in the approach.
        steer: fraction of the full steering command; positive turns to starboard.
        rudder: rudder angle instead of `steer`, for vessels with a rudder.
        start: time at which the steering begins.
    """

    drive: float = Field(ge=-1, le=1)
    steer: float | None = Field(default=None, ge=-1, le=1)
    rudder: Radians | None = None
    start: Seconds = Field(default=5.0, ge=0)

    @model_validator(mode="after")
    def _steer_or_rudder(self) -> SteeringConfig:
        if (self.steer is None) == (self.rudder is None):
            raise ValueError(
                "give either steer (share of full steer, -1 to 1) or rudder (an angle such as '10"
                " deg')"
            )
        return self

    @property
    def side(self) -> float:
        """Sign of the demanded steering command or rudder angle, +1 or -1."""
        return -1.0 if (self.steer if self.steer is not None else self.rudder or 0.0) < 0 else 1.0

    def steer_share(self, helm: SupportsMaxRudder) -> float:
        """Return the fraction of the full steering command on a vessel.

        Raises:
            UsageError: if an angle is demanded of a vessel without rudder, or an angle above its
                limit.
        """
        return self.steer if self.steer is not None else rudder_share(self.rudder or 0.0, helm)


def rudder_share(angle: float, helm: SupportsMaxRudder) -> float:
    """Return the fraction of the full steering command that corresponds to a rudder angle [rad].

    Raises:
        UsageError: if the vessel has no rudder, or the angle exceeds its limit.
    """
    max_rudder = helm.max_rudder
    if max_rudder is None:
        raise UsageError(
            "the manoeuvre gives a rudder angle, but the vessel has no rudder; give steer, a share"
            " of full steer from -1 to 1"
        )
    share = angle / max_rudder
    # the margin accepts an angle equal to the limit after its conversion from degrees
    if abs(share) > 1.0 + 1e-9:
        raise UsageError(
            f"the manoeuvre demands {math.degrees(abs(angle)):.4g} deg of rudder, the limit of the"
            f" vessel is {math.degrees(max_rudder):.4g} deg"
        )
    return share

"""A learned model with steering and propulsion in front, flown by commands like the vessel."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Literal, final

import torch
from torch import Tensor, nn

from residnet.core import columns
from residnet.core.config import Config, Quantity
from residnet.core.errors import ConfigError
from residnet.core.names import CHANNEL_UNITS, suggest_name
from residnet.dynamics.base import Dynamics
from residnet.dynamics.hybrid import HybridDynamics
from residnet.engine.recorded_plant import RecordedPlantDynamics
from residnet.physics.plant import ROLLING_LAYOUT, SUBMERGED_LAYOUT, Plant
from residnet.physics.symmetry import get_dof

_RATES = {"rad": "rad/s", "1/s": "1/s^2", "m": "m/s", "-": "1/s"}


class Actuators(nn.Module, ABC):
    """A set of actuators whose states do not depend on the motion of the hull.

    Attributes:
        state: names of the states a [B, k].
        inputs: names of the inputs w [B, m]: commands, then what nobody commands.
        commands: how many of the inputs are commands.
    """

    state: tuple[str, ...]
    inputs: tuple[str, ...]
    commands: int

    @abstractmethod
    def demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return commands [..., c] from the normalised drive and steer [...] of a manoeuvre."""

    @abstractmethod
    def move(self, a: Tensor, w: Tensor) -> Tensor:
        """Return the states [B, k] one step later under inputs w [B, m]."""

    @abstractmethod
    def approach(self, rows: int, hull: Sequence[str]) -> Tensor:
        """Return the state [rows, h + k] that trials start from, float64: hull, then actuators.

        Args:
            rows: number of trials.
            hull: names of the h states of the hull; states unknown to the actuators are zero.
        """


@final
class PlantActuators(Actuators):
    """Interface of the actuators of a plant.

    The plant itself moves them, and what its hull would do is thrown away.
    """

    def __init__(self, plant: Plant, dt: float, substeps: int = 1) -> None:
        super().__init__()
        self.plant = plant
        self.inputs = plant.input_names
        self.commands = plant.n_commands
        self.columns = [
            i
            for i, name in enumerate(plant.state_names)
            if name not in (*ROLLING_LAYOUT.state_names, *SUBMERGED_LAYOUT.state_names)
        ]
        self.state = tuple(plant.state_names[i] for i in self.columns)
        self.dynamics = RecordedPlantDynamics(plant, dt, substeps) if self.columns else None

    def demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        return self.plant.commands_for_demand(drive, steer)

    def move(self, a: Tensor, w: Tensor) -> Tensor:
        """Return the states [B, k] one step later.

        The hull is where trials start; the actuators do not feel its motion.
        """
        if self.dynamics is None:
            return a
        x = self.plant.make_initial_state(a.shape[0])
        x[:, self.columns] = a
        return self.dynamics.step(x, w, x[:, :0])[0][:, self.columns]

    def approach(self, rows: int, hull: Sequence[str]) -> Tensor:
        known = dict(
            zip(self.plant.state_names, self.plant.make_initial_state(rows).unbind(1), strict=True)
        )
        still = torch.zeros(rows, dtype=torch.float64)
        return torch.stack([known.get(name, still) for name in (*hull, *self.state)], dim=1)


class InputShare(Config):
    """A rule by which one input of a learned model follows the demands of a manoeuvre.

    All values are in the input's SI unit, or text with a unit.

    Attributes:
        drive: value at full drive.
        steer: value at full steer to starboard.
        centre: value without demand.
        limit: largest deviation from `centre` of either sign; None: the sum of both shares.
        rate: change per second at most; None: at once.
    """

    drive: float | str = 0.0
    steer: float | str = 0.0
    centre: float | str = 0.0
    limit: float | str | None = None
    rate: float | str | None = None

    def numbers(self, name: str) -> list[float]:
        """Return drive, steer, centre, limit and rate of the input `name` in SI.

        Raises:
            ConfigError: where a value has a wrong unit, or nothing moves the input.
        """
        unit = CHANNEL_UNITS.get(name, "-")
        value = Quantity(unit)
        rate = Quantity(_RATES[unit]) if unit in _RATES else None
        fastest = float("inf")
        try:
            drive, steer, centre = map(value.convert, (self.drive, self.steer, self.centre))
            limit = abs(drive) + abs(steer) if self.limit is None else value.convert(self.limit)
            if self.rate is not None:
                fastest = float(self.rate) if rate is None else rate.convert(self.rate)
        except ValueError as error:
            raise ConfigError(f"inputs.{name}: {error}") from None
        if limit <= 0 or fastest <= 0:
            raise ConfigError(
                f"inputs.{name}: limit and rate must be above zero, and a share given of drive or"
                f" steer; {limit:g}, {fastest:g}"
            )
        return [drive, steer, centre, limit, fastest]


@final
class GivenActuators(Actuators):
    """Inputs that follow the demands within limits and rates.

    Args:
        shares: by the name of the model's input; its command is that name after `cmd_`.
        exogenous: further inputs of the model, which nobody commands.
        dt: step in s.

    Raises:
        ConfigError: where a value has a wrong unit.
    """

    def __init__(
        self, shares: Mapping[str, InputShare], exogenous: tuple[str, ...], dt: float
    ) -> None:
        super().__init__()
        self.inputs = (*map(commanded, shares), *exogenous)
        self.commands = len(shares)
        rows = [share.numbers(name) for name, share in shares.items()]
        table = torch.tensor(rows, dtype=torch.float64)
        self.shares = table[:, :2].T.contiguous()
        self.centre, self.limit, self.rate = table[:, 2:].unbind(-1)
        self.limited = [i for i, row in enumerate(rows) if row[4] != float("inf")]
        # what can jump to its command needs no state
        self.state = tuple(list(shares)[i] for i in self.limited)
        self.dt = dt

    def demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        both = torch.stack((drive, steer), dim=-1) @ self.shares.to(drive.dtype)
        limit = self.limit.to(drive.dtype)
        return self.centre.to(drive.dtype) + torch.minimum(torch.maximum(both, -limit), limit)

    def move(self, a: Tensor, w: Tensor) -> Tensor:
        """Return the states [B, k] one step later, towards their commands by at most the rate."""
        step = self.rate[self.limited].to(a.dtype) * self.dt
        return a + torch.minimum(torch.maximum(w[:, self.limited] - a, -step), step)

    def approach(self, rows: int, hull: Sequence[str]) -> Tensor:
        """Return the state with zero velocity, and the inputs without demand."""
        still = torch.zeros(rows, len(hull), dtype=torch.float64)
        return torch.cat((still, self.centre[self.limited].expand(rows, -1)), dim=-1)


def commanded(name: str) -> str:
    """Return the name of the command that an input follows."""
    return name if name.startswith("cmd_") else f"cmd_{name}"


@final
class ActuatedDynamics(Dynamics):
    """A learned model behind actuators, with states x [B, 3 + n + k] and their inputs w [B, m].

    The state contains the state of the model, then the states of the actuators.

    Each input of the model is a state of the actuators where they have one of that name, else one
    of their inputs, else the command of that name (`cmd_delta` for `delta`: a rudder that stands at
    its command at once has no state). A model that was fitted on inputs averaged over each step
    (`hold: mean`) is given the mean of the values at the step's ends, as in its fit.

    Args:
        model: the learned model.
        columns: names of the model's inputs, `spec.signals.columns`.
        hold: of the model's inputs, `spec.hold`.
        actuators: with the step of the model.

    Raises:
        ConfigError: where the actuators have nothing for an input of the model.
    """

    def __init__(
        self,
        model: HybridDynamics,
        columns: tuple[str, ...],
        hold: Literal["start", "mean"],
        actuators: Actuators,
    ) -> None:
        super().__init__(model.dt, model.integrator)
        self.model = model
        self.actuators = actuators
        self.n_state = model.n_state
        self.dof = model.dof
        self.has_roll = model.has_roll
        self.hull = get_dof(model.signals.names).state_names
        self.state = (*self.hull, *actuators.state)
        self.mean = hold == "mean"
        names = [*actuators.state, *actuators.inputs]
        self.take: list[int] = []
        for name in columns:
            found = next((given for given in (name, commanded(name)) if given in names), None)
            if found is None:
                raise ConfigError(
                    f"the model is driven by '{name}', which the vessel's actuators do not"
                    f" have{suggest_name(name, names)}"
                )
            self.take.append(names.index(found))

    def initial_state(self, batch: int) -> Tensor:
        return self.model.initial_state(batch)

    def approach(self, rows: int) -> Tensor:
        """Return the state [rows, 3 + n + k] that trials start from, float64."""
        return self.actuators.approach(rows, self.hull)

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        a = columns.actuator_states(x, self.dof)
        moved = self.actuators.move(a, w)
        given = torch.cat((a, w), dim=-1)[:, self.take]
        if self.mean:
            given = 0.5 * (given + torch.cat((moved, w), dim=-1)[:, self.take])
        y, s = self.model.step(columns.pose_and_dynamic_states(x, self.dof), given, s)
        return torch.cat((y, moved), dim=-1), s

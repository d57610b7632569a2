"""A learned model with actuators in series, which is driven by commands like the vessel."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Literal, final

import torch
from torch import Tensor, nn

from residnet.core import columns
from residnet.core.errors import ConfigError
from residnet.core.layout import ROLL_PLANT_LAYOUT, SIX_DOF_PLANT_LAYOUT
from residnet.core.names import suggest_name
from residnet.dynamics.base import Dynamics
from residnet.dynamics.hybrid import HybridDynamics
from residnet.engine.recorded_plant import RecordedPlantDynamics
from residnet.physics.plant import Plant
from residnet.physics.symmetry import get_dof

if TYPE_CHECKING:
    from residnet.manoeuvres.input_shares import InputShare


_MAX_DELAY_STEPS = 1000
"""Longest delay of an actuator in time steps."""


class Actuators(nn.Module, ABC):
    """A set of actuators whose states do not depend on the motion of the hull.

    Attributes:
        state_names: names of the states a [B, k].
        input_names: names of the inputs w [B, m]: commands, then exogenous inputs.
        n_commands: number of commands among the inputs.
    """

    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    n_commands: int

    @abstractmethod
    def commands_for_demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return commands [..., c] from normalised propulsion and steering commands [...]."""

    @abstractmethod
    def step_states(self, a: Tensor, w: Tensor) -> Tensor:
        """Return the states [B, k] one time step later under inputs w [B, m]."""

    @abstractmethod
    def make_initial_state(self, n_rows: int, hull: Sequence[str]) -> Tensor:
        """Return the initial state of trials [B, h + k], float64: hull, then actuators.

        Args:
            n_rows: number of trials B.
            hull: names of the h states of the hull; states unknown to the actuators are zero.
        """


@final
class PlantActuators(Actuators):
    """The actuators of a plant.

    The complete plant is simulated, and the motion of its hull is discarded.

    Args:
        plant: plant with the actuators.
        dt: time step in s.
        substeps: integration steps per time step.
    """

    def __init__(self, plant: Plant, dt: float, substeps: int = 1) -> None:
        super().__init__()
        self.plant = plant
        self.input_names = plant.input_names
        self.n_commands = plant.n_commands
        self.columns = [
            i
            for i, name in enumerate(plant.state_names)
            if name not in (*ROLL_PLANT_LAYOUT.state_names, *SIX_DOF_PLANT_LAYOUT.state_names)
        ]
        self.state_names = tuple(plant.state_names[i] for i in self.columns)
        self.dynamics = RecordedPlantDynamics(plant, dt, substeps) if self.columns else None

    def commands_for_demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        return self.plant.commands_for_demand(drive, steer)

    def step_states(self, a: Tensor, w: Tensor) -> Tensor:
        """Return the states [B, k] one time step later, with the hull in its initial state."""
        if self.dynamics is None:
            return a
        # actuators do not depend on the motion, so that any hull state gives the same result
        x = self.plant.make_initial_state(a.shape[0])
        x[:, self.columns] = a
        return self.dynamics.step(x, w, x[:, :0])[0][:, self.columns]

    def make_initial_state(self, n_rows: int, hull: Sequence[str]) -> Tensor:
        plant_state = self.plant.make_initial_state(n_rows)
        value_of_state = dict(zip(self.plant.state_names, plant_state.unbind(1), strict=True))
        zeros = torch.zeros(n_rows, dtype=torch.float64)
        names = (*hull, *self.state_names)
        return torch.stack([value_of_state.get(name, zeros) for name in names], dim=1)


@final
class ConfiguredActuators(Actuators):
    """Actuators with limits, rates, lags and delays from a config instead of a plant.

    A command takes effect after its delay. The position then follows it with a first-order lag,
    a_dot = (command - a) / T, within the rate limit. The response is exact for a constant command
    below the rate limit, at any time step.

    Args:
        shares: mapping from demands to each input of the model by name; the command of an input
            has the prefix `cmd_`.
        exogenous: names of the exogenous inputs of the model.
        dt: time step in s. A delay is rounded to steps.

    Raises:
        ConfigError: if a value has a wrong unit, or a delay is longer than 1000 steps.
    """

    def __init__(
        self, shares: Mapping[str, InputShare], exogenous: tuple[str, ...], dt: float
    ) -> None:
        super().__init__()
        self.input_names = (*map(command_name_for, shares), *exogenous)
        self.n_commands = len(shares)
        rows = [share.to_si(name) for name, share in shares.items()]
        table = torch.tensor(rows, dtype=torch.float64)
        self.shares = table[:, :2].T.contiguous()
        self.centre, self.limit, self.rate = table[:, 2:].unbind(-1)
        # an input that equals its command needs no state
        self.servo_indices = [i for i, share in enumerate(shares.values()) if share.has_dynamics]
        lags = torch.tensor([share.lag for share in shares.values()], dtype=torch.float64)
        # share of the remaining distance that a first-order lag covers in a step; 1 without lag
        self.step_share = torch.where(lags > 0.0, -torch.expm1(-dt / lags.clamp(min=1e-12)), 1.0)
        self.delay_steps = [round(share.delay / dt) for share in shares.values()]
        if max(self.delay_steps, default=0) > _MAX_DELAY_STEPS:
            raise ConfigError(
                f"inputs: a delay of {max(self.delay_steps)} time steps is longer than"
                f" {_MAX_DELAY_STEPS}; check its unit"
            )
        names = list(shares)
        # positions first, then the commands under way of each input, the newest first
        self.delay_inputs = [i for i in self.servo_indices for _ in range(self.delay_steps[i])]
        self.state_names = (
            *(names[i] for i in self.servo_indices),
            *(
                f"_{names[i]}_delay{k + 1}"
                for i in self.servo_indices
                for k in range(self.delay_steps[i])
            ),
        )
        self.dt = dt

    def commands_for_demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        deviation = torch.stack((drive, steer), dim=-1) @ self.shares.to(drive.dtype)
        limit = self.limit.to(drive.dtype)
        return self.centre.to(drive.dtype) + torch.minimum(torch.maximum(deviation, -limit), limit)

    def step_states(self, a: Tensor, w: Tensor) -> Tensor:
        """Move the positions [B, k] towards their delayed commands, and shift the delay lines."""
        positions, *lines = a.split(
            [len(self.servo_indices), *(self.delay_steps[i] for i in self.servo_indices)], dim=-1
        )
        targets = []
        next_lines = []
        for index, line in zip(self.servo_indices, lines, strict=True):
            command = w[:, index : index + 1]
            delayed = torch.cat((command, line), dim=-1)
            targets.append(delayed[:, -1:])
            next_lines.append(delayed[:, :-1])
        if not targets:
            return a
        step_share = self.step_share[self.servo_indices].to(a.dtype)
        max_change = self.rate[self.servo_indices].to(a.dtype) * self.dt
        difference = step_share * (torch.cat(targets, dim=-1) - positions)
        change = torch.minimum(torch.maximum(difference, -max_change), max_change)
        return torch.cat((positions + change, *next_lines), dim=-1)

    def make_initial_state(self, n_rows: int, hull: Sequence[str]) -> Tensor:
        """Return the state with zero velocity, and the inputs without demand."""
        hull_state = torch.zeros(n_rows, len(hull), dtype=torch.float64)
        columns_of_centre = [*self.servo_indices, *self.delay_inputs]
        actuator_state = self.centre[columns_of_centre].expand(n_rows, -1)
        return torch.cat((hull_state, actuator_state), dim=-1)


def command_name_for(name: str) -> str:
    """Return `cmd_<name>` for an input such as `delta`; a command keeps its name."""
    return name if name.startswith("cmd_") else f"cmd_{name}"


@final
class ActuatedDynamics(Dynamics):
    """A learned model driven by actuators, with states x [B, 3 + n + k] and inputs w [B, m].

    The state contains the state of the model, then the states of the actuators. An input of the
    model is a state of the actuators with this name, else an input of the actuators, else the
    command (`cmd_delta` for `delta` of a rudder without dynamics). A model that was fitted to step
    means (`hold: mean`) receives the mean of the values at both ends of a step.

    Args:
        model: learned model.
        columns: names of the inputs of the model, `spec.signals.input_columns`.
        hold: `start` or `mean`, `spec.hold`.
        actuators: actuators with the time step of the model.

    Raises:
        ConfigError: if the actuators provide no value for an input of the model.
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
        self.state_names = (*self.hull, *actuators.state_names)
        self.has_mean_inputs = hold == "mean"
        names = [*actuators.state_names, *actuators.input_names]
        self.input_columns: list[int] = []
        for name in columns:
            # a measured position comes before its command, because the model was fitted to measured
            # inputs
            candidates = (name, command_name_for(name))
            source = next((candidate for candidate in candidates if candidate in names), None)
            if source is None:
                raise ConfigError(
                    f"the model needs the input '{name}', which the actuators of the vessel do not"
                    f" have{suggest_name(name, names)}"
                )
            self.input_columns.append(names.index(source))

    def initial_state(self, batch: int) -> Tensor:
        return self.model.initial_state(batch)

    def make_initial_state(self, n_rows: int) -> Tensor:
        """Return the initial state of trials [B, 3 + n + k], float64."""
        return self.actuators.make_initial_state(n_rows, self.hull)

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        a = columns.actuator_states(x, self.dof)
        # actuators first, since the mean over the step needs their values at its end
        next_a = self.actuators.step_states(a, w)
        inputs = torch.cat((a, w), dim=-1)[:, self.input_columns]
        if self.has_mean_inputs:
            inputs = 0.5 * (inputs + torch.cat((next_a, w), dim=-1)[:, self.input_columns])
        hull_state = columns.pose_and_dynamic_states(x, self.dof)
        next_hull, s = self.model.step(hull_state, inputs, s)
        return torch.cat((next_hull, next_a), dim=-1), s

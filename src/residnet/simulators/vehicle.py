"""A vessel or a learned model for simulators: states, commands with limits, and a step."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from residnet.core.errors import UsageError
from residnet.core.layout import SURGE
from residnet.core.names import STATE_NAMES
from residnet.dynamics.base import Dynamics
from residnet.dynamics.store import load_model, resolve_model_name
from residnet.engine.recorded_plant import RecordedPlantDynamics
from residnet.engine.rollout import Rollout
from residnet.export.guard import GuardedDynamics
from residnet.physics.plant import Plant
from residnet.physics.vessel import load_vessel

_SETTLING_STEPS = 600
"""Number of steps to reach the cruise speed, at half of the full propulsion command."""


@dataclass(frozen=True)
class Vehicle:
    """A vessel or learned model with command limits.

    Attributes:
        name: name of the vessel or model.
        dynamics: guarded dynamics, defined for every input.
        states: names of the columns of x, starting with pose and velocities.
        inputs: names of the columns of w: commands, then exogenous inputs.
        n_commands: number of commands among the inputs.
        lower_commands: lower limits of the commands [c], SI.
        upper_commands: upper limits of the commands [c], SI.
        exogenous_inputs: values of the exogenous inputs [m - c] in calm water.
        initial_state: initial state [nx] of an episode.
        cruise: cruise speed in m/s, the unit of speed errors.
    """

    name: str
    dynamics: Dynamics
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    n_commands: int
    lower_commands: Tensor
    upper_commands: Tensor
    exogenous_inputs: Tensor
    initial_state: Tensor
    cruise: float

    def inputs_at(self, commands: Tensor) -> Tensor:
        """Return the inputs [B, m] of commands [B, c] in calm water, clamped to their limits."""
        clamped_commands = torch.minimum(
            torch.maximum(commands, self.lower_commands), self.upper_commands
        )
        return torch.cat(
            (clamped_commands, self.exogenous_inputs.expand(len(clamped_commands), -1)), dim=-1
        )


def load_vehicle(source: str | Path, *, model: str = "selected", dt: float = 0.1) -> Vehicle:
    """Return a vehicle from a run folder, a vessel name or a vessel file.

    Args:
        source: folder of a finished fit, name of a vessel or path of a vessel file.
        model: name of the model of the run.
        dt: time step of a vessel in s; ignored for a learned model.

    Raises:
        UsageError: if the vessel, run or model does not exist or its motion is not planar.
    """
    if Path(source).is_dir():
        return load_learned_vehicle(Path(source), model)
    return build_plant_vehicle(str(source), load_vessel(str(source)).build(), dt)


def load_learned_vehicle(run: Path, name: str = "selected") -> Vehicle:
    """Return a learned model with the input guard of its exports as a vehicle.

    Commands are the inputs within their training ranges; there is no wind.

    Raises:
        UsageError: if the run has no such model.
    """
    spec, model = load_model(run / "models" / resolve_model_name(run, name))
    dof = spec.signals.dof
    dof.require_on_surface("a simulator")
    guarded_step = _UnflaggedStep(
        GuardedDynamics(model.float(), spec).float().eval().requires_grad_(False)
    )
    command_columns = slice(dof.n_dynamic, dof.n_dynamic + len(spec.signals.inputs))
    lower = torch.tensor(spec.low)
    upper = torch.tensor(spec.high)
    # no wind; unexcited inputs stay where the logs held them
    unexcited_columns = slice(dof.n_dynamic + len(spec.signals.regressor_columns), None)
    calm_inputs = torch.cat(
        (
            torch.zeros(len(spec.signals.exogenous)),
            0.5 * (lower[unexcited_columns] + upper[unexcited_columns]),
        )
    )
    return _with_cruise_speed(
        Vehicle(
            spec.name,
            guarded_step,
            dof.state_names,
            spec.signals.input_columns,
            len(spec.signals.inputs),
            lower[command_columns],
            upper[command_columns],
            calm_inputs,
            torch.zeros(len(dof.state_names)),
            float(max(abs(lower[0]), abs(upper[0]))),
        )
    )


class _UnflaggedStep(Dynamics):
    """The guarded step without the flag among the states."""

    def __init__(self, guarded: GuardedDynamics) -> None:
        super().__init__(guarded.dt, guarded.integrator)
        self.guarded = guarded
        self.n_state = guarded.n_state

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        next_state, s, _ = self.guarded.flagged_step(x, w, s)
        return next_state, s


def build_plant_vehicle(name: str, plant: Plant, dt: float) -> Vehicle:
    """Return a vessel as a vehicle in calm water.

    The limits are the commands of full propulsion and full steering.

    Raises:
        UsageError: if it has other degrees of freedom than surge, sway and yaw.
    """
    if plant.state_names[: len(STATE_NAMES)] != STATE_NAMES:
        raise UsageError(
            f"vessel {name}: its states are {', '.join(plant.state_names)}; simulators need"
            f" {', '.join(STATE_NAMES)} as the first states"
        )
    plant = plant.eval().requires_grad_(False)
    demand_corners = torch.tensor([[a, b] for a in (-1.0, 0.0, 1.0) for b in (-1.0, 0.0, 1.0)])
    commands = plant.commands_for_demand(
        demand_corners[:, 0].double(), demand_corners[:, 1].double()
    )
    return _with_cruise_speed(
        Vehicle(
            name,
            RecordedPlantDynamics(plant, dt),
            plant.state_names,
            plant.input_names,
            plant.n_commands,
            commands.amin(0),
            commands.amax(0),
            torch.zeros(len(plant.input_names) - plant.n_commands, dtype=torch.float64),
            plant.make_initial_state(1)[0],
            float(plant.make_initial_state(1)[0, SURGE]),
        )
    )


def _with_cruise_speed(base_vehicle: Vehicle) -> Vehicle:
    """Return a vehicle with its cruise speed, the steady speed at half of full propulsion."""
    partial_drive = base_vehicle.lower_commands + 0.75 * (
        base_vehicle.upper_commands - base_vehicle.lower_commands
    )
    # commands with a symmetric range are rudders, which stay amidships, or reversible propellers,
    # which propulsion command: both cases are simulated and the faster one is used
    balanced_drive = torch.where(
        (base_vehicle.lower_commands + base_vehicle.upper_commands).abs()
        < 1e-9 * base_vehicle.upper_commands.abs(),
        torch.zeros_like(partial_drive),
        partial_drive,
    )
    candidates = [partial_drive, balanced_drive]
    speeds = []
    for command in candidates:
        w = base_vehicle.inputs_at(command.unsqueeze(0)).unsqueeze(1).expand(1, _SETTLING_STEPS, -1)
        with torch.no_grad():
            states, _, _ = Rollout(base_vehicle.dynamics)(
                base_vehicle.initial_state.unsqueeze(0),
                w,
                base_vehicle.dynamics.initial_state(1).to(base_vehicle.initial_state.dtype),
            )
        speeds.append(float(states[0, -1, SURGE]))
    cruise = max([speed for speed in speeds if speed == speed and speed < 1e3], default=0.0)
    return Vehicle(**{**base_vehicle.__dict__, "cruise": max(cruise, base_vehicle.cruise, 0.1)})

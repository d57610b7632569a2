"""A vessel or a learned model as simulators see it: states, commands and their limits, one step."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from residnet.core.errors import UsageError
from residnet.core.layout import SURGE
from residnet.core.names import STATE
from residnet.dynamics.base import Dynamics
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.simulated import RecordedPlantDynamics
from residnet.dynamics.store import chosen_model, load_model
from residnet.export.guard import GuardedDynamics
from residnet.physics.plant import Plant
from residnet.physics.vessel import load_vessel

_SETTLING = 600
"""Steps within which a vessel reaches the speed that its middle drive stands for."""


@dataclass(frozen=True)
class Vehicle:
    """What a simulator steps.

    Attributes:
        name: of the vessel or model.
        dynamics: its step, defined for whatever it is given.
        states: names of the columns of x; pose and velocities stand first.
        inputs: names of the columns of w: commands, then what nobody commands.
        commands: how many of the inputs are commands.
        low: least commands [c], SI.
        high: largest commands [c], SI.
        rest: values of the other inputs [m - c] in calm water.
        start: state [nx] that an episode starts from.
        cruise: speed in m/s that errors are measured by.
    """

    name: str
    dynamics: Dynamics
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    commands: int
    low: Tensor
    high: Tensor
    rest: Tensor
    start: Tensor
    cruise: float

    def inputs_at(self, commands: Tensor) -> Tensor:
        """Return the inputs [B, m] of commands [B, c] in calm water, held to their limits."""
        held = torch.minimum(torch.maximum(commands, self.low), self.high)
        return torch.cat((held, self.rest.expand(len(held), -1)), dim=-1)


def vehicle(source: str | Path, *, model: str = "selected", dt: float = 0.1) -> Vehicle:
    """Return a learned model of a run's folder, or a vessel by its name or file.

    Args:
        source: folder of a finished fit; or a vessel's name, or the path of its file.
        model: which model of the run.
        dt: step in s of a vessel; a learned model has its own.

    Raises:
        UsageError: where there is no such vessel, run or model, or it has no planar motion.
    """
    if Path(source).is_dir():
        return learned_vehicle(Path(source), model)
    return plant_vehicle(str(source), load_vessel(str(source)).build(), dt)


def learned_vehicle(run: Path, name: str = "selected") -> Vehicle:
    """Return a learned model as a vehicle, bad inputs answered as its exports do.

    Its commands are its inputs within their training ranges; it feels no wind.

    Raises:
        UsageError: where the run has no such model.
    """
    spec, model = load_model(run / "models" / chosen_model(run, name))
    live = spec.signals.live
    live.require_on_surface("a simulator")
    guarded = _Guarded(GuardedDynamics(model.float(), spec).float().eval().requires_grad_(False))
    driven = slice(live.size, live.size + len(spec.signals.inputs))
    low, high = torch.tensor(spec.low), torch.tensor(spec.high)
    return _settled(
        Vehicle(
            spec.name,
            guarded,
            live.states,
            spec.signals.columns,
            len(spec.signals.inputs),
            low[driven],
            high[driven],
            torch.zeros(len(spec.signals.exogenous)),
            torch.zeros(len(live.states)),
            float(max(abs(low[0]), abs(high[0]))),
        )
    )


class _Guarded(Dynamics):
    """The guarded step without the flag among the states."""

    def __init__(self, guarded: GuardedDynamics) -> None:
        super().__init__(guarded.dt, guarded.integrator)
        self.guarded = guarded
        self.n_state = guarded.n_state

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        after, s, _ = self.guarded.flagged_step(x, w, s)
        return after, s


def plant_vehicle(name: str, plant: Plant, dt: float) -> Vehicle:
    """Return a vessel as a vehicle in calm water.

    Its limits are the commands that full drive and full steering of a manoeuvre stand for.

    Raises:
        UsageError: where it moves in other degrees of freedom than surge, sway and yaw.
    """
    if plant.state[: len(STATE)] != STATE:
        raise UsageError(
            f"vessel {name}: its states are {', '.join(plant.state)}; simulators take vessels with"
            f" {', '.join(STATE)} first"
        )
    plant = plant.eval().requires_grad_(False)
    corners = torch.tensor([[a, b] for a in (-1.0, 0.0, 1.0) for b in (-1.0, 0.0, 1.0)])
    demanded = plant.demand(corners[:, 0].double(), corners[:, 1].double())
    return _settled(
        Vehicle(
            name,
            RecordedPlantDynamics(plant, dt),
            plant.state,
            plant.inputs,
            plant.commands,
            demanded.amin(0),
            demanded.amax(0),
            torch.zeros(len(plant.inputs) - plant.commands, dtype=torch.float64),
            plant.approach(1)[0],
            float(plant.approach(1)[0, SURGE]),
        )
    )


def _settled(given: Vehicle) -> Vehicle:
    """Return a vehicle with the speed that commands half way up lead to as its cruise."""
    wish = given.low + 0.75 * (given.high - given.low)
    # what steers to both sides stays amidships, and drives of two sides go together
    balanced = torch.where(
        (given.low + given.high).abs() < 1e-9 * given.high.abs(), torch.zeros_like(wish), wish
    )
    candidates = [wish, balanced]
    speeds = []
    for command in candidates:
        w = given.inputs_at(command.unsqueeze(0)).unsqueeze(1).expand(1, _SETTLING, -1)
        with torch.no_grad():
            states, _, _ = Rollout(given.dynamics)(
                given.start.unsqueeze(0), w, given.dynamics.initial_state(1).to(given.start.dtype)
            )
        speeds.append(float(states[0, -1, SURGE]))
    cruise = max([speed for speed in speeds if speed == speed and speed < 1e3], default=0.0)
    return Vehicle(**{**given.__dict__, "cruise": max(cruise, given.cruise, 0.1)})

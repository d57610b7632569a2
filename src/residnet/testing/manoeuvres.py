"""The contract of manoeuvres."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from residnet.core.config import validate
from residnet.core.log import Log
from residnet.core.registry import kind_of
from residnet.data.simulated.environment import Disturbance
from residnet.data.simulated.flying import Craft, Flight, Sea, fly, source_of
from residnet.data.simulated.sensors import SensorNoise
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.simulated import PlantDynamics
from residnet.manoeuvres import Helm, Manoeuvre, ManoeuvreConfig
from residnet.physics.plant import Plant
from residnet.physics.vessel import load_vessel
from residnet.testing.require import require, require_equal, require_finite

_STEP = 0.1
_SHORT = 4


def check_manoeuvre(
    manoeuvre: Manoeuvre, vessel: str = "wam_v_cal", duration: float = 30.0
) -> Flight:
    """Check everything that residnet relies on in a manoeuvre, and return a flight of it.

    It is written and read back, flown alone and beside another of its kind with equal results, with
    a finite motion; inputs that are not commands pass through it; its indices are asked for, of the
    whole flight and of one that is too short for any.

    Args:
        manoeuvre: what to fly.
        vessel: name of the vessel that flies it.
        duration: in s, where the manoeuvre gives none.

    Raises:
        AssertionError: one line that says which contract is broken.
    """
    who = f"manoeuvre {kind_of(type(manoeuvre))}"
    read = validate(manoeuvre.model_dump(mode="json"), ManoeuvreConfig, "written")
    require(read == manoeuvre, f"{who}: changes when it is written and read back")
    plant = load_vessel(vessel).build()
    duration = manoeuvre.lasts(duration)
    _check_batch(manoeuvre, plant, duration, who)
    flight = _flight(manoeuvre, vessel, plant, duration)
    length = load_vessel(vessel).length.value
    _check_indices(manoeuvre.indices(flight.motion, length), who)
    short = flight.motion
    short = Log(
        short.name,
        short.t[:_SHORT],
        {n: v[:_SHORT] for n, v in short.channels.items()},
        short.units,
    )
    _check_indices(manoeuvre.indices(short, None), who)
    helm = Helm.from_plant(plant)
    limits = manoeuvre.limits(helm, length, 1.0)
    require(all(math.isfinite(limit) for limit in limits.values()), f"{who}: a limit is not finite")
    return flight


def _beginning(log: Log) -> Log:
    """Return a log that is too short for any index."""
    channels = {name: values[:_SHORT] for name, values in log.channels.items()}
    return Log(log.name, log.t[:_SHORT], channels, log.units)


def _flown(manoeuvres: list[Manoeuvre], plant: Plant, seconds: float) -> tuple[Tensor, Tensor]:
    """Return states [B, T+1, nx] and inputs [B, T, m] of manoeuvres of one kind side by side."""
    helm = Helm.from_plant(plant)
    t = torch.arange(max(round(seconds / _STEP), 2), dtype=torch.float64) * _STEP
    start = torch.stack([m.begin(plant.approach(1)[0], helm.state) for m in manoeuvres])
    w = torch.zeros(len(manoeuvres), len(t), len(plant.inputs), dtype=torch.float64)
    w[:, :, plant.commands :] = 0.01
    source = source_of(manoeuvres, helm, t)
    with torch.no_grad():
        states, inputs, _ = Rollout(PlantDynamics(plant, _STEP), source)(start, w, start[:, :0])
    return states, inputs


def _check_batch(manoeuvre: Manoeuvre, plant: Plant, seconds: float, who: str) -> None:
    alone, inputs = _flown([manoeuvre], plant, seconds)
    pair, commands = _flown([manoeuvre, manoeuvre], plant, seconds)
    require_finite(alone, f"{who}: the motion is not finite")
    require_finite(inputs, f"{who}: a command is not finite")
    count = plant.commands
    require(
        bool((inputs[:, :, count:] == 0.01).all()),
        f"{who}: changes inputs that are no commands, such as wind and current",
    )
    for row in range(2):
        message = f"{who}: flown beside another one it does something else"
        require_equal(pair[row], alone[0], 1e-9, message)
        require_equal(commands[row, :, :count], inputs[0, :, :count], 1e-9, message)


def _flight(manoeuvre: Manoeuvre, vessel: str, plant: Plant, duration: float) -> Flight:
    helm = Helm.from_plant(plant)
    craft = Craft(vessel, PlantDynamics(plant, _STEP), helm, plant.commands, plant.approach(1))
    return fly(craft, [manoeuvre], Sea(plant, Disturbance(), SensorNoise(), 0), duration, _STEP)[0]


def _check_indices(indices: dict[str, Any], who: str) -> None:
    for name, value in indices.items():
        numbers = np.atleast_1d(np.asarray(value))
        require(
            numbers.dtype.kind in "fiub" and bool(np.isfinite(numbers.astype(float)).all()),
            f"{who}: its index '{name}' is {value!r}, not finite numbers; leave it out instead",
        )

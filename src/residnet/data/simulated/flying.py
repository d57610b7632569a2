"""Flights of manoeuvres with a plant or a learned model, and the logs of sensors on them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
import torch
from torch import Tensor

from residnet.core.errors import DataError
from residnet.core.log import Log
from residnet.core.names import CHANNEL_UNITS
from residnet.data.simulated.environment import Disturbance, gusty_wind
from residnet.data.simulated.sensors import SensorNoise
from residnet.dynamics.base import Dynamics
from residnet.dynamics.rollout import Rollout, Source
from residnet.manoeuvres.base import Helm, Manoeuvre, StackedSource, Watched
from residnet.physics.environment import WIND_INPUTS
from residnet.physics.plant import Plant


@dataclass(frozen=True)
class Craft:
    """A vessel that flies manoeuvres: a plant or a learned model.

    Attributes:
        name: in logs and tables.
        dynamics: a plant or a learned model, stepping as the logs do.
        helm: of it.
        commands: how many of its inputs are commands.
        start: state [1, nx] that trials start from, or one for each, [B, nx]; float64.
    """

    name: str
    dynamics: Dynamics
    helm: Helm
    commands: int
    start: Tensor


@dataclass(frozen=True)
class Sea:
    """What surrounds a craft, and what measures it.

    Attributes:
        plant: whose inputs the disturbance is laid out for; None for a model without a vessel,
            which feels the wind alone.
        disturbance: forces, current, wind, waves.
        noise: of the sensors.
        seed: of everything random in both.
    """

    plant: Plant | None
    disturbance: Disturbance
    noise: SensorNoise
    seed: int


@dataclass(frozen=True)
class Flight:
    """One manoeuvre as it was flown.

    Attributes:
        manoeuvre: what was to be flown.
        motion: the motion itself.
        log: what sensors measured of it. Its meta says `timed_out` where the stop condition was not
            reached, `diverged` where the motion ceased to be finite; both logs end there.
    """

    manoeuvre: Manoeuvre
    motion: Log
    log: Log

    @property
    def fault(self) -> str | None:
        """Why the manoeuvre did not end as it should, in words; None where it did."""
        seconds = f"{self.motion.t[-1] - self.motion.t[0]:.5g} s"
        if self.log.meta.get("diverged"):
            return f"the motion was no longer finite after {seconds}"
        return (
            f"timed out after {seconds} before {self.manoeuvre.goal}"
            if self.log.meta.get("timed_out")
            else None
        )


def source_of(manoeuvres: Sequence[Manoeuvre], helm: Helm, t: Tensor) -> Source:
    """Return the source that flies manoeuvres of any kinds side by side.

    t [T] are the times of the steps.

    Raises:
        UsageError: where the vessel lacks what a manoeuvre needs.
    """
    runs = [list(members) for _, members in groupby(manoeuvres, key=lambda m: m.kind)]
    return StackedSource(
        [type(members[0]).source(members, helm, t) for members in runs],
        [len(members) for members in runs],
    )


def fly(
    craft: Craft,
    manoeuvres: Sequence[Manoeuvre],
    sea: Sea,
    duration: float,
    step: float,
    about: Mapping[str, Any] | None = None,
) -> list[Flight]:
    """Fly the manoeuvres in one batch.

    Args:
        craft: plant or learned model.
        manoeuvres: in the order of the result; rows that reach their stop condition end there.
        sea: disturbance and sensors.
        duration: of manoeuvres that give none, in s.
        step: of the logs in s.
        about: what the meta of the logs shall say.

    Raises:
        UsageError: where the vessel lacks what a manoeuvre needs.
        DataError: where the motion of a manoeuvre is not finite from its first step on.
    """
    rows = len(manoeuvres)
    lengths = [max(round(manoeuvre.lasts(duration) / step), 2) for manoeuvre in manoeuvres]
    steps = max(lengths)
    t = torch.arange(steps, dtype=torch.float64) * step
    random = np.random.default_rng([sea.seed, 3])
    source, w = (
        source_of(manoeuvres, craft.helm, t),
        _surroundings(sea, craft, rows, steps, step, random),
    )
    if sea.plant is not None:
        source = sea.disturbance.surround(source, sea.plant, rows, step, sea.seed)
    watched = Watched(source, rows)
    starts = craft.start.expand(rows, -1)
    start = torch.stack(
        [
            manoeuvre.begin(x, craft.helm.state)
            for manoeuvre, x in zip(manoeuvres, starts, strict=True)
        ]
    )
    with torch.no_grad():
        states, inputs, _ = Rollout(craft.dynamics, watched)(
            start, w, craft.dynamics.initial_state(rows).to(w.dtype)
        )
    noise = random.standard_normal((rows, steps, 3)) * [sea.noise.u, sea.noise.v, sea.noise.r]
    flights = []
    for i, (manoeuvre, name) in enumerate(zip(manoeuvres, log_names(manoeuvres), strict=True)):
        stopped = int(watched.stopped[i])
        reached = 0 <= stopped < lengths[i]
        length = stopped + 1 if reached else lengths[i]
        finite = np.isfinite(states[i, :length].numpy()).all(axis=1)
        meta: dict[str, Any] = {
            **(about or {}),
            "demand": manoeuvre.model_dump(mode="json"),
            "seed": sea.seed,
        }
        if not finite.all():
            length, meta["diverged"] = int(np.argmin(finite)), True
        elif manoeuvre.goal is not None and not reached:
            meta["timed_out"] = True
        if length < 2:
            raise DataError(
                f"{craft.name}, {name}: the motion is not finite from its first step on"
            )
        clean = _channels(craft, sea, states[i, :length], inputs[i, :length])
        time = t[:length].numpy().copy()
        measured = sea.noise.measured(clean, time, noise[i, :length], (sea.seed, 6, i))
        units = {channel: CHANNEL_UNITS.get(channel, "-") for channel in clean}
        motion = Log(name, time, clean, units, manoeuvre.kind, meta=meta)
        flights.append(Flight(manoeuvre, motion, motion.replace(channels=measured)))
    return flights


def _channels(craft: Craft, sea: Sea, states: Tensor, inputs: Tensor) -> dict[str, np.ndarray]:
    """Return the channels [T] of a flight's log from states [T, nx] and inputs [T, m]."""
    channels = dict(zip(craft.helm.state, states.T, strict=True)) | dict(
        zip(craft.helm.inputs, inputs.T, strict=True)
    )
    return {name: channels[name].numpy().copy() for name in logged_channels(craft, sea)}


def logged_channels(craft: Craft, sea: Sea) -> tuple[str, ...]:
    """Return the names of the channels of a flight's log: states, commands, what is measured."""
    names = [
        *(name for name in craft.helm.state if not name.startswith("_")),
        *craft.helm.inputs[: craft.commands],
        *sea.disturbance.logged,
    ]
    return tuple(dict.fromkeys(names))


def _surroundings(
    sea: Sea, craft: Craft, rows: int, steps: int, step: float, random: np.random.Generator
) -> Tensor:
    """Return the inputs [B, T, m] with the commands zero."""
    if sea.plant is not None:
        return torch.from_numpy(
            sea.disturbance.series(sea.plant, rows, steps, step, sea.seed, random)
        )
    w = torch.zeros(rows, steps, len(craft.helm.inputs), dtype=torch.float64)
    if sea.disturbance.wind is not None:
        wind = gusty_wind(
            sea.disturbance.wind, rows, steps, step, np.random.default_rng([sea.seed, 4])
        )
        for name, values in zip(WIND_INPUTS, wind, strict=True):
            w[:, :, craft.helm.inputs.index(name)] = torch.from_numpy(values)
    return w


def log_names(manoeuvres: Sequence[Manoeuvre]) -> list[str]:
    """Return the names of the logs: as given, else the kind with its number."""
    count: dict[str, int] = {}
    out = []
    for manoeuvre in manoeuvres:
        count[manoeuvre.kind] = count.get(manoeuvre.kind, 0) + 1
        out.append(manoeuvre.name or f"{manoeuvre.kind}_{count[manoeuvre.kind]:02d}")
    return out

"""Simulated sea trials: manoeuvres that a plant or a learned model flies, and their logs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any, Literal

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

from residnet.core.config import Config, Seconds
from residnet.core.errors import ConfigError, DataError
from residnet.core.log import Log
from residnet.core.names import CHANNEL_UNITS
from residnet.data.sea import Disturbance, SensorNoise, gusty_wind
from residnet.dynamics.base import Dynamics
from residnet.dynamics.rollout import Rollout, Source
from residnet.dynamics.simulated import PlantDynamics, RecordedPlantDynamics, check_steps
from residnet.manoeuvres import FamilyConfig
from residnet.manoeuvres.base import Helm, Manoeuvre, StackedSource, Watched
from residnet.physics.plant import HullPlant, Plant
from residnet.physics.vessel import VesselName, load_vessel


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
    source = source_of(manoeuvres, craft.helm, t)
    if sea.plant is not None:
        w = sea.disturbance.series(sea.plant, rows, steps, step, sea.seed, random)
        source = sea.disturbance.surround(source, sea.plant, rows, step, sea.seed)
    else:
        w = np.zeros((rows, steps, len(craft.helm.inputs)))
        for channel, values in gusty_wind(
            sea.disturbance.wind, rows, steps, step, sea.seed
        ).items():
            w[:, :, craft.helm.inputs.index(channel)] = values
    watched = Watched(source, rows)
    begun = zip(manoeuvres, craft.start.expand(rows, -1), strict=True)
    start = torch.stack([manoeuvre.begin(x, craft.helm.state) for manoeuvre, x in begun])
    with torch.no_grad():
        memory = craft.dynamics.initial_state(rows).to(torch.float64)
        rollout = Rollout(craft.dynamics, watched)
        states, inputs, _ = rollout(start, torch.from_numpy(w), memory)
    noise = random.standard_normal((rows, steps, 3)) * [sea.noise.u, sea.noise.v, sea.noise.r]
    flights = []
    for i, (manoeuvre, name) in enumerate(zip(manoeuvres, log_names(manoeuvres), strict=True)):
        stopped = int(watched.stopped[i])
        reached = 0 <= stopped < lengths[i]
        length = stopped + 1 if reached else lengths[i]
        finite = np.isfinite(states[i, :length].numpy()).all(axis=1)
        demand = manoeuvre.model_dump(mode="json")
        meta: dict[str, Any] = {**(about or {}), "demand": demand, "seed": sea.seed}
        if not finite.all():
            length, meta["diverged"] = int(np.argmin(finite)), True
        elif manoeuvre.goal is not None and not reached:
            meta["timed_out"] = True
        if length < 2:
            raise DataError(
                f"{craft.name}, {name}: the motion is not finite from its first step on"
            )
        flown = dict(zip(craft.helm.state, states[i, :length].T, strict=True))
        flown |= dict(zip(craft.helm.inputs, inputs[i, :length].T, strict=True))
        clean = {n: flown[n].numpy().copy() for n in logged_channels(craft, sea)}
        time = t[:length].numpy().copy()
        measured = sea.noise.measured(clean, time, noise[i, :length], (sea.seed, 6, i))
        units = {channel: CHANNEL_UNITS.get(channel, "-") for channel in clean}
        motion = Log(name, time, clean, units, manoeuvre.kind, meta=meta)
        flights.append(Flight(manoeuvre, motion, motion.replace(channels=measured)))
    return flights


def logged_channels(craft: Craft, sea: Sea) -> tuple[str, ...]:
    """Return the names of the channels of a flight's log: states, commands, what is measured."""
    names = [
        *(name for name in craft.helm.state if not name.startswith("_")),
        *craft.helm.inputs[: craft.commands],
        *sea.disturbance.logged,
    ]
    return tuple(dict.fromkeys(names))


def log_names(manoeuvres: Sequence[Manoeuvre]) -> list[str]:
    """Return the names of the logs: as given, else the kind with its number."""
    count: dict[str, int] = {}
    out = []
    for manoeuvre in manoeuvres:
        count[manoeuvre.kind] = count.get(manoeuvre.kind, 0) + 1
        out.append(manoeuvre.name or f"{manoeuvre.kind}_{count[manoeuvre.kind]:02d}")
    return out


class SimulatedTrials(Config):
    """A programme of sea trials on a simulated vessel, from rest.

    A model that only holds near its service speed starts there.

    Attributes:
        vessel: name of a vessel of residnet, or path of a vessel file.
        trials: families of manoeuvres; what is random in them is drawn by `seed`.
        duration: of each manoeuvre.
        step: sampling interval of the logs.
        substeps: steps of the plant within one sampling interval.
        identification: number of manoeuvres of each kind that models may be fitted on, drawn by
            `seed`; kinds that are not named are for identification altogether. The rest is the test
            set.
        validation: how many of those are kept back to choose between models.
        seed: of everything random in the data (the run's own seed moves only the training).
        noise: of the sensors.
        disturbance: of the sea.
    """

    kind: Literal["simulated"] = "simulated"
    vessel: VesselName
    trials: tuple[FamilyConfig, ...] = Field(min_length=1)
    duration: Seconds = Field(default=60.0, gt=0)
    step: Seconds = Field(default=0.05, gt=0)
    substeps: int = Field(default=5, ge=1, le=1_000)
    noise: SensorNoise = SensorNoise()
    disturbance: Disturbance = Disturbance()
    identification: dict[str, int]
    validation: dict[str, int]
    seed: int = Field(default=0, ge=0)

    @model_validator(mode="after")
    def _check_plant(self) -> SimulatedTrials:
        try:
            plant = load_vessel(self.vessel).build()
            # actuators with dead time move by a step of their own
            plant.end_step(
                plant.approach(1),
                torch.zeros(1, len(plant.inputs), dtype=torch.float64),
                self.step / self.substeps,
            )
            self.disturbance.check(plant, self.vessel)
            self.noise.check(
                (*plant.state, *plant.inputs[: plant.commands], *self.disturbance.logged),
                self.step,
                self.vessel,
            )
        except ConfigError as error:
            raise ValueError(str(error)) from None
        for manoeuvre in self.draw():
            check_steps(manoeuvre.duration or self.duration, self.step)
        return self

    def draw(self) -> list[Manoeuvre]:
        """Return the manoeuvres, by family."""
        random = np.random.default_rng([self.seed, 1])
        return [
            manoeuvre for family in self.trials for manoeuvre in family.draw(random, self.duration)
        ]

    def splits(self, manoeuvres: Sequence[Manoeuvre]) -> list[str]:
        """Return `train`, `validation` or `test` of each manoeuvre; whole manoeuvres only.

        Raises:
            ValueError: where a split asks for more manoeuvres than there are.
        """
        random = np.random.default_rng([self.seed, 2])
        out = ["train"] * len(manoeuvres)
        for kind, count in self.identification.items():
            members = [i for i, manoeuvre in enumerate(manoeuvres) if manoeuvre.kind == kind]
            held_back = self.validation.get(kind, 0)
            if not 0 < count < len(members) or not 0 <= held_back < count:
                raise ValueError(
                    f"{count} of {len(members)} '{kind}' manoeuvres for identification, {held_back}"
                    " of them for validation: leaves a split empty"
                )
            order = random.permutation(members)
            for i in order[:held_back]:
                out[i] = "validation"
            for i in order[count:]:
                out[i] = "test"
        return out


def fly_trials(manoeuvres: Sequence[Manoeuvre], config: SimulatedTrials) -> list[Flight]:
    """Fly the manoeuvres in one batch and return the motion and the logs of sensors on it.

    Channels: the plant's state (for the WAM-V x, y, psi, u, v, r, n_port, n_stbd), the commands,
    and the true wind where there is any. Float64.
    """
    plant = surrounded(config.vessel, config.disturbance)
    traced = RecordedPlantDynamics(plant, config.step, config.substeps)
    craft = replace(trials_craft(config), dynamics=traced)
    sea = Sea(plant, config.disturbance, config.noise, config.seed)
    return fly(craft, manoeuvres, sea, config.duration, config.step, {"vessel": config.vessel})


def stand_ins(config: SimulatedTrials) -> list[Log]:
    """Return logs with the names, channels, lengths and kinds of those of `simulate`, unflown.

    Their channels are slow sines: they tell what a run can be made of, before anything is flown.

    Raises:
        UsageError: where the vessel lacks what a manoeuvre needs.
    """
    plant = load_vessel(config.vessel).build()
    craft, sea = trials_craft(config), Sea(plant, config.disturbance, config.noise, config.seed)
    manoeuvres = config.draw()
    source_of(manoeuvres, craft.helm, torch.arange(2, dtype=torch.float64) * config.step)
    out = []
    for manoeuvre, name in zip(manoeuvres, log_names(manoeuvres), strict=True):
        manoeuvre.begin(craft.start[0], craft.helm.state)
        t = np.arange(max(round(manoeuvre.lasts(config.duration) / config.step), 2)) * config.step
        channels = {
            channel: 1.0 + np.sin(0.1 * t + place)
            for place, channel in enumerate(logged_channels(craft, sea))
        }
        units = {channel: CHANNEL_UNITS.get(channel, "-") for channel in channels}
        out.append(Log(name, t, channels, units, manoeuvre.kind))
    return out


def surrounded(vessel: str, disturbance: Disturbance) -> Plant:
    """Return the plant of a vessel, in calm water where nothing disturbs it.

    The numbers are the same there: a vessel under water is flown in half the time.
    """
    plant = load_vessel(vessel).build()
    if isinstance(plant, HullPlant) and not disturbance.needs():
        return plant.in_calm_water()
    return plant


def trials_craft(config: SimulatedTrials) -> Craft:
    """Return the vessel of the trials."""
    plant = surrounded(config.vessel, config.disturbance)
    return Craft(
        config.vessel,
        PlantDynamics(plant, config.step, config.substeps),
        Helm.from_plant(plant),
        plant.commands,
        plant.approach(1),
    )


def simulate(manoeuvres: Sequence[Manoeuvre], config: SimulatedTrials) -> list[Log]:
    """Return the logs of `fly_trials`."""
    return [flight.log for flight in fly_trials(manoeuvres, config)]

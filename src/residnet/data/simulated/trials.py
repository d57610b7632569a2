"""Simulated sea trials: plant, manoeuvres, disturbances and sensors, all in one batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import torch
from pydantic import Field, model_validator

from residnet.core.config import Config, Seconds
from residnet.core.errors import ConfigError
from residnet.core.log import Log
from residnet.core.names import CHANNEL_UNITS
from residnet.data.simulated.environment import Disturbance
from residnet.data.simulated.flying import (
    Craft,
    Flight,
    Sea,
    fly,
    log_names,
    logged_channels,
    source_of,
)
from residnet.data.simulated.sensors import SensorNoise
from residnet.dynamics.simulated import PlantDynamics, TracedPlantDynamics, check_steps
from residnet.manoeuvres import FamilyConfig
from residnet.manoeuvres.base import Helm, Manoeuvre
from residnet.physics.vessel import VesselName, load_vessel


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
    plant = load_vessel(config.vessel).build()
    traced = TracedPlantDynamics(plant, config.step, config.substeps)
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


def trials_craft(config: SimulatedTrials) -> Craft:
    """Return the vessel of the trials."""
    plant = load_vessel(config.vessel).build()
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

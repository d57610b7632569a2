"""Simulated sea trials: a plant, a programme of manoeuvres, disturbances and sensors, all in one batch."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import Literal

import numpy as np
import torch
from pydantic import Field, field_validator, model_validator

from residnet.core.config import Config, Seconds
from residnet.core.errors import ConfigError
from residnet.core.log import Log
from residnet.core.names import CHANNEL_UNITS
from residnet.data.environment import Disturbance
from residnet.data.sensors import SensorNoise
from residnet.dynamics.rollout import Rollout, Source
from residnet.dynamics.simulated import PlantDynamics
from residnet.manoeuvres import FamilyConfig, Helm, Manoeuvre, StackedSource
from residnet.physics.vessel import load_vessel


class SimulatedTrials(Config):
    """A programme of sea trials on a simulated vessel, from rest (a model that only holds near its service speed starts there).

    Attributes:
        vessel: name of a vessel of residnet, or path of a vessel file.
        trials: families of manoeuvres; what is random in them is drawn by `seed`.
        duration: of each manoeuvre.
        step: sampling interval of the logs.
        substeps: steps of the plant within one sampling interval.
        identification: number of manoeuvres of each kind that models may be fitted on, drawn by `seed`; kinds that are not named
            are for identification altogether. The rest is the test set.
        validation: how many of those are kept back to choose between models.
        seed: of everything random in the data (the run's own seed moves only the training).
    """

    kind: Literal["simulated"] = "simulated"
    vessel: str
    trials: tuple[FamilyConfig, ...] = Field(min_length=1)
    duration: Seconds = Field(default=60.0, gt=0)
    step: Seconds = Field(default=0.05, gt=0)
    substeps: int = Field(default=5, ge=1)
    noise: SensorNoise = SensorNoise()
    disturbance: Disturbance = Disturbance()
    identification: dict[str, int]
    validation: dict[str, int]
    seed: int = Field(default=0, ge=0)

    @field_validator("vessel")
    @classmethod
    def _vessel(cls, vessel: str) -> str:
        try:
            load_vessel(vessel)
        except ConfigError as error:
            raise ValueError(str(error)) from None
        return vessel

    @model_validator(mode="after")
    def _felt(self) -> SimulatedTrials:
        try:
            plant = load_vessel(self.vessel).build()
            # actuators with dead time move by a step of their own
            plant.settle(plant.approach(1), torch.zeros(1, len(plant.inputs), dtype=torch.float64), self.step / self.substeps)
            self.disturbance.check(plant, self.vessel)
            self.noise.check((*plant.state, *plant.inputs[: plant.commands], *self.disturbance.logged), self.step, self.vessel)
        except ConfigError as error:
            raise ValueError(str(error)) from None
        return self

    def draw(self) -> list[Manoeuvre]:
        """The manoeuvres, by family."""
        random = np.random.default_rng([self.seed, 1])
        return [manoeuvre for family in self.trials for manoeuvre in family.draw(random, self.duration)]

    def splits(self, manoeuvres: Sequence[Manoeuvre]) -> list[str]:
        """`train`, `validation` or `test` of each manoeuvre; whole manoeuvres only.

        Raises:
            ValueError: where a split asks for more manoeuvres than there are.
        """
        random = np.random.default_rng([self.seed, 2])
        out = ["train"] * len(manoeuvres)
        for kind, count in self.identification.items():
            members = [i for i, manoeuvre in enumerate(manoeuvres) if manoeuvre.kind == kind]
            kept = self.validation.get(kind, 0)
            if not 0 < count < len(members) or not 0 <= kept < count:
                raise ValueError(
                    f"{count} of {len(members)} '{kind}' manoeuvres for identification, {kept} of them for validation: leaves a split empty"
                )
            order = random.permutation(members)
            for i in order[:kept]:
                out[i] = "validation"
            for i in order[count:]:
                out[i] = "test"
        return out


def simulate(manoeuvres: Sequence[Manoeuvre], config: SimulatedTrials) -> list[Log]:
    """Fly the manoeuvres in one batch and log them as sensors would.

    Channels: the plant's state (for the WAM-V x, y, psi, u, v, r, n_port, n_stbd) as its sensors measure it, the commands, and the
    true wind where there is any. Float64.
    """
    plant = load_vessel(config.vessel).build()
    steps = round(config.duration / config.step)
    t = torch.arange(steps, dtype=torch.float64) * config.step
    runs = [list(members) for _, members in groupby(manoeuvres, key=lambda m: m.kind)]
    sources = [type(members[0]).source(members, Helm.of(plant), t) for members in runs]
    source: Source = StackedSource(sources, [len(members) for members in runs])
    random = np.random.default_rng([config.seed, 3])
    w = torch.from_numpy(config.disturbance.series(plant, len(manoeuvres), steps, config.step, config.seed, random))
    source = config.disturbance.surround(source, plant, len(manoeuvres), config.step, config.seed)
    start = plant.approach(len(manoeuvres))
    with torch.no_grad():
        states, inputs, _ = Rollout(PlantDynamics(plant, config.step, config.substeps), source)(start, w, start[:, :0])
    x, acting = states[:, :-1].numpy(), inputs.numpy()
    noise = random.standard_normal((len(manoeuvres), steps, 3)) * [config.noise.u, config.noise.v, config.noise.r]
    time = t.numpy()
    logs = []
    count: dict[str, int] = {}
    for i, manoeuvre in enumerate(manoeuvres):
        count[manoeuvre.kind] = count.get(manoeuvre.kind, 0) + 1
        clean = {name: x[i, :, j] for j, name in enumerate(plant.state) if not name.startswith("_")}
        known = (*plant.inputs[: plant.commands], *config.disturbance.logged)
        clean |= {name: acting[i, :, plant.inputs.index(name)] for name in known}
        channels = config.noise.measured(clean, time, noise[i], (config.seed, 6, i))
        logs.append(
            Log(
                name=f"{manoeuvre.kind}_{count[manoeuvre.kind]:02d}",
                t=time.copy(),
                channels=channels,
                units={name: CHANNEL_UNITS.get(name, "-") for name in channels},
                manoeuvre=manoeuvre.kind,
                meta={"vessel": config.vessel, "demand": manoeuvre.model_dump(mode="json"), "seed": config.seed},
            )
        )
    return logs

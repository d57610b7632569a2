"""Manoeuvres of the task `simulate`, flown by a vessel, a learned model, or both."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np
from pydantic import Field, field_validator, model_validator
from torch import Tensor

from residnet.core.config import Config, ExistingPath, Metres, Quantity, Seconds
from residnet.core.errors import ConfigError, UsageError
from residnet.core.names import CHANNEL_UNITS, nearest
from residnet.data.readers import ReaderConfig
from residnet.data.readers.canonical import CanonicalConfig
from residnet.data.simulated.environment import Disturbance
from residnet.data.simulated.flying import Craft, Flight, Sea, fly, log_names, source_of
from residnet.data.simulated.sensors import SensorNoise
from residnet.dynamics.actuated import ActuatedDynamics, GivenActuators, InputShare, PlantActuators
from residnet.dynamics.simulated import TracedPlantDynamics, check_steps
from residnet.dynamics.store import chosen_model, load_model
from residnet.manoeuvres import FamilyConfig, ManoeuvreConfig
from residnet.manoeuvres.base import Helm, Manoeuvre
from residnet.manoeuvres.replay import Replay
from residnet.physics.vessel import load_vessel

STEP = 0.05


class ModelChoice(Config):
    """A learned model of a finished run, with actuators in front.

    Attributes:
        run: folder of the run.
        name: of the model; `selected` is the one chosen on validation data.
        actuators: vessel (name or file) whose actuators turn commands into the model's inputs; the
            programme's vessel where absent.
        inputs: instead of a vessel's actuators, each input of the model by its share in drive and
            steer, with limits and rates.
    """

    run: ExistingPath
    name: str = "selected"
    actuators: str | None = None
    inputs: dict[str, InputShare] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _one(self) -> ModelChoice:
        if self.actuators is not None and self.inputs:
            raise ValueError("give actuators (a vessel) or inputs, not both")
        return self

    @property
    def chosen(self) -> str:
        """Return the name of the model in its run.

        Raises:
            UsageError: where the folder holds no such model.
        """
        return chosen_model(self.run, self.name)


class Programme(Config):
    """Manoeuvres and what flies them.

    Attributes:
        vessel: name or file of a vessel that flies them.
        model: a learned model that flies them instead, or besides.
        manoeuvres: in their order.
        families: further ones drawn at random by `seed`.
        duration: of manoeuvres that give none; for one with a stop condition the time after which
            it has failed.
        step: of the logs; that of the model where there is one, else 0.05 s.
        substeps: steps of the vessel within one step of the logs.
        initial: states (by name) that trials start from, where not as the vessel's kind does.
        length: of the hull for indices in lengths; that of the vessel where absent.
        reader: of logs that are replayed.
        noise: of the sensors; indices are taken from the motion itself.
        disturbance: a learned model feels only the wind, if it was fitted with it.
        seed: of everything random.
    """

    vessel: str | None = None
    model: ModelChoice | None = None
    manoeuvres: tuple[ManoeuvreConfig, ...] = ()
    families: tuple[FamilyConfig, ...] = ()
    duration: Seconds = Field(default=600.0, gt=0)
    step: Seconds | None = Field(default=None, gt=0)
    substeps: int = Field(default=5, ge=1, le=1_000)
    initial: dict[str, float | str] = Field(default_factory=dict)
    length: Metres | None = Field(default=None, gt=0)
    reader: ReaderConfig = CanonicalConfig()
    noise: SensorNoise = SensorNoise()
    disturbance: Disturbance = Disturbance()
    seed: int = Field(default=0, ge=0)

    @field_validator("initial")
    @classmethod
    def _units(cls, initial: dict[str, float | str]) -> dict[str, float | str]:
        return {
            name: Quantity(CHANNEL_UNITS.get(name, "-")).convert(value)
            for name, value in initial.items()
        }

    @model_validator(mode="after")
    def _complete(self) -> Programme:
        if self.vessel is None and self.model is None:
            raise ValueError("nothing flies: give vessel, model or both")
        if not self.manoeuvres and not self.families:
            raise ValueError("nothing is flown: give manoeuvres, families or both")
        drawn = self.draw()
        for manoeuvre in drawn:
            check_steps(manoeuvre.duration or self.duration, self.step or STEP)
        names = log_names(drawn)
        if repeated := [name for name in names if names.count(name) > 1]:
            raise ValueError(f"two manoeuvres are named '{repeated[0]}'")
        try:
            if self.vessel is not None and self.model is None:
                self._vessel_craft(self.step or STEP)
        except UsageError as error:
            raise ValueError(str(error)) from None
        return self

    def draw(self) -> list[Manoeuvre]:
        """Return the manoeuvres: those given, then those drawn."""
        random = np.random.default_rng([self.seed, 1])
        return [
            *self.manoeuvres,
            *(
                manoeuvre
                for family in self.families
                for manoeuvre in family.draw(random, self.duration)
            ),
        ]

    @cached_property
    def flown(self) -> list[Manoeuvre]:
        """Return the manoeuvres, with the logs of replays read.

        Raises:
            ResidnetError: where a log cannot be read.
        """
        manoeuvres = self.draw()
        reader = self.reader.build()
        for manoeuvre in manoeuvres:
            if isinstance(manoeuvre, Replay):
                manoeuvre.take(reader.read(manoeuvre.log))
        return manoeuvres

    @property
    def hull_length(self) -> float | None:
        """Return the length of the hull in m; None where it is not known."""
        vessel = self.vessel or (self.model.actuators if self.model is not None else None)
        return (
            self.length
            if self.length is not None or vessel is None
            else load_vessel(vessel).length.value
        )

    def crafts(self) -> list[tuple[Craft, Sea]]:
        """Return what flies, each with what surrounds it: the vessel, then the model.

        Raises:
            UsageError: where one of them cannot fly the manoeuvres.
        """
        model = None if self.model is None else self._model_craft(self.model)
        step = self.step or (STEP if model is None else model[0].dynamics.dt)
        out = [] if self.vessel is None else [self._vessel_craft(step)]
        return out if model is None else [*out, model]

    def fly(self, craft: Craft, sea: Sea) -> list[Flight]:
        """Fly all manoeuvres in one batch."""
        step = self.step or (craft.dynamics.dt if self.model is not None else STEP)
        return fly(
            craft,
            self.flown,
            sea,
            self.duration,
            step,
            {"vessel": self.vessel, "craft": craft.name},
        )

    def check(self) -> None:
        """Build everything that flies, and the source of every manoeuvre.

        Raises:
            ResidnetError: where that is not possible.
        """
        import torch

        for craft, _ in self.crafts():
            source_of(
                self.flown, craft.helm, torch.arange(2, dtype=torch.float64) * (self.step or STEP)
            )
            for manoeuvre in self.flown:
                manoeuvre.begin(craft.start[0], craft.helm.state)

    def _vessel_craft(self, step: float) -> tuple[Craft, Sea]:
        assert self.vessel is not None
        import torch

        plant = load_vessel(self.vessel).build()
        # actuators with dead time move by a step of their own
        plant.end_step(
            plant.approach(1),
            torch.zeros(1, len(plant.inputs), dtype=torch.float64),
            step / self.substeps,
        )
        self.disturbance.check(plant, self.vessel)
        self.noise.check(
            (*plant.state, *plant.inputs[: plant.commands], *self.disturbance.logged),
            step,
            self.vessel,
        )
        start = self._started(plant.approach(1), plant.state, self.vessel)
        craft = Craft(
            plant_name(self.vessel),
            TracedPlantDynamics(plant, step, self.substeps),
            Helm.from_plant(plant),
            plant.commands,
            start,
        )
        return craft, Sea(plant, self.disturbance, self.noise, self.seed)

    def _model_craft(self, choice: ModelChoice) -> tuple[Craft, Sea]:
        name = choice.chosen
        spec, model = load_model(choice.run / "models" / name)
        step = spec.dt
        if self.step is not None and abs(self.step - step) > 1e-9:
            raise ConfigError(
                f"programme.step ({self.step:g} s) must be that of model '{name}' ({step:g} s);"
                " leave it out"
            )
        vessel = choice.actuators or self.vessel
        # waves and forces do not reach a learned model
        calm = self.disturbance.model_copy(update={"waves": None})
        gear: GivenActuators | PlantActuators
        forces: Callable[[Tensor], Tensor] | None = None
        if choice.inputs:
            gear, sea = (
                GivenActuators(choice.inputs, spec.signals.exogenous, step),
                Sea(None, calm, self.noise, self.seed),
            )
        elif vessel is not None:
            plant = load_vessel(vessel).build()
            gear, sea = (
                PlantActuators(plant, step, self.substeps),
                Sea(plant, calm, self.noise, self.seed),
            )
            forces = Helm.from_plant(plant).forces
        else:
            raise ConfigError(
                "a model flies with actuators: name a vessel's in programme.model.actuators, or"
                " give programme.model.inputs"
            )
        actuated = ActuatedDynamics(model.double(), spec.signals.columns, spec.hold, gear)
        self.noise.check(
            (*actuated.state, *gear.inputs[: gear.commands], *self.disturbance.logged), step, name
        )
        if missing := [wanted for wanted in self.disturbance.logged if wanted not in gear.inputs]:
            raise ConfigError(
                f"disturbance.wind: model '{name}' and its actuators have no input '{missing[0]}'"
            )
        helm = Helm(gear.demand, actuated.state, gear.inputs, forces)
        return (
            Craft(
                name,
                actuated,
                helm,
                gear.commands,
                self._started(gear.approach(1), actuated.state, name),
            ),
            sea,
        )

    def _started(self, x: Tensor, state: tuple[str, ...], who: str) -> Tensor:
        for name, value in self.initial.items():
            if name not in state:
                raise ConfigError(f"initial: '{who}' has no state '{name}'{nearest(name, state)}")
            x[:, state.index(name)] = float(value)
        return x


def plant_name(vessel: str) -> str:
    """Return the name of a vessel in tables: that in its file."""
    return load_vessel(vessel).name

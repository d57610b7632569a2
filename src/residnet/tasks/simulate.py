"""Task `simulate`: sea trials as canonical logs, with manoeuvring indices and figures."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
import torch
from pydantic import Field, field_validator, model_validator
from torch import Tensor

from residnet.core.config import Config, ExistingPath, Metres, Quantity, Seconds
from residnet.core.errors import ConfigError, UsageError
from residnet.core.files import file_stem
from residnet.core.names import CHANNEL_UNITS, nearest
from residnet.core.progress import say
from residnet.data.readers import ReaderConfig
from residnet.data.readers.base import CanonicalConfig
from residnet.data.simulated import (
    Craft,
    Disturbance,
    Flight,
    Sea,
    SensorNoise,
    SimulatedTrials,
    fly,
    fly_trials,
    log_names,
    source_of,
    stand_ins,
    surrounded,
    trials_craft,
)
from residnet.dynamics.actuated import ActuatedDynamics, GivenActuators, InputShare, PlantActuators
from residnet.dynamics.simulated import RecordedPlantDynamics, check_steps
from residnet.dynamics.store import chosen_model, load_model
from residnet.judge.booklet import index_contents, index_rows
from residnet.manoeuvres import FamilyConfig, ManoeuvreConfig
from residnet.manoeuvres.base import Helm, Manoeuvre
from residnet.manoeuvres.open_loop import Replay
from residnet.physics.vessel import load_vessel
from residnet.report.figure_files import write_figures
from residnet.report.sections.manoeuvres import flight_figures, indices_text
from residnet.runs.folder import RunFolder
from residnet.runs.task import ComputingTask, MainFigure, Outcome

_SHOWN = 24
"""Manoeuvres whose indices are shown on the terminal; more stand in a file."""
STEP = 0.05
"""Step in s between the samples of a simulation, where none is given."""


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
    def folder(self) -> Path:
        """The folder of the model in its run.

        Raises:
            UsageError: where the run holds no such model.
        """
        return self.run / "models" / chosen_model(self.run, self.name)


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
                self._vessel_craft(self.vessel, self.step or STEP)
        except UsageError as error:
            raise ValueError(str(error)) from None
        return self

    def draw(self) -> list[Manoeuvre]:
        """Return the manoeuvres: those given, then those drawn."""
        random = np.random.default_rng([self.seed, 1])
        drawn = [family.draw(random, self.duration) for family in self.families]
        return [*self.manoeuvres, *(manoeuvre for some in drawn for manoeuvre in some)]

    @cached_property
    def flown(self) -> list[Manoeuvre]:
        """The manoeuvres, with the logs of replays read.

        Raises:
            ResidnetError: where a log cannot be read.
        """
        manoeuvres, reader = self.draw(), self.reader.build()
        for manoeuvre in manoeuvres:
            if isinstance(manoeuvre, Replay):
                manoeuvre.take(reader.read(manoeuvre.log))
        return manoeuvres

    @property
    def hull_length(self) -> float | None:
        """The length of the hull in m; None where it is not known."""
        vessel = self.vessel or (self.model.actuators if self.model is not None else None)
        known = self.length is not None or vessel is None
        return self.length if known else load_vessel(str(vessel)).length.value

    def crafts(self) -> list[tuple[Craft, Sea]]:
        """Return what flies, each with what surrounds it: the vessel, then the model.

        Raises:
            UsageError: where one of them cannot fly the manoeuvres.
        """
        model = None if self.model is None else self._model_craft(self.model)
        step = self.step or (STEP if model is None else model[0].dynamics.dt)
        out = [] if self.vessel is None else [self._vessel_craft(self.vessel, step)]
        return out if model is None else [*out, model]

    def fly(self, craft: Craft, sea: Sea) -> list[Flight]:
        """Fly all manoeuvres in one batch."""
        step = self.step or (craft.dynamics.dt if self.model is not None else STEP)
        meta = {"vessel": self.vessel, "craft": craft.name}
        return fly(craft, self.flown, sea, self.duration, step, meta)

    def check(self) -> None:
        """Build everything that flies, and the source of every manoeuvre.

        Raises:
            ResidnetError: where that is not possible.
        """
        times = torch.arange(2, dtype=torch.float64) * (self.step or STEP)
        for craft, _ in self.crafts():
            source_of(self.flown, craft.helm, times)
            for manoeuvre in self.flown:
                manoeuvre.begin(craft.start[0], craft.helm.state)

    def _vessel_craft(self, vessel: str, step: float) -> tuple[Craft, Sea]:
        plant = surrounded(vessel, self.disturbance)
        # actuators with dead time move by a step of their own
        inputs = torch.zeros(1, len(plant.inputs), dtype=torch.float64)
        plant.end_step(plant.approach(1), inputs, step / self.substeps)
        self.disturbance.check(plant, vessel)
        logged = (*plant.state, *plant.inputs[: plant.commands], *self.disturbance.logged)
        self.noise.check(logged, step, vessel)
        craft = Craft(
            load_vessel(vessel).name,
            RecordedPlantDynamics(plant, step, self.substeps),
            Helm.from_plant(plant),
            plant.commands,
            self._started(plant.approach(1), plant.state, vessel),
        )
        return craft, Sea(plant, self.disturbance, self.noise, self.seed)

    def _model_craft(self, choice: ModelChoice) -> tuple[Craft, Sea]:
        name, (spec, model) = choice.folder.name, load_model(choice.folder)
        step = spec.dt
        if self.step is not None and abs(self.step - step) > 1e-9:
            raise ConfigError(
                f"programme.step ({self.step:g} s) must be that of model '{name}' ({step:g} s);"
                " leave it out"
            )
        vessel, plant = choice.actuators or self.vessel, None
        gear: GivenActuators | PlantActuators
        forces: Callable[[Tensor], Tensor] | None = None
        if choice.inputs:
            gear = GivenActuators(choice.inputs, spec.signals.exogenous, step)
        elif vessel is not None:
            plant = load_vessel(vessel).build()
            gear, forces = PlantActuators(plant, step, self.substeps), Helm.from_plant(plant).forces
        else:
            raise ConfigError(
                "a model flies with actuators: name a vessel's in programme.model.actuators, or"
                " give programme.model.inputs"
            )
        # waves and forces do not reach a learned model
        calm = self.disturbance.model_copy(update={"waves": None})
        actuated = ActuatedDynamics(model.double(), spec.signals.columns, spec.hold, gear)
        logged = (*actuated.state, *gear.inputs[: gear.commands], *self.disturbance.logged)
        self.noise.check(logged, step, name)
        if missing := [wanted for wanted in self.disturbance.logged if wanted not in gear.inputs]:
            raise ConfigError(
                f"disturbance.wind: model '{name}' and its actuators have no input '{missing[0]}'"
            )
        helm = Helm(gear.demand, actuated.state, gear.inputs, forces)
        start = self._started(actuated.approach(1), actuated.state, name)
        sea = Sea(plant, calm, self.noise, self.seed)
        return Craft(name, actuated, helm, gear.commands, start), sea

    def _started(self, x: Tensor, state: tuple[str, ...], who: str) -> Tensor:
        for name, value in self.initial.items():
            if name not in state:
                raise ConfigError(f"initial: '{who}' has no state '{name}'{nearest(name, state)}")
            x[:, state.index(name)] = float(value)
        return x


class SimulateConfig(ComputingTask):
    """Simulated trials with their indices and figures; give `programme` or `data`.

    Attributes:
        programme: a list of manoeuvres on a vessel, a learned model, or both: logs/<log>.parquet,
            those of a model beside a vessel in model_logs.
        data: trials as the task `fit` draws and splits them: logs/<split>/<log>.parquet.
    """

    page: ClassVar[str] = "manoeuvres"

    task: Literal["simulate"]
    programme: Programme | None = None
    data: SimulatedTrials | None = None

    @model_validator(mode="after")
    def _one(self) -> SimulateConfig:
        if (self.programme is None) == (self.data is None):
            raise ValueError(
                "give programme (manoeuvres on a vessel or a model) or data (trials with splits),"
                " one of the two"
            )
        if self.data is not None:
            self.data.splits(self.data.draw())
        return self

    def check(self) -> None:
        """Check that models and logs are there and fit the manoeuvres.

        Raises:
            ResidnetError: where they do not.
        """
        if self.programme is not None:
            self.programme.check()
        if self.data is not None:
            stand_ins(self.data)

    def input_files(self) -> list[Path]:
        """Return the logs that are replayed, and the files of the learned model."""
        if self.programme is None:
            return []
        files = [m.log for m in self.programme.manoeuvres if isinstance(m, Replay)]
        model = self.programme.model
        return files if model is None else [*files, *sorted(model.folder.glob("model.*"))]

    def recorded_seed(self) -> int:
        """Return the seed of everything random in the trials."""
        given = self.programme or self.data
        assert given is not None
        return given.seed

    def carry_out(self, folder: RunFolder) -> Outcome:
        """Fly the manoeuvres, and write logs, indices and figures.

        Flights that were drawn at random may end otherwise than they should; only those that the
        config lists are a failure.

        Raises:
            UsageError: where something cannot fly the manoeuvres.
        """
        if self.programme is not None:
            flown = [
                (craft, self.programme.fly(craft, sea)) for craft, sea in self.programme.crafts()
            ]
            length, listed = self.programme.hull_length, len(self.programme.manoeuvres)
            crafts = zip(("logs", "model_logs"), flown, strict=False)
            places = [(place, flight) for place, (_, flights) in crafts for flight in flights]
        else:
            assert self.data is not None
            manoeuvres = self.data.draw()
            flown = [(trials_craft(self.data), fly_trials(manoeuvres, self.data))]
            length, listed = load_vessel(self.data.vessel).length.value, 0
            drawn = zip(self.data.splits(manoeuvres), flown[0][1], strict=True)
            places = [(f"logs/{split}", flight) for split, flight in drawn]
        for place, flight in places:
            flight.log.save(folder.path / place / f"{file_stem(flight.log.name)}.parquet")
        rows = [row for craft, flights in flown for row in index_rows(craft, flights, length)]
        content = index_contents(self.name, length, rows)
        folder.write_json(folder.path / "indices.json", content)
        figures = flight_figures({craft.name: flights for craft, flights in flown})
        write_figures(folder.figures, figures)
        count, faults = len(places), [row for row in rows if row["fault"]]
        ended = (
            f"{len(faults)} of {count} manoeuvres did NOT end as they should"
            if faults
            else f"All {count} manoeuvres ended as they should"
        )
        verdict = [
            f"{ended}; they were flown by {' and '.join(craft.name for craft, _ in flown)}, and"
            " their logs are in the folder logs."
        ]
        verdict += [f"{row['craft']}, {row['log']}: {row['fault']}." for row in faults[:5]]
        told = [
            (f"{craft.name}, {flight.log.name}: {flight.fault}", number < listed)
            for craft, flights in flown
            for number, flight in enumerate(flights)
            if flight.fault
        ]
        for line, _ in told:
            say(line)
        failures = [line for line, of_config in told if of_config]
        failure = failures and (
            f"{failures[-1]} ({len(failures)} of {count} flights did not end as they should; give"
            " more duration, drive or steer)"
        )
        return Outcome(
            verdict,
            {"logs": MainFigure(count), "flights_with_a_fault": MainFigure(len(faults))},
            indices_text(content) if len(rows) <= _SHOWN else "",
            failure or "",
        )

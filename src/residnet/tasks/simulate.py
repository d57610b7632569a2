"""Task `simulate`: simulated sea trials as canonical logs, with manoeuvring indices."""

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
from residnet.core.files import make_file_stem
from residnet.core.names import CHANNEL_UNITS, suggest_name
from residnet.core.progress import log_message
from residnet.dynamics.simulated import check_steps
from residnet.dynamics.store import load_model, resolve_model_name
from residnet.engine.recorded_plant import RecordedPlantDynamics
from residnet.evaluation.booklet import build_index_rows, build_index_table
from residnet.io.readers import ReaderConfig
from residnet.io.readers.base import CanonicalConfig
from residnet.manoeuvres import FamilyConfig, ManoeuvreConfig
from residnet.manoeuvres.actuated import (
    ActuatedDynamics,
    GivenActuators,
    InputShare,
    PlantActuators,
)
from residnet.manoeuvres.base import Helm, Manoeuvre
from residnet.manoeuvres.open_loop import Replay
from residnet.manoeuvres.trials import (
    DisturbanceConfig,
    ManoeuvreRun,
    SensorsConfig,
    SimulatedTrials,
    SimulatedVessel,
    TrialEnvironment,
    build_plant,
    build_trial_vessel,
    make_dummy_logs,
    make_log_names,
    make_manoeuvre_source,
    simulate_manoeuvres,
    simulate_trials,
)
from residnet.physics.vessel import load_vessel
from residnet.report.figure_files import write_figures
from residnet.report.sections.manoeuvres import indices_text, trial_figures
from residnet.runs.folder import RunFolder
from residnet.runs.task import ComputingTask, SummaryMetric, TaskOutcome

_MAX_SHOWN_ROWS = 24
"""Maximum number of manoeuvres whose indices are shown on the terminal."""
DEFAULT_TIME_STEP = 0.05
"""Default time step of a simulation in s."""


class ModelChoice(Config):
    """A learned model of a finished run, driven through actuators.

    Attributes:
        run: folder of the run.
        name: name of the model; `selected` is the model chosen on validation data.
        actuators: vessel (name or file) whose actuators convert commands to the inputs of the
            model; null for the vessel of the programme.
        inputs: instead of the actuators of a vessel: drive and steer shares, limits and rates of
            each input of the model.
    """

    run: ExistingPath
    name: str = "selected"
    actuators: str | None = None
    inputs: dict[str, InputShare] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _require_one_actuator_source(self) -> ModelChoice:
        if self.actuators is not None and self.inputs:
            raise ValueError("give actuators (a vessel) or inputs, not both")
        return self

    @property
    def model_folder(self) -> Path:
        """The folder of the model in its run.

        Raises:
            UsageError: if the run has no such model.
        """
        return self.run / "models" / resolve_model_name(self.run, self.name)


class Programme(Config):
    """A list of manoeuvres with the vessel or model that performs them.

    Attributes:
        vessel: name or file of a vessel.
        model: a learned model, instead of the vessel or in addition to it.
        manoeuvres: manoeuvres in their order.
        families: families from which further manoeuvres are drawn at random by `seed`.
        duration: duration of manoeuvres without their own; for a manoeuvre with a stop condition
            the time after which it has failed.
        step: time step of the logs; null for the step of the model, or 0.05 s without a model.
        substeps: number of simulation steps of the vessel within one step of the logs.
        initial: initial states by name; others have the default of the vessel.
        length: of the hull for indices in lengths; that of the vessel if absent.
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
    noise: SensorsConfig = SensorsConfig()
    disturbance: DisturbanceConfig = DisturbanceConfig()
    seed: int = Field(default=0, ge=0)

    @field_validator("initial")
    @classmethod
    def _convert_units(cls, initial: dict[str, float | str]) -> dict[str, float | str]:
        return {
            name: Quantity(CHANNEL_UNITS.get(name, "-")).convert(value)
            for name, value in initial.items()
        }

    @model_validator(mode="after")
    def _validate_manoeuvres(self) -> Programme:
        if self.vessel is None and self.model is None:
            raise ValueError("no vessel: give vessel, model or both")
        if not self.manoeuvres and not self.families:
            raise ValueError("no manoeuvre: give manoeuvres, families or both")
        manoeuvres = self.sample_manoeuvres()
        for manoeuvre in manoeuvres:
            check_steps(manoeuvre.duration or self.duration, self.step or DEFAULT_TIME_STEP)
        names = make_log_names(manoeuvres)
        if duplicates := [name for name in names if names.count(name) > 1]:
            raise ValueError(f"two manoeuvres are named '{duplicates[0]}'")
        try:
            if self.vessel is not None and self.model is None:
                self._build_vessel_craft(self.vessel, self.step or DEFAULT_TIME_STEP)
        except UsageError as error:
            raise ValueError(str(error)) from None
        return self

    def sample_manoeuvres(self) -> list[Manoeuvre]:
        """Return the listed manoeuvres, then those drawn from families."""
        generator = np.random.default_rng([self.seed, 1])
        families = [family.sample_all(generator, self.duration) for family in self.families]
        return [
            *self.manoeuvres,
            *(manoeuvre for family_manoeuvres in families for manoeuvre in family_manoeuvres),
        ]

    @cached_property
    def loaded_manoeuvres(self) -> list[Manoeuvre]:
        """The manoeuvres; the logs of replays are loaded.

        Raises:
            ResidnetError: if a log cannot be read.
        """
        manoeuvres = self.sample_manoeuvres()
        reader = self.reader.build()
        for manoeuvre in manoeuvres:
            if isinstance(manoeuvre, Replay):
                manoeuvre.use_log(reader.read(manoeuvre.log))
        return manoeuvres

    @property
    def hull_length(self) -> float | None:
        """Length of the hull in m; None if unknown."""
        vessel = self.vessel or (self.model.actuators if self.model is not None else None)
        is_length_given = self.length is not None or vessel is None
        return self.length if is_length_given else load_vessel(str(vessel)).length.value

    def build_crafts(self) -> list[tuple[SimulatedVessel, TrialEnvironment]]:
        """Return the vessel, then the model, each with its environment.

        Raises:
            UsageError: if one of them cannot perform the manoeuvres.
        """
        model = None if self.model is None else self._build_model_craft(self.model)
        step = self.step or (DEFAULT_TIME_STEP if model is None else model[0].dynamics.dt)
        crafts_and_seas = (
            [] if self.vessel is None else [self._build_vessel_craft(self.vessel, step)]
        )
        return crafts_and_seas if model is None else [*crafts_and_seas, model]

    def simulate_all(self, craft: SimulatedVessel, sea: TrialEnvironment) -> list[ManoeuvreRun]:
        """Simulate all manoeuvres in one batch."""
        step = self.step or (craft.dynamics.dt if self.model is not None else DEFAULT_TIME_STEP)
        meta = {"vessel": self.vessel, "craft": craft.name}
        return simulate_manoeuvres(craft, self.loaded_manoeuvres, sea, self.duration, step, meta)

    def check(self) -> None:
        """Build vessel, model and all manoeuvres without a simulation.

        Raises:
            ResidnetError: if one of them cannot be built.
        """
        times = torch.arange(2, dtype=torch.float64) * (self.step or DEFAULT_TIME_STEP)
        for craft, _ in self.build_crafts():
            make_manoeuvre_source(self.loaded_manoeuvres, craft.helm, times)
            for manoeuvre in self.loaded_manoeuvres:
                manoeuvre.initial_state(craft.initial_state[0], craft.helm.state)

    def _build_vessel_craft(
        self, vessel: str, step: float
    ) -> tuple[SimulatedVessel, TrialEnvironment]:
        plant = build_plant(vessel, self.disturbance)
        # one step checks that the dead times of actuators fit the time step
        inputs = torch.zeros(1, len(plant.input_names), dtype=torch.float64)
        plant.finish_step(plant.make_initial_state(1), inputs, step / self.substeps)
        self.disturbance.check_plant(plant, vessel)
        logged_channels = (
            *plant.state_names,
            *plant.input_names[: plant.n_commands],
            *self.disturbance.logged_inputs,
        )
        self.noise.check_sensors(logged_channels, step, vessel)
        craft = SimulatedVessel(
            load_vessel(vessel).name,
            RecordedPlantDynamics(plant, step, self.substeps),
            Helm.from_plant(plant),
            plant.n_commands,
            self._set_initial_state(plant.make_initial_state(1), plant.state_names, vessel),
        )
        return craft, TrialEnvironment(plant, self.disturbance, self.noise, self.seed)

    def _build_model_craft(self, choice: ModelChoice) -> tuple[SimulatedVessel, TrialEnvironment]:
        name = choice.model_folder.name
        (spec, model) = load_model(choice.model_folder)
        step = spec.dt
        if self.step is not None and abs(self.step - step) > 1e-9:
            raise ConfigError(
                f"programme.step ({self.step:g} s) must be that of model '{name}' ({step:g} s);"
                " leave it out"
            )
        vessel = choice.actuators or self.vessel
        plant = None
        actuators: GivenActuators | PlantActuators
        forces: Callable[[Tensor], Tensor] | None = None
        if choice.inputs:
            actuators = GivenActuators(choice.inputs, spec.signals.exogenous, step)
        elif vessel is not None:
            plant = load_vessel(vessel).build()
            actuators = PlantActuators(plant, step, self.substeps)
            forces = Helm.from_plant(plant).forces
        else:
            raise ConfigError(
                "a model flies with actuators: name a vessel's in programme.model.actuators, or"
                " give programme.model.inputs"
            )
        # a learned model has no input for wave loads
        wind_only = self.disturbance.model_copy(update={"waves": None})
        actuated = ActuatedDynamics(
            model.double(), spec.signals.input_columns, spec.hold, actuators
        )
        logged_channels = (
            *actuated.state_names,
            *actuators.input_names[: actuators.n_commands],
            *self.disturbance.logged_inputs,
        )
        self.noise.check_sensors(logged_channels, step, name)
        if missing_inputs := [
            channel
            for channel in self.disturbance.logged_inputs
            if channel not in actuators.input_names
        ]:
            raise ConfigError(
                f"disturbance.wind: model '{name}' and its actuators have no input"
                f" '{missing_inputs[0]}'"
            )
        helm = Helm(
            actuators.commands_for_demand, actuated.state_names, actuators.input_names, forces
        )
        start = self._set_initial_state(actuated.make_initial_state(1), actuated.state_names, name)
        sea = TrialEnvironment(plant, wind_only, self.noise, self.seed)
        return SimulatedVessel(name, actuated, helm, actuators.n_commands, start), sea

    def _set_initial_state(self, states: Tensor, state: tuple[str, ...], craft_name: str) -> Tensor:
        for name, value in self.initial.items():
            if name not in state:
                raise ConfigError(
                    f"initial: '{craft_name}' has no state '{name}'{suggest_name(name, state)}"
                )
            states[:, state.index(name)] = float(value)
        return states


class SimulateConfig(ComputingTask):
    """Simulated sea trials with manoeuvring indices and figures.

    Give either `programme` or `data`.

    Attributes:
        programme: a list of manoeuvres of a vessel, a learned model, or both; logs are written to
            logs/<log>.parquet, those of a model in addition to a vessel to model_logs.
        data: trials drawn and split as by the task `fit`; logs are written to
            logs/<split>/<log>.parquet.
    """

    section_module: ClassVar[str] = "residnet.report.sections.manoeuvres"

    task: Literal["simulate"]
    programme: Programme | None = None
    data: SimulatedTrials | None = None

    @model_validator(mode="after")
    def _require_one_source(self) -> SimulateConfig:
        if (self.programme is None) == (self.data is None):
            raise ValueError(
                "give either programme (manoeuvres of a vessel or a model) or data (trials with"
                " splits)"
            )
        if self.data is not None:
            self.data.assign_splits(self.data.draw_manoeuvres())
        return self

    def check(self) -> None:
        """Check that models and logs exist and fit the manoeuvres.

        Raises:
            ResidnetError: if one of them is missing or does not fit.
        """
        if self.programme is not None:
            self.programme.check()
        if self.data is not None:
            make_dummy_logs(self.data)

    def input_files(self) -> list[Path]:
        """Return the replayed logs and the files of the learned model."""
        if self.programme is None:
            return []
        files = [m.log for m in self.programme.manoeuvres if isinstance(m, Replay)]
        model = self.programme.model
        return files if model is None else [*files, *sorted(model.model_folder.glob("model.*"))]

    def provenance_seed(self) -> int:
        """Return the seed of the random numbers of the trials."""
        trial_source = self.programme or self.data
        assert trial_source is not None
        return trial_source.seed

    def execute(self, folder: RunFolder) -> TaskOutcome:
        """Simulate the manoeuvres, and write logs, indices and figures.

        A manoeuvre that does not reach its stop condition is a failure if the config lists it; a
        randomly drawn one is only reported.

        Raises:
            UsageError: if the vessel or model cannot perform the manoeuvres.
        """
        if self.programme is not None:
            flights_by_craft = [
                (craft, self.programme.simulate_all(craft, sea))
                for craft, sea in self.programme.build_crafts()
            ]
            length = self.programme.hull_length
            n_listed = len(self.programme.manoeuvres)
            crafts = zip(("logs", "model_logs"), flights_by_craft, strict=False)
            flights_by_folder = [
                (subfolder, flight) for subfolder, (_, flights) in crafts for flight in flights
            ]
        else:
            assert self.data is not None
            manoeuvres = self.data.draw_manoeuvres()
            flights_by_craft = [
                (build_trial_vessel(self.data), simulate_trials(manoeuvres, self.data))
            ]
            length = load_vessel(self.data.vessel).length.value
            n_listed = 0
            flights_by_split = zip(
                self.data.assign_splits(manoeuvres), flights_by_craft[0][1], strict=True
            )
            flights_by_folder = [(f"logs/{split}", flight) for split, flight in flights_by_split]
        for subfolder, flight in flights_by_folder:
            flight.measured_log.save(
                folder.path / subfolder / f"{make_file_stem(flight.measured_log.name)}.parquet"
            )
        rows = [
            row
            for craft, flights in flights_by_craft
            for row in build_index_rows(craft, flights, length)
        ]
        content = build_index_table(self.name, length, rows)
        folder.write_json(folder.path / "indices.json", content)
        figures = trial_figures({craft.name: flights for craft, flights in flights_by_craft})
        write_figures(folder.figures, figures)
        n_flights = len(flights_by_folder)
        faulty_rows = [row for row in rows if row["fault"]]
        completion_text = (
            f"{len(faulty_rows)} of {n_flights} manoeuvres did NOT end as they should"
            if faulty_rows
            else f"All {n_flights} manoeuvres ended as they should"
        )
        verdict = [
            f"{completion_text}; they were flown by"
            f" {' and '.join(craft.name for craft, _ in flights_by_craft)}, and"
            " their logs are in the folder logs."
        ]
        verdict += [f"{row['craft']}, {row['log']}: {row['fault']}." for row in faulty_rows[:5]]
        fault_messages = [
            (f"{craft.name}, {flight.measured_log.name}: {flight.fault_text}", number < n_listed)
            for craft, flights in flights_by_craft
            for number, flight in enumerate(flights)
            if flight.fault_text
        ]
        for line, _ in fault_messages:
            log_message(line)
        failures = [line for line, is_listed in fault_messages if is_listed]
        failure_message = failures and (
            f"{failures[-1]} ({len(failures)} of {n_flights} flights did not end as they should;"
            f" give"
            " more duration, drive or steer)"
        )
        return TaskOutcome(
            verdict,
            {
                "logs": SummaryMetric(n_flights),
                "flights_with_a_fault": SummaryMetric(len(faulty_rows)),
            },
            indices_text(content) if len(rows) <= _MAX_SHOWN_ROWS else "",
            failure_message or "",
        )

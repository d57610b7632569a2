"""Settings of the task `simulate`: manoeuvres of a vessel or a learned model."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import ClassVar, Literal, final

import numpy as np
from pydantic import Field, field_validator, model_validator

from residnet.core.config import Config, ExistingPath, Metres, Quantity, Seconds
from residnet.core.errors import ConfigError, UsageError
from residnet.core.names import CHANNEL_UNITS, suggest_name
from residnet.dynamics.time_steps import check_steps
from residnet.io.readers import ReaderConfig
from residnet.io.readers.base import CanonicalConfig
from residnet.manoeuvres import FamilyConfig, ManoeuvreConfig
from residnet.manoeuvres.base import Manoeuvre
from residnet.manoeuvres.input_shares import InputShare
from residnet.manoeuvres.open_loop import Replay
from residnet.manoeuvres.trials_config import (
    DisturbanceConfig,
    SensorsConfig,
    SimulatedTrials,
    check_simulated_vessel,
    make_dummy_logs,
    make_log_names,
)
from residnet.physics.plant_channels import PlantChannels
from residnet.physics.vessel import load_vessel
from residnet.runs.task import ComputingTask, PackageTask

DEFAULT_TIME_STEP = 0.05
"""Default time step of a simulation in s."""


class ModelChoice(Config):
    """A learned model of a finished run, driven through actuators.

    Attributes:
        run: folder of the run.
        name: name of the model; `selected` is the model chosen on validation data.
        actuators: vessel (name or file) whose actuators convert commands to the inputs of the
            model; null for the vessel of the programme.
        inputs: instead of the actuators of a vessel: shares of propulsion command and steering
            command, limits and rates of each input of the model.
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
        from residnet.dynamics.store import resolve_model_name

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
        length: length in m of the hull, for indices in lengths; null for the vessel's.
        reader: reader of the logs that are replayed.
        noise: noise of the sensors in the logs; indices are computed from the motion without noise.
        disturbance: wind, current and waves; a learned model responds only to the wind, if it was
            fitted with it.
        seed: seed of all random numbers.
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
                self.check_vessel(self.vessel)
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

    def check_vessel(self, vessel: str) -> PlantChannels:
        """Check time step, disturbance, sensors and initial states; return the channels.

        Raises:
            ConfigError: if one of them does not fit the vessel.
        """
        channels = check_simulated_vessel(
            vessel, self.step or DEFAULT_TIME_STEP, self.substeps, self.disturbance, self.noise
        )
        self.require_states(channels.state_names, vessel)
        return channels

    def require_states(self, state_names: Sequence[str], craft_name: str) -> None:
        """Check that a vessel or model has the states of `initial`.

        Raises:
            ConfigError: if it lacks one.
        """
        for name in self.initial:
            if name not in state_names:
                hint = suggest_name(name, state_names)
                raise ConfigError(f"initial: '{craft_name}' has no state '{name}'{hint}")


@final
class SimulateConfig(PackageTask, ComputingTask):
    """Simulated sea trials with manoeuvring indices and figures.

    Give either `programme` or `data`.

    Attributes:
        programme: a list of manoeuvres of a vessel, a learned model, or both; logs are written to
            logs/<log>.parquet, logs of a model in addition to a vessel to model_logs.
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
        if self.data is not None:
            make_dummy_logs(self.data)
        programme = self.programme
        if programme is None:
            return
        manoeuvres = programme.loaded_manoeuvres
        has_replay = any(isinstance(manoeuvre, Replay) for manoeuvre in manoeuvres)
        if programme.vessel is None or programme.model is not None or has_replay:
            # a learned model and the states of a replay need PyTorch
            self.call_executor("check_programme")
            return
        channels = programme.check_vessel(programme.vessel)
        for manoeuvre in manoeuvres:
            manoeuvre.check_vessel(channels)

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

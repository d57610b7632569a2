"""Task `sea_trial`: models of Odin by phase, on simulated trials (Halvorsen 2019, section 7.5).

The log is interpolated to a uniform grid, filtered forward and backward by a Butterworth low-pass,
and differentiated by differences (7.1). The standard model is compared with equations found from
the data alone.
"""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, final

import numpy as np
from pydantic import Field, model_validator

from residnet.core.config import Config, Radians, Seconds
from residnet.core.errors import ConfigError
from residnet.core.names import VELOCITY_NAMES, suggest_name
from residnet.heads.base import ClosedFormHead
from residnet.heads.genetic_config import GeneticConfig
from residnet.heads.symbolic_config import SymbolicConfig
from residnet.manoeuvres.base import Manoeuvre
from residnet.manoeuvres.closed_loop import Zigzag
from residnet.manoeuvres.open_loop import AccelerationDeceleration
from residnet.manoeuvres.trials_config import DisturbanceConfig, SensorsConfig
from residnet.physics.froude import SPEED_REGIMES
from residnet.physics.hull import AccelerationHullConfig
from residnet.physics.vessel import load_vessel
from residnet.runs.task import ComputingTask
from residnet.studies.halvorsen2019.standard_model import (
    StandardFitConfig,
)
from residnet.studies.study import (
    StudyTask,
)

CONTROLS = ("cmd_n", "cmd_nozzle")
FORCES = ("tau_x", "tau_y", "tau_n")
CHANNELS = (*VELOCITY_NAMES, *CONTROLS, *FORCES)
ALL = "all"
"""Name of the set of all samples."""
STANDARD = "standard"
"""Name of the standard model, fitted to all samples."""
SEPARATE = "separate"
"""Name of the standard models that are fitted to one speed regime each."""
PLANT = "plant"
"""Name of the equations of the simulated vessel."""
SAMPLE_SETS = (*SPEED_REGIMES, ALL)
"""Sets of samples for fits and evaluations."""
Published = dict[str, tuple[float, float, float, float, float, float]]
"""Acceleration -> published RMSE, C_p, adjusted R^2, mean absolute residual and its interval."""


class ProgrammeConfig(Config):
    """Zigzags at several speeds and a straight run in steps of speed, once on each course.

    Attributes:
        drives: motor speeds as shares of the largest one.
        steers: nozzle angles as shares of the largest one; there is a zigzag for each speed and
            angle.
        heading: heading change in rad at which a zigzag is reversed.
        zigzag: duration of a zigzag in s.
        hold: time in s for which a speed of the straight run is held.
        courses: courses in rad of the programme; two opposite ones cancel a constant drift, as in
            the document.
    """

    drives: tuple[float, ...] = Field(default=(0.35, 0.45, 0.55, 0.7, 0.85, 1.0), min_length=2)
    steers: tuple[float, ...] = Field(default=(0.15, 0.35), min_length=1)
    heading: Radians = Field(default=float(np.radians(20)), gt=0)
    zigzag: Seconds = Field(default=80.0, gt=0)
    hold: Seconds = Field(default=25.0, gt=0)
    courses: tuple[Radians, ...] = Field(default=(0.0, float(np.pi)), min_length=1)

    def build_manoeuvres(self) -> list[Manoeuvre]:
        """Return the manoeuvres of one course in their order in time."""
        levels = (*self.drives, *reversed(self.drives[:-1]))
        times = tuple(self.hold * i for i in range(len(levels)))
        straight_run = AccelerationDeceleration(
            times=times, levels=levels, duration=self.hold * len(levels)
        )
        zigzags = [
            Zigzag(
                heading=self.heading,
                start=self.zigzag / 4,
                duration=self.zigzag,
                drive=drive,
                steer=steer,
                first="starboard" if steer_index % 2 == 0 else "port",
            )
            for drive in self.drives
            for steer_index, steer in enumerate(self.steers)
        ]
        return [straight_run, *zigzags]


class PreparationConfig(Config):
    """Preparation of velocities and accelerations from a log with uneven steps (section 7.3.1).

    Attributes:
        interval: shortest and longest time between two samples of the log, in s.
        step: time step of the uniform grid in s.
        cutoff: cut-off frequency of the Butterworth filter as a share of the Nyquist frequency
            (see H27 in docs/documents/corrections.md).
        order: order of the filter, which is run forward and backward.
        filter_inputs: whether commands and forces are filtered like the velocities. The document
            filters only the velocities; equations then also learn the filter and have smaller
            errors than the true equations of the vessel.
        margin: time in s that is removed at both ends of a log, where the filter is one-sided.
        stretch: length in s of the segments that are used as a whole for training or validation.
        validate_every: the last of so many segments is for validation.
    """

    interval: tuple[Seconds, Seconds] = (0.03, 0.08)
    step: Seconds = Field(default=0.05, gt=0)
    cutoff: float = Field(default=0.1, gt=0, lt=1)
    order: int = Field(default=2, ge=1, le=8)
    filter_inputs: bool = True
    margin: Seconds = Field(default=2.0, ge=0)
    stretch: Seconds = Field(default=20.0, gt=0)
    validate_every: int = Field(default=4, ge=2)

    @model_validator(mode="after")
    def _check_interval(self) -> PreparationConfig:
        if not 0 < self.interval[0] <= self.interval[1]:
            raise ValueError(
                "interval: expected shortest and longest, both positive, given"
                f" {list(self.interval)} s"
            )
        return self


class SeaTrialConfig(Config):
    """A simulated sea trial with one vessel.

    Attributes:
        vessel: vessel of kind `load_odin` with water jets, by name or file.
        programme: manoeuvres of the trial.
        disturbance: waves and other forces.
        noise: noise of the measured velocities.
        preparation: preparation of the samples from the logs.
        seed: seed of the sea, the noise and the times of the samples.
    """

    vessel: str

    programme: ProgrammeConfig = ProgrammeConfig()
    disturbance: DisturbanceConfig = DisturbanceConfig()
    noise: SensorsConfig = SensorsConfig(u=0.02, v=0.02, r=float(np.radians(0.1)))
    preparation: PreparationConfig = PreparationConfig()
    seed: int = Field(default=0, ge=0)

    @model_validator(mode="after")
    def _check_disturbance(self) -> SeaTrialConfig:
        try:
            self.disturbance.check_plant(load_odin(self.vessel).build(), self.vessel)
        except ConfigError as error:
            raise ValueError(str(error)) from None
        return self


def load_odin(name: str) -> AccelerationHullConfig:
    """Return a vessel with accelerations as sums of terms and with water jets.

    Raises:
        ConfigError: if the vessel is of another kind.
    """
    vessel = load_vessel(name)
    if (
        not isinstance(vessel, AccelerationHullConfig)
        or vessel.build().actuators.command_names != CONTROLS
    ):
        raise ConfigError(
            f"vessel '{name}': the sea trial needs a vessel of kind 'odin' with water jets, for"
            " example odin_jets"
        )
    return vessel


class EquationConfig(Config):
    """An equation of the accelerations that is identified from data only.

    Attributes:
        inputs: inputs of the equation: `forces` of the water jets by their known thrust, or
            `controls`, which are motor speed and nozzle angle.
        head: settings of the identification.
    """

    inputs: Literal["forces", "controls"]
    head: Annotated[SymbolicConfig | GeneticConfig, Field(discriminator="kind")]

    @model_validator(mode="after")
    def _check_features(self) -> EquationConfig:
        if self.head.features:
            raise ValueError("head.features: give `inputs` instead")
        return self

    def build(self) -> ClosedFormHead:
        """Build the head for the channels of a trial.

        Raises:
            ConfigError: if its terms use a channel that is not among its inputs.
        """
        features = (*VELOCITY_NAMES, *(FORCES if self.inputs == "forces" else CONTROLS))
        return self.head.model_copy(update={"features": features}).build(CHANNELS)


@final
class SeaTrialTaskConfig(StudyTask, ComputingTask):
    """Models of Odin fitted and evaluated by phase, on simulated trials.

    Attributes:
        task: `sea_trial`.
        trials: trials by name; published figures are compared with the first one.
        standard: settings of the fit of the standard model.
        equations: equations by name.
        published: published numbers by set of samples, model and acceleration: root mean
            square error (m/s^2, m/s^2, rad/s^2), C_p and adjusted R^2 (Tables 7.3, 7.4), mean
            absolute residual and the limits of its 95 % interval (Table 7.5).
    """

    executor_class: ClassVar[str] = "SeaTrialExecutor"

    task: Literal["sea_trial"]
    trials: dict[str, SeaTrialConfig] = Field(min_length=1)
    standard: StandardFitConfig = StandardFitConfig()
    equations: dict[str, EquationConfig] = Field(default_factory=dict)
    published: dict[str, dict[str, Published]] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _check_names(self) -> SeaTrialTaskConfig:
        for name, equation in self.equations.items():
            if name in (STANDARD, SEPARATE, PLANT):
                raise ValueError(f"equations: the name '{name}' is taken")
            try:
                equation.build()
            except ConfigError as error:
                raise ValueError(f"equations.{name}: {error}") from None
        model_names = (STANDARD, *self.equations)
        for set_name, models in self.published.items():
            for name_role, allowed_names, given_name in (
                ("set", SAMPLE_SETS, set_name),
                *(("model", model_names, m) for m in models),
            ):
                if given_name not in allowed_names:
                    raise ValueError(
                        f"published: no {name_role}"
                        f" '{given_name}'{suggest_name(given_name, allowed_names)}"
                    )
        return self

    def provenance_seed(self) -> int:
        return next(iter(self.trials.values())).seed

"""Config of the simulated sea trial of Odin and of its models (document 000, section 7.5)."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from residnet.core.config import Config, Radians, Seconds
from residnet.core.errors import ConfigError
from residnet.core.names import VELOCITY, nearest
from residnet.data.simulated.environment import Disturbance
from residnet.data.simulated.sensors import SensorNoise
from residnet.documents.halvorsen2019.sea_trial.standard_model import StandardFitConfig
from residnet.heads.base import ClosedFormHead
from residnet.heads.genetic import GeneticConfig
from residnet.heads.symbolic import SymbolicConfig
from residnet.manoeuvres import AccelerationDeceleration, Manoeuvre, Zigzag
from residnet.physics.froude import PHASES
from residnet.physics.odin import OdinConfig
from residnet.physics.vessel import load_vessel
from residnet.runs.task import ComputingTask

CONTROLS, FORCES = ("cmd_n", "cmd_nozzle"), ("tau_x", "tau_y", "tau_n")
CHANNELS = (*VELOCITY, *CONTROLS, *FORCES)
ALL = "all"
STANDARD, SEPARATE, PLANT = "standard", "separate", "plant"
SETS = (*PHASES, ALL)
"""Sets of samples that a model is fitted to and judged on."""
Published = dict[str, tuple[float, float, float]]


class ProgrammeConfig(Config):
    """Zigzags at several speeds and a straight run in steps of speed, once on each course.

    Attributes:
        drives: motor speeds as shares of the largest one.
        steers: nozzle angles as shares of the largest one; there is a zigzag for each speed and
            angle.
        heading: heading change in rad at which a zigzag is reversed.
        zigzag: duration of a zigzag in s.
        hold: time in s for which a speed of the straight run is held.
        courses: courses in rad on which the programme is sailed; two opposite ones cancel a steady
            drift, as in the document.
    """

    drives: tuple[float, ...] = Field(default=(0.35, 0.45, 0.55, 0.7, 0.85, 1.0), min_length=2)
    steers: tuple[float, ...] = Field(default=(0.15, 0.35), min_length=1)
    heading: Radians = Field(default=float(np.radians(20)), gt=0)
    zigzag: Seconds = Field(default=80.0, gt=0)
    hold: Seconds = Field(default=25.0, gt=0)
    courses: tuple[Radians, ...] = Field(default=(0.0, float(np.pi)), min_length=1)

    def manoeuvres(self) -> list[Manoeuvre]:
        """Return the manoeuvres of one course in the order in which they are sailed."""
        levels = (*self.drives, *reversed(self.drives[:-1]))
        times = tuple(self.hold * i for i in range(len(levels)))
        programme: list[Manoeuvre] = [
            AccelerationDeceleration(times=times, levels=levels, duration=self.hold * len(levels))
        ]
        for drive in self.drives:
            for number, steer in enumerate(self.steers):
                first = "starboard" if number % 2 == 0 else "port"
                programme.append(
                    Zigzag.model_validate(
                        {**self._zigzag(), "drive": drive, "steer": steer, "first": first}
                    )
                )
        return programme

    def _zigzag(self) -> dict[str, float]:
        return {"heading": self.heading, "start": self.zigzag / 4, "duration": self.zigzag}


class PreparationConfig(Config):
    """How a log with uneven time steps becomes velocities and accelerations (section 7.3.1).

    Attributes:
        interval: shortest and longest time between two samples of the log, in s.
        step: time step of the uniform grid in s.
        cutoff: cut-off frequency of the Butterworth filter as a share of the Nyquist frequency
            (correction H27).
        order: order of the filter, which is run forward and backward.
        filter_inputs: filter commands and forces as the velocities. The document filters the
            velocities alone; its equations then learn the filter, too, and leave less of the
            measured acceleration than the vessel's own equations.
        margin: time in s that is cut off at both ends of a log, where the filter has one side only.
        stretch: length in s of the stretches that train or validate as a whole.
        validate_every: number of stretches of which the last one validates.
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
    def _ordered(self) -> PreparationConfig:
        if not 0 < self.interval[0] <= self.interval[1]:
            raise ValueError(
                "interval: expected shortest and longest, both positive, given"
                f" {list(self.interval)} s"
            )
        return self


class SeaTrialConfig(Config):
    """A simulated sea trial with one vessel.

    Attributes:
        vessel: vessel of kind `odin` with water jets, by name or file.
        programme: manoeuvres that are sailed.
        disturbance: waves and other forces.
        noise: noise of the measured velocities.
        preparation: how the logs become samples.
        step: time step of the simulation in s; its motion is sampled unevenly.
        seed: seed of the sea, the noise and the times of the samples.
    """

    vessel: str

    programme: ProgrammeConfig = ProgrammeConfig()
    disturbance: Disturbance = Disturbance()
    noise: SensorNoise = SensorNoise(u=0.02, v=0.02, r=float(np.radians(0.1)))
    preparation: PreparationConfig = PreparationConfig()
    step: Seconds = Field(default=0.04, gt=0)
    seed: int = Field(default=0, ge=0)

    @field_validator("step")
    @classmethod
    def _fine(cls, step: float) -> float:
        if step > 0.05:
            raise ValueError(
                f"step: the simulation must be finer than the log, at most 0.05 s, given {step:g} s"
            )
        return step

    @model_validator(mode="after")
    def _fits(self) -> SeaTrialConfig:
        try:
            self.disturbance.check(odin(self.vessel).build(), self.vessel)
        except ConfigError as error:
            raise ValueError(str(error)) from None
        return self


def odin(name: str) -> OdinConfig:
    """Return a vessel whose accelerations are known as terms and which has water jets.

    Raises:
        ConfigError: where the vessel is of another kind.
    """
    vessel = load_vessel(name)
    if not isinstance(vessel, OdinConfig) or vessel.build().actuators.commands != CONTROLS:
        raise ConfigError(
            f"vessel '{name}': the sea trial needs a vessel of kind 'odin' with water jets, such as"
            " odin_jets"
        )
    return vessel


class EquationConfig(Config):
    """An equation of the accelerations that is found from the data alone.

    Attributes:
        inputs: inputs of the equation: `forces` of the water jets by their known thrust, or
            `controls`, which are motor speed and nozzle angle.
        head: how the equation is found.
    """

    inputs: Literal["forces", "controls"]
    head: Annotated[SymbolicConfig | GeneticConfig, Field(discriminator="kind")]

    @model_validator(mode="after")
    def _inputs_only(self) -> EquationConfig:
        if self.head.features:
            raise ValueError("head.features: give `inputs` instead")
        return self

    def build(self) -> ClosedFormHead:
        """Build the head for the channels of a trial.

        Raises:
            ConfigError: where its terms name a channel that is not among its inputs.
        """
        features = (*VELOCITY, *(FORCES if self.inputs == "forces" else CONTROLS))
        return self.head.model_copy(update={"features": features}).build(CHANNELS)


class SeaTrialSettings(ComputingTask):
    """Models of Odin fitted and judged by phase, on one simulated trial or several.

    Attributes:
        trials: trials by name; published figures stand beside the first one.
        standard: how the standard model is fitted.
        equations: equations by name.
        separate: also judge models that consist of one model for each phase.
        published: root mean square error (m/s^2, m/s^2, rad/s^2), C_p and adjusted R^2 that the
            document prints (Tables 7.3, 7.4), by set of samples, model and acceleration.
        published_absolute: mean absolute residual (m/s^2, m/s^2, rad/s^2) and the ends of its 95 %
            interval that the document prints (Table 7.5), likewise.
    """

    trials: dict[str, SeaTrialConfig] = Field(min_length=1)
    standard: StandardFitConfig = StandardFitConfig()
    equations: dict[str, EquationConfig] = Field(default_factory=dict)
    separate: bool = True
    published: dict[str, dict[str, Published]] = Field(default_factory=dict)
    published_absolute: dict[str, dict[str, Published]] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _names(self) -> SeaTrialSettings:
        for name in self.equations:
            if name in (STANDARD, SEPARATE, PLANT):
                raise ValueError(f"equations: the name '{name}' is taken")
        for key in ("published", "published_absolute"):
            self._check_printed(key, getattr(self, key))
        for name, equation in self.equations.items():
            try:
                equation.build()
            except ConfigError as error:
                raise ValueError(f"equations.{name}: {error}") from None
        return self

    def _check_printed(self, key: str, printed: dict[str, dict[str, Published]]) -> None:
        """Check that printed figures belong to sets and models that there are."""
        for where, models in printed.items():
            if where not in SETS:
                raise ValueError(f"{key}: no set '{where}'{nearest(where, SETS)}")
            for model in models:
                if model not in (STANDARD, *self.equations):
                    raise ValueError(
                        f"{key}.{where}: no model"
                        f" '{model}'{nearest(model, (STANDARD, *self.equations))}"
                    )

"""Settings of the tests and conditions in which controllers of heading or depth are evaluated."""

from __future__ import annotations

from typing import Self

from pydantic import Field, model_validator

from residnet.autopilot.heading.conditions import ConditionsConfig
from residnet.autopilot.heading.tuning import TuningConfig
from residnet.core.config import Config, Metres, MetresPerSecond, Radians, Seconds
from residnet.dynamics.time_steps import check_steps
from residnet.physics.environment_config import WavesConfig
from residnet.runs.task import PartName


class EvaluationConditions(Config):
    """Operating conditions under which all controllers of a run are tuned, trained and evaluated.

    Attributes:
        stated: operating conditions and cost of a simulation.
        flights: number of simulations for the evaluation, not used in tuning or training.
        beyond: further conditions by name, outside the range of tuning and training, that
            are used for evaluation only.
        evolution: settings of the search for constants of classical laws.
    """

    stated: ConditionsConfig = ConditionsConfig()
    flights: int = Field(default=1500, ge=2, le=1_000_000)
    beyond: dict[PartName, ConditionsConfig] = Field(default_factory=dict)
    evolution: TuningConfig = TuningConfig()

    @property
    def all_conditions(self) -> dict[str, ConditionsConfig]:
        """All conditions by name, the stated ones first."""
        return {"stated": self.stated, **self.beyond}


class DepthStepTestConfig(Config):
    """A step of the depth reference instead of the heading reference.

    Attributes:
        change: change of the depth in m, alternately down and up.
        band: depth error in m within which the change has settled.
    """

    change: Metres = Field(default=3.0, gt=0)
    band: Metres = Field(default=0.1, gt=0)


class StepTestConfig(Config):
    """Test of all controllers: a step of the heading reference on a straight course.

    Attributes:
        depth: a step of the depth instead; all controllers are then depth controllers with the
            stern planes as their rudder. Null for the heading.
        heading: change of the reference in rad, without a prefilter.
        band: heading error in rad; the change has settled at the last entry into this band.
        dt: step of simulation and controllers in s.
        duration: duration of a simulation in s.
        plants: number of random vessels, in addition to the corners of the ranges.
        bias: constant rudder angle of the steady-error test in rad.
        bias_time: duration of the steady-error test in s.
        wind: mean wind speed in m/s of the same test in wind, from eight directions and without
            bias; null for none.
        sea: waves in which the course is kept after the step; null for none.
        sea_time: duration in waves in s, from the end of the step test.
    """

    depth: DepthStepTestConfig | None = None
    heading: Radians = Field(default=0.5235987755982988, gt=0, lt=3.1)
    band: Radians = Field(default=0.017453292519943295, gt=0)
    dt: Seconds = Field(default=0.02, gt=0)
    duration: Seconds = Field(gt=0)
    plants: int = Field(default=200, ge=1, le=100_000)
    bias: Radians = Field(default=0.017453292519943295, ge=0)
    bias_time: Seconds = Field(default=60.0, gt=0)
    wind: MetresPerSecond | None = Field(default=None, gt=0)
    sea: WavesConfig | None = None
    sea_time: Seconds = Field(default=120.0, gt=0)

    @model_validator(mode="after")
    def _check_durations(self) -> Self:
        for name in ("duration", "bias_time", "sea_time"):
            check_steps(getattr(self, name), self.dt, name)
        return self

    @property
    def step_and_tolerance(self) -> tuple[float, float]:
        """The change and its tolerance band, in rad of heading or m of depth."""
        if self.depth is None:
            return self.heading, self.band
        return self.depth.change, self.depth.band

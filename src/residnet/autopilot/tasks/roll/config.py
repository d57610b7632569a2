"""Task `roll`: reduce the roll of a vessel in waves by rudder and fins, classical and learned."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal, Self, final

from pydantic import Field, model_validator

from residnet.autopilot.roll_config import (
    HEADINGS_DEG,
    EquivalentBoxConfig,
    RollTraining,
    RollTuning,
    RollWeights,
    Sea,
    list_seas,
)
from residnet.core.config import Config, Radians, Seconds
from residnet.core.errors import ConfigError
from residnet.dynamics.time_steps import check_steps
from residnet.physics.actuators.rudders import FinPairConfig, SternRuddersConfig
from residnet.physics.vessel import VesselName, load_vessel
from residnet.runs.task import ComputingTask, PackageTask

_DEFAULT_DIRECTIONS = tuple(math.radians(heading) for heading in HEADINGS_DEG)


class RollJudgingConfig(Config):
    """Simulations by which all controllers are compared, with the same waves for all.

    Attributes:
        duration: duration of a simulation in s, with the initial transient.
        realisations: number of random waves for each sea state and direction.
        tolerance: relative increase of the RMS heading error up to which the heading error counts
            as the same.
    """

    duration: Seconds = Field(default=120.0, gt=0)
    realisations: int = Field(default=12, ge=2, le=100_000)
    tolerance: float = Field(default=0.02, ge=0, lt=1)


@final
class RollTaskConfig(PackageTask, ComputingTask):
    """Roll reduction on a straight course in waves, by classical laws and a learned policy.

    Heading control alone, rudder roll damping, fin PD, and both together are tuned by differential
    evolution. The constants of the last law are then trained by gradients (`both_trained`), and a
    recurrent network that is added to it (`learned`). All have the same cost and the same seas.

    Attributes:
        vessel: name or path of a vessel with rudders and stabiliser fins.
        hull: particulars of the hull for the wave loads.
        rudder: largest rudder angle of the controllers in rad.
        fins: largest fin angle of the controllers in rad.
        sea_states: sea states of tuning, training and judging.
        directions: directions to which the waves travel, relative to the course: 0 deg following,
            180 deg head seas.
        noise: standard deviation of the white noise of measured angles in rad and rates in rad/s.
        weights: weights of the cost.
        dt: time step of simulation and controllers in s.
        transient: initial interval in s of every simulation that is not evaluated.
        duration: duration in s of a simulation in tuning and training.
        tuning: search for the constants of the classical laws.
        units: number of recurrent units for each of rudder and fins.
        training: training of the constants and of the policy.
        judging: simulations of the comparison.
        seed: seed of tuning, training and waves.
    """

    task: Literal["roll"]
    vessel: VesselName
    hull: EquivalentBoxConfig
    rudder: Radians = Field(gt=0)
    fins: Radians = Field(gt=0)
    sea_states: tuple[Annotated[int, Field(ge=3, le=5)], ...] = Field(
        default=(3, 4, 5), min_length=1
    )
    directions: tuple[Radians, ...] = Field(default=_DEFAULT_DIRECTIONS, min_length=1)
    noise: Radians = Field(default=math.radians(0.1), ge=0)
    weights: RollWeights = RollWeights()
    dt: Seconds = Field(default=0.1, gt=0)
    transient: Seconds = Field(default=20.0, ge=0)
    duration: Seconds = Field(default=80.0, gt=0)
    tuning: RollTuning = RollTuning()
    units: int = Field(default=12, ge=1, le=1_000)
    training: RollTraining = RollTraining()
    judging: RollJudgingConfig = RollJudgingConfig()
    seed: int = Field(default=0, ge=0)

    supported_commands: ClassVar[tuple[str, ...]] = ("report",)
    section_module: ClassVar[str] = "residnet.autopilot.report.roll"

    @model_validator(mode="after")
    def _validate_times(self) -> Self:
        for name, values in {"sea_states": self.sea_states, "directions": self.directions}.items():
            if len(set(values)) < len(values):
                raise ValueError(f"{name}: each value may occur once")
        for name, duration in {
            "duration": self.duration,
            "judging.duration": self.judging.duration,
        }.items():
            if duration < self.transient + self.dt:
                raise ValueError(
                    f"{name} ({duration:g} s) must be longer than transient ({self.transient:g} s)"
                )
            check_steps(duration, self.dt)
        return self

    def provenance_seed(self) -> int:
        return self.seed

    def list_seas(self) -> list[Sea]:
        """Return the conditions: each sea state with each direction."""
        return list_seas(self.sea_states, [math.degrees(angle) for angle in self.directions])

    def check(self) -> None:
        """Check that the vessel has rudders and fins that can follow the commands.

        Raises:
            ConfigError: if the vessel has no fins, or a limit exceeds the limit of the vessel.
        """
        actuators = getattr(load_vessel(self.vessel), "actuators", None)
        fins = getattr(actuators, "fins", None)
        if not isinstance(actuators, SternRuddersConfig) or not isinstance(fins, FinPairConfig):
            raise ConfigError(
                f"vessel: {self.vessel} has no stabiliser fins; give its rudders the section"
                " `fins`, as in configs/vessels/patrol_fins.yaml"
            )
        limits = {"rudder": (self.rudder, actuators.limit), "fins": (self.fins, fins.limit)}
        for name, (limit, vessel_limit) in limits.items():
            # a limit in degrees has rounding errors
            if limit > vessel_limit * (1.0 + 1e-9):
                raise ConfigError(
                    f"{name}: {math.degrees(limit):.4g} deg exceed the"
                    f" {math.degrees(vessel_limit):.4g} deg of {self.vessel}; lower this limit or"
                    " that of the vessel"
                )

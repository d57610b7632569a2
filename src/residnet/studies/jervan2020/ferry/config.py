"""Task `ferry_study`: residual models of a ferry in closed loop (Jervan 2020, chapter 4).

The plant follows a course under a controller with a believed model. Residual models are identified
from this run, and the course is repeated with them as feed-forward.
"""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Literal, final

from pydantic import Field, model_validator

from residnet.autopilot.guidance import CrossingConfig
from residnet.autopilot.motion_config import ReferenceFilterConfig
from residnet.core.config import Config
from residnet.core.errors import ConfigError
from residnet.core.names import suggest_name
from residnet.runs.task import ComputingTask, ExportRequest, PartName
from residnet.studies.jervan2020.ferry_loop import (
    Disturbance,
    FerrySimulation,
    LoopConfig,
    MotionNoise,
)
from residnet.studies.jervan2020.residual import (
    ResidualModelConfig,
)
from residnet.studies.study import (
    StudyTask,
)

BELIEVED_NAME = "believed"


class PublishedFigures(Config):
    """Published figures of Jervan 2020 for one model.

    Numbers are as printed, unless a correction of the document applies. Null if the document has
    none.

    Attributes:
        mse: mean square residual on the test half in N^2, N^2, (N m)^2 (Tables 4.2, 4.5,
            4.7, 4.15); surge, sway and yaw.
        position_mae: mean position error on the course in m (Tables 4.4, 4.10).
        position_mse: mean square position error on the course in m^2 (Tables 4.4, 4.10).
        heading_mae: mean heading error on the course in deg (Tables 4.4, 4.10).
        tau: mean absolute commanded force in N, N, N m (Tables 4.3, 4.9).
        feedback: mean absolute feedback force in N, N, N m (Tables 4.3, 4.9).
        crossing_position_mae: mean position error in the operational crossing in m (Table 4.12).
        crossing_position_mse: mean square position error in the crossing in m^2 (Table 4.12).
        crossing_heading_mae: mean heading error in the crossing in deg (Table 4.12).
        alone: mean square error of u, v, r and of their derivatives against the desired motion
            without feedback, in (m/s)^2, (m/s)^2, (rad/s)^2 and the same per second squared
            (Table 4.8; see J21 in docs/documents/corrections.md).
        crossing_power: mean power in W for position and heading control in the crossing (Table
            4.13).
        coefficients: coefficients of the basis functions in surge, sway and yaw in SI units
            (Table 4.11), by basis function.
    """

    mse: tuple[float, float, float] | None = None
    position_mae: float | None = None
    position_mse: float | None = None
    heading_mae: float | None = None
    tau: tuple[float, float, float] | None = None
    feedback: tuple[float, float, float] | None = None
    crossing_position_mae: float | None = None
    crossing_position_mse: float | None = None
    crossing_heading_mae: float | None = None
    alone: tuple[float, float, float, float, float, float] | None = None
    crossing_power: tuple[float, float] | None = None
    coefficients: dict[str, tuple[float, float, float]] = Field(default_factory=dict)


class FerryModelConfig(ResidualModelConfig):
    """One model of the residual force; with `lag`, its feed-forward compensates the thruster lag.

    Attributes:
        smooth: estimate the motion from all noisy measurements together before the fit
            (`residnet.preprocessing.motion`). Null for yes if the noise is known and the model
            searches its settings.
        on: name of the model whose remaining residual this one explains (3.26); empty for the
            believed hull.
        fly: simulate the course, and the crossing if there is one, with this feed-forward.
        published: published figures of this model.
    """

    smooth: bool | None = None
    on: str = ""
    fly: bool = False
    published: PublishedFigures = PublishedFigures()


@final
class FerryStudyConfig(StudyTask, ComputingTask):
    """A course with the believed model, residual models identified from it, and the course again.

    Attributes:
        task: `ferry_study`.
        believed: vessel with the hull model of the controller, by name or file.
        true: simulated vessel, by name or file.
        course: waypoints and reference filter; the first half is for identification, the second
            for tests.
        loop: controller and sampling.
        judging_courses: courses on which the exported feed-forwards are compared with the believed
            model, of equal duration; null for three drawn ones: ahead, astern, and with the drift
            angles of the course.
        crossing: an operational crossing that is also simulated; null for none.
        noise: measurement noise; null for none.
        disturbance: constant force in earth axes.
        feed_forward_alone: whether the course is also simulated without feedback (Table 4.8).
        models: residual models by name; a model must follow the one given by `on`.
        published: published figures of the believed model.
        later: the true vessel after a change, by name or file; feed-forward models are checked on
            its log and identified again if they are no longer valid. Null for none.
        seed: seed of the noise.
    """

    executor_class: ClassVar[str] = "FerryExecutor"
    results_file: ClassVar[str] = "ferry.json"

    task: Literal["ferry_study"]
    believed: str = "milliampere"
    true: str = "milliampere_half"
    course: ReferenceFilterConfig
    loop: LoopConfig
    judging_courses: tuple[ReferenceFilterConfig, ...] | None = Field(default=None, min_length=1)
    crossing: CrossingConfig | None = None
    noise: MotionNoise | None = None
    disturbance: Disturbance = Disturbance()
    feed_forward_alone: bool = False
    models: dict[PartName, FerryModelConfig] = Field(min_length=1)
    published: PublishedFigures = PublishedFigures()
    later: str | None = None
    seed: int = Field(default=0, ge=0)

    supported_commands: ClassVar[tuple[str, ...]] = ("report", "export")

    @model_validator(mode="after")
    def _check_combination(self) -> FerryStudyConfig:
        previous_names: list[str] = []
        for name, model in self.models.items():
            if name == BELIEVED_NAME:
                raise ValueError(
                    "'believed' is reserved for the model of the controller; use another name"
                )
            if model.on and model.on not in previous_names:
                raise ValueError(
                    f"models.{name}.on: no preceding model is named"
                    f" '{model.on}'{suggest_name(model.on, previous_names)}"
                )
            base_model = self.models.get(model.on)
            if base_model and (
                base_model.searches_settings or bool(base_model.lag) != bool(model.lag)
            ):
                raise ValueError(
                    f"models.{name}.on: '{model.on}' and it must both have a lag or none; set 'lag'"
                    " of both"
                )
            previous_names.append(name)
        if len(self.course.waypoints) < 4:
            raise ValueError(
                "course: at least four waypoints, since half of the segments are for"
                " identification and half for tests"
            )
        durations = sorted({course.duration for course in self.judging_courses or ()})
        if len(durations) > 1:
            raise ValueError(
                f"judging_courses: their durations differ ({durations[0]:g} s and"
                f" {durations[-1]:g} s); give courses with equal numbers of waypoints and intervals"
            )
        try:
            for plant_name in (self.true, self.later or self.true):
                self.build_loop(plant_name)
            self.course.build(self.loop.step)
            for course in self.judging_courses or ():
                course.build(self.loop.step)
        except ConfigError as error:
            raise ValueError(str(error)) from None
        return self

    def provenance_seed(self) -> int:
        return self.seed

    def build_loop(self, true: str) -> FerrySimulation:
        """Return the closed loop with the given true vessel."""
        return FerrySimulation(
            true, self.believed, self.loop, self.noise, self.disturbance, self.seed
        )

    def export_model(self, request: ExportRequest) -> Path:
        """Write the feed-forward of a model; `selected` has the best judging flights."""
        file: Path = self.call_executor("export_model", request)
        return file

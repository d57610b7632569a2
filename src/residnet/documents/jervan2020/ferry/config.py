"""Config of a ferry study (document 002, chapter 4)."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from residnet.control.guidance.crossing import CrossingConfig
from residnet.control.motion.reference_filter import ReferenceFilterConfig
from residnet.core.errors import ConfigError
from residnet.core.names import nearest
from residnet.documents.jervan2020.ferry.flights import Disturbance, Ferry, LoopConfig, MotionNoise
from residnet.documents.jervan2020.ferry.forward_runs import ForwardRunsConfig
from residnet.documents.jervan2020.published import Published
from residnet.documents.jervan2020.residual_model import ResidualModelConfig
from residnet.judge.still_fits import StillFitsConfig
from residnet.runs.task import ComputingTask

_Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")]

Half = Literal["first", "second"]
"""A half of the course."""


class FerryModelConfig(ResidualModelConfig):
    """One model of the ferry's residual force; with `lag`, its feed-forward is led by the lag.

    Attributes:
        smooth: estimate the motion from all noisy measurements together before the fit
            (`residnet.data.motion_smoother`).
        on: name of the model whose remaining residual this one explains (3.26); empty for the
            believed hull.
        fly: fly the course, and the crossing where there is one, with this model as feed-forward.
        published: figures that the document prints for this model.
    """

    smooth: bool = False
    on: str = ""
    fly: bool = False
    published: Published = Published()


class FerrySettings(ComputingTask):
    """A course with the believed model, residual models identified from it, and the course again.

    Attributes:
        believed: vessel whose hull the controller believes in, by name or file.
        true: vessel that is simulated, by name or file.
        course: waypoints and reference filter; one half of the course identifies, the other tests.
        identify: which half identifies; the document's is the first.
        loop: controller and sampling.
        crossing: an operational crossing that is flown too; null for none.
        noise: noise on what is measured; null for none.
        disturbance: force that is constant in earth axes.
        feed_forward_alone: fly the course without feedback too (Table 4.8).
        forward: manoeuvres of the true ferry beside which the models run forward in time; one that
            diverges there is refused, and its equations are not written.
        models: residual models by name; a model stands after the one that it builds on.
        published: figures that the document prints for the believed model.
        later: vessel that the true one has become later, by name or file; the models that fly are
            judged on its log and identified again where they no longer fit. Null for none.
        check_fit: when a model counts as no longer fitting.
        seed: seed of the noise.
    """

    believed: str = "milliampere"
    true: str = "milliampere_half"
    course: ReferenceFilterConfig
    identify: Half = "first"
    loop: LoopConfig
    crossing: CrossingConfig | None = None
    noise: MotionNoise | None = None
    disturbance: Disturbance = Disturbance()
    feed_forward_alone: bool = False
    forward: ForwardRunsConfig = ForwardRunsConfig()
    models: dict[_Name, FerryModelConfig] = Field(min_length=1)
    published: Published = Published()
    later: str | None = None
    check_fit: StillFitsConfig = StillFitsConfig()
    seed: int = Field(default=0, ge=0)

    @model_validator(mode="after")
    def _combination(self) -> FerrySettings:
        known: list[str] = []
        for name, model in self.models.items():
            if name == "believed":
                raise ValueError("'believed' cannot name a model: it is the controller's own")
            if model.on and model.on not in known:
                raise ValueError(
                    f"models.{name}.on: no model before it is named"
                    f" '{model.on}'{nearest(model.on, known)}"
                )
            if model.on and self.models[model.on].lag != model.lag:
                raise ValueError(
                    f"models.{name}.on: '{model.on}' and it must both be with lag or without"
                )
            known.append(name)
        if len(self.course.waypoints) < 4:
            raise ValueError(
                "course: at least four waypoints; half of them identify, segment by segment, and"
                " half test"
            )
        try:
            self.ferry()
            if self.later is not None:
                self.ferry(self.later)
            self.course.build(self.loop.step)
        except ConfigError as error:
            raise ValueError(str(error)) from None
        return self

    def ferry(self, true: str | None = None) -> Ferry:
        """Return the ferry in its control loop.

        Args:
            true: vessel that is simulated instead of `true` of the config.
        """
        return Ferry.of(
            true or self.true, self.believed, self.loop, self.disturbance, self.noise, self.seed
        )

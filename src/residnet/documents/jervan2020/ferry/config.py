"""What a ferry study is made of (document 002 chapter 4)."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from residnet.control.guidance.crossing import CrossingConfig
from residnet.control.motion.reference_filter import ReferenceFilterConfig
from residnet.core.config import Config
from residnet.core.errors import ConfigError
from residnet.core.names import nearest
from residnet.documents.jervan2020.ferry.flights import Disturbance, Ferry, LoopConfig, MotionNoise
from residnet.documents.jervan2020.residual_model import FerryModelConfig, Published
from residnet.judge.still_fits import StillFitsConfig

_Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")]


class FerrySettings(Config):
    """A course flown with the believed model, models of what it lacks, and the course again with
    them.

    Attributes:
        name: of the run.
        believed: vessel of the controller, by name or file.
        true: vessel that flies.
        course: waypoints; its first half identifies, its second half tests.
        loop: the controller.
        crossing: an operational crossing that is flown too; null for none.
        noise: on what is measured; null for none.
        disturbance: constant in earth axes.
        feed_forward_alone: fly the course without feedback too (Table 4.8).
        models: by name, each after those that it stands on.
        published: the document's figures for the believed model.
        later: a vessel that the true one has become; models that fly are judged on its log and
            identified again where they no longer fit.
        check_fit: when a model no longer fits.
        seed: of the noise.
    """

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")
    description: str = ""
    believed: str = "milliampere"
    true: str = "milliampere_half"
    course: ReferenceFilterConfig
    loop: LoopConfig
    crossing: CrossingConfig | None = None
    noise: MotionNoise | None = None
    disturbance: Disturbance = Disturbance()
    feed_forward_alone: bool = False
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
        """The plant in its loop."""
        return Ferry.of(
            true or self.true, self.believed, self.loop, self.disturbance, self.noise, self.seed
        )

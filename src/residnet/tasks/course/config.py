"""The config of the task `course`: an autopilot, a course past buoys, and guidance laws."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from residnet.control.courses.config import BuoyCourseConfig
from residnet.control.courses.course_check import Protocol
from residnet.control.guidance.line_of_sight import AnyLineOfSight
from residnet.control.observed.config import AnyController
from residnet.core.config import ExistingPath, MetresPerSecond, Seconds
from residnet.dynamics.simulated import check_steps
from residnet.runs.task import ComputingTask
from residnet.tasks.course.flights import CourseSpreadConfig

_Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")]


class CourseSettings(ComputingTask):
    """A course past buoys, the controllers that fly it, and the guidance laws beside the plan.

    Attributes:
        autopilot: folder of a finished autopilot run, or the config of one, which is then carried
            out first, in this run's own folder. Vessel, rudder, policy and tuned peers come from
            there.
        policy: its name there.
        peers: names of tuned peers and of the document's own autopilots there.
        others: further controllers, for example the document's law with another horizon.
        course: start, buoys and how the course is planned.
        protocols: what passing a buoy means: `enter` its circle of acceptance, or leave it on its
            side and outside its circle (`sides`).
        integral: gain in m/s of integral action against a steady current in the guidance along the
            plan; null for none.
        line_of_sight: laws that are also flown without a plan, on straight legs from way-point to
            way-point, as the source did it; for the protocol `enter`.
        legs_change: where they do: in the circle of acceptance, as in the source, or at the
            wheel-over before it.
        spread: of vessels and currents that all fly the course too, beside the nominal vessel in
            water at rest; null for none.
        dt: step of simulation and controllers in s.
        duration: time in s after which a flight that has not ended is given up.
        safe: what the exported policy commands while its inputs are wrong: the last good command,
            or rudder amidships.
    """

    autopilot: ExistingPath
    policy: _Name = "policy"
    peers: tuple[_Name, ...] = ("pid",)
    others: dict[_Name, AnyController] = Field(default_factory=dict)
    course: BuoyCourseConfig
    protocols: tuple[Protocol, ...] = Field(default=("enter", "sides"), min_length=1)
    integral: MetresPerSecond | None = Field(default=None, gt=0)
    line_of_sight: tuple[AnyLineOfSight, ...] = ()
    legs_change: Literal["circle", "wheel_over"] = "circle"
    spread: CourseSpreadConfig | None = None
    dt: Seconds = Field(default=0.02, gt=0)
    duration: Seconds = Field(gt=0)
    safe: Literal["hold", "amidships"] = "amidships"

    @model_validator(mode="after")
    def _laws_differ(self) -> Self:
        kinds = [law.kind for law in self.line_of_sight]
        if len(set(kinds)) < len(kinds):
            raise ValueError(f"line_of_sight: each kind once, given {', '.join(kinds)}")
        check_steps(self.duration, self.dt)
        return self

    def recorded_seed(self) -> int:
        """Return the seed of the random vessels."""
        return self.spread.seed if self.spread else 0

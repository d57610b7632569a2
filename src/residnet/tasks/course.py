"""Task `course`: fly a trained heading policy and its peers along a course past buoys."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from residnet.control.courses.config import BuoyCourseConfig, Protocol
from residnet.control.guidance.line_of_sight import AnyLineOfSight
from residnet.control.heading.controllers import AnyController
from residnet.core.config import Config, ExistingPath, MetresPerSecond, Seconds, dump_config
from residnet.runs.folder import RunFolder
from residnet.tasks.course_flights import CourseSpreadConfig

_Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")]


class CourseTaskConfig(Config):
    """A course past buoys, flown by a policy, by peers of its autopilot run, and by line of sight
    from way-point to way-point.

    Attributes:
        name: of the run.
        threads: of PyTorch.
        autopilot: folder of a finished autopilot run, or the config of one, which is then carried
            out first, in this run's own folder. Vessel, rudder, policy and tuned peers come from
            there.
        policy: its name there.
        peers: names of tuned peers and of the document's own autopilots there.
        others: further controllers, for example the document's law with another horizon.
        course: see there.
        protocols: that are flown.
        integral: gain of integral action against a steady current in the guidance along the plan;
            null for none.
        line_of_sight: laws that are also flown without a plan, on straight legs from way-point to
            way-point, as the source did it; for the protocol `enter`.
        legs_change: where they do: in the circle of acceptance, as in the source, or at the
            wheel-over before it.
        spread: of vessels and currents that all fly the course too, beside the nominal vessel in
            water at rest; null for none.
        dt: step of simulation and controllers.
        duration: after which a flight that has not ended is given up.
        safe: what the exported policy commands while its inputs are wrong: the last good command,
            or rudder amidships.
    """

    task: Literal["course"]
    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")
    description: str = ""
    threads: int = Field(default=1, ge=1)
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
        return self

    def check(self) -> None:
        """The autopilot's run folder or config.

        Raises:
            UsageError: where it is a folder of something else, or of an unfinished run.
            ConfigError: where it is no config of an autopilot, or has no such policy or peer.
        """
        from residnet.tasks.course_run import autopilot_of

        autopilot_of(self)

    def run(
        self, *, source: Path, overrides: Sequence[str], out: Path | None, resume: bool
    ) -> RunFolder:
        """Train where there is no trained policy yet, plan, fly, compare, export.

        Raises:
            UsageError: where the folder exists.
            ConfigError: where no course fits the vessel's turns.
            FitError: where training fails.
        """
        from residnet.tasks.course_run import run_course

        self.check()
        started = time.time()
        folder = RunFolder.create(out or Path("runs") / self.name, dump_config(self), resume=resume)
        run_course(self, folder, resume=resume)
        folder.write_provenance(
            config=source,
            overrides=overrides,
            seed=self.spread.seed if self.spread else 0,
            files=[],
            started=started,
        )
        print(f"report: {folder.report}")
        return folder

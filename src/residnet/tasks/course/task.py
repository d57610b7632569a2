"""Task `course`: fly a trained heading policy and its peers along a course past buoys."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, final

from residnet.report.blocks import Section
from residnet.report.run_reader import RunFiles
from residnet.runs.folder import RunFolder
from residnet.runs.task import Outcome
from residnet.tasks.course.autopilot_run import autopilot_of
from residnet.tasks.course.config import CourseSettings


@final
class CourseTaskConfig(CourseSettings):
    """A course past buoys, flown by a heading policy, its peers and laws of line of sight."""

    task: Literal["course"]

    def check(self) -> None:
        """Check the autopilot's run folder or config, and that the courses can be planned.

        Raises:
            UsageError: where it is a folder of something else, or of an unfinished run.
            ConfigError: where it is no config of an autopilot, or has no such policy or peer, or
                where no course fits the vessel's turns.
        """
        from residnet.tasks.course.planning import check_plans

        check_plans(self, autopilot_of(self))

    def carry_out(self, folder: RunFolder) -> Outcome:
        """Train where there is no trained policy yet, plan, fly and compare.

        Raises:
            ConfigError: where no course fits the vessel's turns.
            FitError: where training fails.
        """
        from residnet.tasks.course.running import run_course

        return run_course(self, folder)

    @classmethod
    def report_sections(cls, run: RunFolder) -> Sequence[Section]:
        """Draw the figures and return the comparison of the flights."""
        from residnet.report.sections.course import draw, sections

        files = RunFiles(run.path)
        draw(files)
        return sections(files)

"""Task `course`: fly a trained heading policy and its peers along a course past buoys."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, Literal, final

from residnet.core.errors import UsageError
from residnet.core.names import nearest
from residnet.report.blocks import Section
from residnet.report.run_reader import RunFiles
from residnet.runs.folder import RunFolder
from residnet.runs.task import Outcome
from residnet.tasks.course.autopilot_run import autopilot_of
from residnet.tasks.course.config import CourseSettings


@final
class CourseTaskConfig(CourseSettings):
    """A course past buoys, flown by a heading policy, its peers and laws of line of sight."""

    verbs: ClassVar[tuple[str, ...]] = ("report", "export")

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

    def export_model(self, run: RunFolder, model: str, out: Path | None, file_format: str) -> Path:
        """Return the file of a policy with the guidance of a course, named after both.

        TorchScript was exported and checked when the run ended; other formats are written now.

        Raises:
            UsageError: where there is no such file, or another format is given.
        """
        names = {f"{self.policy}_{protocol}": protocol for protocol in self.protocols}
        if model not in names:
            raise UsageError(f"{run.path}: no export '{model}'{nearest(model, names)}")
        file = run.exports / f"{model}.pt"
        if not file.is_file():
            raise UsageError(f"{file}: no such file; the run writes it at its end")
        if file_format != "torchscript":
            from residnet.tasks.course.exporting import export_as

            return export_as(file_format, self, run, names[model], file, out)
        if out is None:
            return file
        out.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, out)
        return out

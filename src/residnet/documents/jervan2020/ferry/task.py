"""Task `ferry_study`: residual models of a ferry in closed loop (document 002, chapter 4)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, final

from residnet.core.config import load_config
from residnet.core.files import read_json
from residnet.documents.jervan2020.ferry.config import FerrySettings
from residnet.report.blocks import Section
from residnet.runs.folder import RunFolder
from residnet.runs.task import MainFigure, Outcome


@final
class FerryStudyConfig(FerrySettings):
    """A course with the believed model, residual models identified from it, and the course again.

    Attributes:
        task: `ferry_study`.
    """

    task: Literal["ferry_study"]

    def recorded_seed(self) -> int:
        """Return the seed of the noise."""
        return self.seed

    def carry_out(self, folder: RunFolder) -> Outcome:
        """Fly, identify, fly again, and write ferry.json, equations, feed-forwards and figures.

        Raises:
            ResidnetError: where a model cannot be identified or flown.
        """
        from residnet.documents.jervan2020.ferry.report import main_figures, verdict
        from residnet.documents.jervan2020.ferry.results import write_results
        from residnet.documents.jervan2020.ferry.study import study

        results = write_results(self, study(self), folder)
        figures = {name: MainFigure(*value) for name, value in main_figures(results).items()}
        return Outcome(verdict(results), figures)

    @classmethod
    def report_sections(cls, run: RunFolder) -> Sequence[Section]:
        """Return the sections of the report, from the run folder alone."""
        from residnet.documents.jervan2020.ferry.report import sections
        from residnet.documents.jervan2020.ferry.results import FILE

        config = load_config(run.resolved, [], cls)
        return sections(config, read_json(run.path / FILE), run.path)

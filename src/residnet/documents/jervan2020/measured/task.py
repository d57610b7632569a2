"""Task `force_residual`: residual models of measured forces (document 002, chapter 5)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, final

from residnet.core.config import load_config
from residnet.core.files import read_json
from residnet.documents.jervan2020.measured.config import ForceSettings
from residnet.report.blocks import Section
from residnet.runs.folder import RunFolder
from residnet.runs.task import MainFigure, Outcome


@final
class ForceResidualConfig(ForceSettings):
    """Regressions of the residual force of a believed hull on measured logs, cross-validated.

    Attributes:
        task: `force_residual`.
    """

    task: Literal["force_residual"]

    def check(self) -> None:
        """Check that the logs can be read and hold the folds and segments that are asked for.

        Raises:
            ResidnetError: where they do not.
        """
        from residnet.documents.jervan2020.measured.data import read_measured

        measured = read_measured(self)
        for part in measured.part.unique().tolist():
            measured.split(part, self.validation.gap)

    def input_files(self) -> Sequence[Path]:
        """Return the paths of the logs."""
        return self.data.files()

    def carry_out(self, folder: RunFolder) -> Outcome:
        """Read the logs, fit and judge the models, and write force_residual.json and figures.

        Raises:
            ResidnetError: where a log cannot be used or no model is determined.
        """
        from residnet.documents.jervan2020.measured.report import main_figures, verdict
        from residnet.documents.jervan2020.measured.results import write_results
        from residnet.documents.jervan2020.measured.study import force_study

        results = write_results(self, force_study(self), folder)
        figures = {name: MainFigure(*value) for name, value in main_figures(results).items()}
        return Outcome(verdict(results), figures)

    @classmethod
    def report_sections(cls, run: RunFolder) -> Sequence[Section]:
        """Return the sections of the report, from the run folder alone."""
        from residnet.documents.jervan2020.measured.report import sections
        from residnet.documents.jervan2020.measured.results import FILE

        config = load_config(run.resolved, [], cls)
        return sections(config, read_json(run.path / FILE), run.path)

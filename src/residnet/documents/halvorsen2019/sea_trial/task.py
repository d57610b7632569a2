"""Task `sea_trial`: the standard model of Odin by phase (document 000, section 7.5)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, final

from residnet.core.config import load_config
from residnet.core.files import read_json
from residnet.documents.halvorsen2019.sea_trial.config import SeaTrialSettings
from residnet.report.blocks import Section
from residnet.runs.folder import RunFolder
from residnet.runs.task import MainFigure, Outcome


@final
class SeaTrialTaskConfig(SeaTrialSettings):
    """Models of Odin fitted and judged by phase, on one simulated trial or several.

    Attributes:
        task: `sea_trial`.
    """

    task: Literal["sea_trial"]

    def recorded_seed(self) -> int:
        """Return the seed of the first trial."""
        return next(iter(self.trials.values())).seed

    def carry_out(self, folder: RunFolder) -> Outcome:
        """Simulate the trials, fit and judge the models, and write study.json and figures.

        Raises:
            ResidnetError: where a trial cannot be sailed or a model is not determined.
        """
        from residnet.documents.halvorsen2019.sea_trial.report import main_figures, verdict
        from residnet.documents.halvorsen2019.sea_trial.results import write_results
        from residnet.documents.halvorsen2019.sea_trial.study import study

        results = write_results(self, study(self), folder)
        figures = {name: MainFigure(*value) for name, value in main_figures(results).items()}
        return Outcome(verdict(results), figures)

    @classmethod
    def report_sections(cls, run: RunFolder) -> Sequence[Section]:
        """Return the sections of the report, from the run folder alone."""
        from residnet.documents.halvorsen2019.sea_trial.report import sections
        from residnet.documents.halvorsen2019.sea_trial.results import FILE

        config = load_config(run.resolved, [], cls)
        return sections(config, read_json(run.path / FILE), run.path)

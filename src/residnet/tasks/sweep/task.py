"""Task `sweep`: keys of any config varied by grid, at random or by TPE."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import final

from residnet.core.config import load_config
from residnet.report.blocks import Section
from residnet.report.run_reader import RunFiles
from residnet.report.sections.sweep import draw, sections
from residnet.runs.folder import RunFolder
from residnet.runs.task import Outcome
from residnet.tasks.registry import SweepableConfig
from residnet.tasks.sweep.config import GridSearch, SweepConfig
from residnet.tasks.sweep.journal import require_optuna
from residnet.tasks.sweep.results import write_results
from residnet.tasks.sweep.running import run_trials
from residnet.tasks.sweep.trial import trial_task


@final
class SweepTaskConfig(SweepConfig):
    """Keys of a config varied over a search space; every trial is a run of its own."""

    def check(self) -> None:
        """Check that the base and each value make a valid run, and that all packages are there.

        The ends of a range are tried, each with the first values of the other keys.

        Raises:
            ResidnetError: where one does not, or the objective does not fit the task.
        """
        require_optuna()
        self.runner.check()
        first = {key: values.extremes()[0] for key, values in self.space.items()}
        for key, values in self.space.items():
            for value in values.extremes():
                trial_task(self, {**first, key: value}, f"{self.name}.check")
        task = trial_task(self, first, f"{self.name}.check")
        self.objective.check(task)
        task.check()

    def input_files(self) -> list[Path]:
        """Return the base and the files that it reads."""
        base = load_config(self.base, self.common, SweepableConfig)
        return [self.base, *base.input_files()]

    def recorded_seed(self) -> int:
        """Return the seed of the search."""
        return 0 if isinstance(self.search, GridSearch) else self.search.seed

    def carry_out(self, folder: RunFolder) -> Outcome:
        """Carry out all trials and write what they found; those that are done already are kept.

        Raises:
            ResidnetError: where the system ends a process, or a journal is damaged.
        """
        return write_results(self, run_trials(self, folder), folder)

    @classmethod
    def report_sections(cls, run: RunFolder) -> Sequence[Section]:
        """Draw the figures and return the tables of the trials."""
        files = RunFiles(run.path)
        draw(files)
        return sections(files)

"""Task `fit`: from logs to baselines, heads, a comparison in free run, report and export."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, final

from residnet.report.blocks import Section
from residnet.runs.folder import RunFolder
from residnet.runs.task import Finished, Outcome
from residnet.tasks.fit.config import FitTaskSettings

if TYPE_CHECKING:
    from residnet.tasks.fit.planning import PlannedTrials
    from residnet.tasks.fit.refitting import RefitRun
    from residnet.tasks.fit.watching import WatchedLog


@final
class FitConfig(FitTaskSettings):
    """A complete fit: what is identified, from which logs, and what is made of it."""

    task: Literal["fit"]

    verbs: ClassVar[tuple[str, ...]] = ("report", "evaluate", "export", "monitor", "plan-trial")

    def check(self) -> None:
        """Check that the logs hold what every part of the fit asks for, without fitting.

        Raises:
            ResidnetError: where a file or a channel is missing, a log cannot be read, or manoeuvres
                are too few or too short.
        """
        from residnet.tasks.fit.inputs import check_logs

        check_logs(self)

    def carry_out(self, folder: RunFolder) -> Outcome:
        """Fit all models and judge them in free run.

        Raises:
            ResidnetError: where the logs cannot be used, or do not determine a model.
        """
        from residnet.tasks.fit.running import run_fit

        return run_fit(self, folder)

    @classmethod
    def report_sections(cls, run: RunFolder) -> Sequence[Section]:
        """Draw the figures, those of a published study too, and return the sections."""
        from residnet.core.config import load_mapping
        from residnet.documents import study_sections
        from residnet.report.fit import fit_sections, write_fit_figures
        from residnet.report.run_reader import RunFiles

        files = RunFiles(run.path)
        write_fit_figures(files)
        sections = fit_sections(files)
        study = load_mapping(run.resolved).get("study")
        if study is not None and "test" in files.splits:
            sections += study_sections(study, run.path)
        return sections

    def evaluate_on(self, run: RunFolder, logs: Sequence[Path], out: Path | None) -> Finished:
        """Free-run every model of a finished run on other logs.

        Raises:
            ResidnetError: where a log cannot be used, lacks a channel or is too short.
        """
        from residnet.tasks.fit.external import ExternalLogs

        external = ExternalLogs(self, run, logs)
        folder = external.create_folder(out)
        return self.conduct(folder, external.provenance, external.judge)

    def monitor(
        self,
        run: RunFolder,
        logs: Sequence[Path],
        model: str,
        settings: Mapping[str, Any],
        refit: Path | None,
    ) -> tuple[list[WatchedLog], RefitRun | None]:
        """Watch new logs with a model of a finished fit, and refit it to them where that is asked.

        Args:
            run: the fit.
            logs: new logs, in the order of time.
            model: name of the model; `selected` for the one chosen on validation data.
            settings: of `MonitorConfig`.
            refit: folder of a run for the refitted model; None for no refit.

        Raises:
            UsageError: where there is no such model, or the folder may not be used.
            DataError: where a log cannot be used, or clean logs are too few.
        """
        from residnet.tasks.fit.refitting import refit_run, require_refit
        from residnet.tasks.fit.watching import in_service, watch_logs

        if refit is not None:
            require_refit(run, refit, self)
        service = in_service(self, run, logs, model, settings)
        watched = watch_logs(service)
        return watched, None if refit is None else refit_run(self, run, service, refit)

    def plan_trial(self, run: RunFolder, model: str, limits: Mapping[str, Any]) -> PlannedTrials:
        """Plan the next trials for a refitted baseline of a finished fit.

        Raises:
            UsageError: where the run has no such baseline.
            DataError: where no candidate stays within the limits.
        """
        from residnet.tasks.fit.planning import plan_trials

        return plan_trials(self, run, model, limits)

    def export_model(self, run: RunFolder, model: str, out: Path | None, file_format: str) -> Path:
        """Export one model, `selected` for the one chosen on validation data; returns the file.

        Raises:
            ConfigError: where there is no such format.
            UsageError: where there is no such model.
            ExportError: where the exported model does not agree with the one that it came from.
        """
        from residnet.tasks.fit.exporting import export_model

        return export_model(run, model, out, file_format)

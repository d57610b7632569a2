"""Settings of the task `fit`: the models, their logs, and the outputs of the run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, final

from pydantic import PrivateAttr, field_validator, model_validator

from residnet.core.config import Config
from residnet.evaluation.booklet import BookletConfig
from residnet.identification.settings import FitSettings, check_known_names
from residnet.io.sources import DataConfig, LogsBySplit, list_input_files, read_split_logs
from residnet.manoeuvres.trials_config import SimulatedTrials
from residnet.physics.similarity import DerivativesConfig
from residnet.report.fit_studies import find_fit_study
from residnet.runs.folder import RunFolder
from residnet.runs.task import ComputingTask, ExportRequest, FinishedRun, PackageTask

if TYPE_CHECKING:
    from residnet.report.blocks import Section
    from residnet.tasks.fit.service import MonitoredLog, NextTrials, RefitResult
    from residnet.tasks.scale_settings import ScaleRequest


class ExportConfig(Config):
    """Models that are exported as TorchScript when the run ends.

    Attributes:
        models: names of the models; `predictor` is the model that the report shows first,
            `selected` the single model chosen on validation data.
    """

    models: tuple[str, ...] = ("predictor",)


@final
class FitConfig(FitSettings, PackageTask, ComputingTask):
    """A complete fit: logs, identified models, evaluation in free run, report and exports.

    Attributes:
        study: a published experiment whose figures the report shows too; null for none.
        data: logs and splits.
        booklet: manoeuvring booklet, the standard manoeuvres simulated by one of the refitted
            baselines, with intervals; null for none.
        derivatives: main particulars, for the hydrodynamic derivatives of a baseline; null for
            none.
        export: models that are exported when the run ends.
    """

    task: Literal["fit"]
    study: str | None = None
    data: DataConfig
    booklet: BookletConfig | None = None
    derivatives: DerivativesConfig | None = None
    export: ExportConfig = ExportConfig()

    supported_commands: ClassVar[tuple[str, ...]] = (
        "report",
        "evaluate",
        "export",
        "monitor",
        "plan-trial",
        "scale",
    )
    _checked_logs: LogsBySplit | None = PrivateAttr(None)

    @field_validator("study")
    @classmethod
    def _require_registered_study(cls, study: str | None) -> str | None:
        if study is not None:
            find_fit_study(study)
        return study

    @model_validator(mode="after")
    def _validate_outputs(self) -> FitConfig:
        if self.booklet is not None:
            check_known_names(
                "booklet.model", (self.booklet.model,), self.refit, "refitted baseline"
            )
            self.booklet.steering_input()
        if self.derivatives is not None:
            check_known_names(
                "derivatives.model", (self.derivatives.model,), self.all_baselines, "baseline"
            )
        if self.study is not None:
            study_models = find_fit_study(self.study).models
            missing_models = [name for name in study_models if name not in self.model_names]
            if missing_models:
                raise ValueError(
                    f"study: {self.study} shows the models {', '.join(study_models)};"
                    f" '{missing_models[0]}' is absent; add it, or leave the study out (study=null)"
                )
        valid_names = ("predictor", "selected", *self.model_names)
        check_known_names("export.models", self.export.models, valid_names, "model")
        if isinstance(self.data, SimulatedTrials):
            self.data.assign_splits(self.data.draw_manoeuvres())
            if abs(self.data.step - self.prepare.grid.step) > 1e-9:
                raise ValueError(
                    f"prepare.grid.step ({self.prepare.grid.step:g} s) must equal data.step"
                    f" ({self.data.step:g} s) for simulated trials"
                )
        return self

    def check(self) -> None:
        """Check that the logs contain all that the parts of the fit need, without fitting.

        Raises:
            ResidnetError: if the run would refuse the config or its logs.
        """
        from residnet.tasks.fit.check import check

        check(self)

    def input_files(self) -> list[Path]:
        return list_input_files(self.data)

    def provenance_seed(self) -> int:
        return self.seed

    def load_logs(self) -> LogsBySplit:
        """Return the logs by split; logs that `check` has just read are not read a second time.

        Raises:
            ResidnetError: if a file is missing or its contents cannot be used.
        """
        cached_logs = self._checked_logs
        self._checked_logs = None
        return cached_logs or read_split_logs(self.data)

    def cache_logs(self, logs: LogsBySplit) -> None:
        """Keep logs that a check has read, for the next call of `load_logs`."""
        self._checked_logs = logs

    @classmethod
    def report_sections(cls, run: RunFolder) -> Sequence[Section]:
        from residnet.report.fit import fit_sections, write_fit_figures
        from residnet.report.run_reader import RunFiles

        files = RunFiles(run.path)
        write_fit_figures(files)
        sections = fit_sections(files)
        study = files.resolved_config.get("study")
        if isinstance(study, str) and "test" in files.splits:
            sections += find_fit_study(study).sections(files)
        return sections

    @classmethod
    def add_exports_to_sections(
        cls, run: RunFolder, sections: Sequence[Section]
    ) -> Sequence[Section]:
        from residnet.report.run_reader import RunFiles
        from residnet.report.sections.at_a_glance import facts_section

        facts = facts_section(RunFiles(run.path))
        return [
            facts if facts is not None and section.is_facts else section for section in sections
        ]

    def evaluate_on_logs(
        self,
        run: RunFolder,
        logs: Sequence[Path],
        output_folder: Path | None,
        *,
        resume: bool = False,
        overwrite: bool = False,
    ) -> FinishedRun:
        """Evaluate every model of a finished fit in free run on other logs.

        The reader, masks, protocols and scales of the fit are used.

        Args:
            run: folder of the fit.
            logs: files or folders of logs that the fit has not used.
            output_folder: folder of the results; None for RUN/external-<time>.
            resume: repeat an interrupted evaluation of the same logs in its folder.
            overwrite: replace an earlier evaluation in its folder.

        Raises:
            DataError: if a log cannot be used or is too short.
            UsageError: if a path or a channel is missing, or the folder may not be used.
        """
        finished_run: FinishedRun = self.call_executor(
            "evaluate_on_logs", run, logs, output_folder, resume=resume, overwrite=overwrite
        )
        return finished_run

    def monitor(
        self,
        run: RunFolder,
        logs: Sequence[Path],
        model: str,
        settings: Mapping[str, Any],
        refit_folder: Path | None,
    ) -> tuple[list[MonitoredLog], RefitResult | None]:
        """Test new logs for changes of the vessel, and refit the model to them on request.

        Args:
            run: folder of the fit.
            logs: new logs, in chronological order.
            model: name of the model; `selected` for the model chosen on validation data.
            settings: keys of `MonitorConfig`.
            refit_folder: run folder of the refitted model; None for no refit.

        Raises:
            UsageError: if there is no such model, or the folder may not be used.
            DataError: if a log cannot be used, or the fit has too few reference logs.
        """
        result: tuple[list[MonitoredLog], RefitResult | None] = self.call_executor(
            "monitor_run", run, logs, model, settings, refit_folder
        )
        return result

    def plan_trial(self, run: RunFolder, model: str, trial_limits: Mapping[str, Any]) -> NextTrials:
        """Plan the next trials for a refitted baseline of a finished fit.

        Args:
            run: folder of the fit.
            model: name of the baseline; empty for the baseline of the manoeuvring booklet, else the
                first refitted baseline.
            trial_limits: keys of `TrialLimits`.

        Raises:
            UsageError: if the run has no such refitted baseline, or no input steers.
            DataError: if no candidate trial is within the limits.
        """
        next_trials: NextTrials = self.call_executor("plan_trial", run, model, trial_limits)
        return next_trials

    def scale_run(self, request: ScaleRequest) -> FinishedRun:
        """Write a run whose models and logs are those of a finished fit at another scale.

        Raises:
            UsageError: if a named model cannot be scaled, or the folder may not be used.
            DataError: if the logs of the fit cannot be read.
        """
        finished_run: FinishedRun = self.call_executor("scale_run", request)
        return finished_run

    def export_model(self, request: ExportRequest) -> Path:
        """Export one model of a finished fit; returns the file.

        Raises:
            UsageError: if there is no such model.
            WithheldError: if the model has objections and `request.allows_objections` is False.
            ExportError: if the exported model does not reproduce the fitted one.
        """
        file: Path = self.call_executor("export_model", request)
        return file

"""Task `fit`: from logs to baselines, heads, a comparison in free run, report and export."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, final

from pydantic import PrivateAttr, model_validator

from residnet.core.config import Config
from residnet.data.simulated import SimulatedTrials
from residnet.data.sources import DataConfig, Splits, input_files, read_logs
from residnet.documents import STUDY_MODELS, StudyName
from residnet.identification.settings import FitSettings, require_known
from residnet.judge.booklet import BookletConfig
from residnet.report.blocks import Section
from residnet.runs.folder import RunFolder
from residnet.runs.task import ComputingTask, ExportRequest, Finished, Outcome

if TYPE_CHECKING:
    from residnet.tasks.fit_service import PlannedTrials, RefitRun, WatchedLog


class ExportConfig(Config):
    """Models that are exported as TorchScript when the run ends.

    Attributes:
        models: their names; `predictor` is the one that is reported first, `selected` the single
            one chosen on validation data.
    """

    models: tuple[str, ...] = ("predictor",)


@final
class FitConfig(FitSettings, ComputingTask):
    """A complete fit: what is identified, from which logs, and what is made of it.

    Attributes:
        study: a published experiment whose figures are drawn too; null for none.
        data: logs and splits.
        booklet: standard manoeuvres by one of the refitted baselines, with intervals; null for
            none.
        export: models that are exported when the run ends.
    """

    task: Literal["fit"]
    study: StudyName | None = None
    data: DataConfig
    booklet: BookletConfig | None = None
    export: ExportConfig = ExportConfig()

    verbs: ClassVar[tuple[str, ...]] = ("report", "evaluate", "export", "monitor", "plan-trial")
    _checked: Splits | None = PrivateAttr(None)

    @model_validator(mode="after")
    def _outputs(self) -> FitConfig:
        if self.booklet is not None:
            require_known("booklet.model", (self.booklet.model,), self.refit, "refitted baseline")
            self.booklet.rudder()
        if self.study is not None:
            absent = [m for m in STUDY_MODELS[self.study] if m not in self.model_names]
            if absent:
                raise ValueError(
                    f"study: {self.study} shows the models {', '.join(STUDY_MODELS[self.study])};"
                    f" '{absent[0]}' is absent; give it, or leave the study out (study=null)"
                )
        known = ("predictor", "selected", *self.model_names)
        require_known("export.models", self.export.models, known, "model")
        if isinstance(self.data, SimulatedTrials):
            self.data.splits(self.data.draw())
            if abs(self.data.step - self.prepare.grid.step) > 1e-9:
                raise ValueError(
                    f"prepare.grid.step ({self.prepare.grid.step:g} s) must equal data.step"
                    f" ({self.data.step:g} s) for simulated trials"
                )
        return self

    def input_files(self) -> list[Path]:
        return input_files(self.data)

    def recorded_seed(self) -> int:
        return self.seed

    def logs(self) -> Splits:
        """Return the logs by split; those that a check has just read are not read again.

        Raises:
            ResidnetError: where a file is missing or its contents cannot be used.
        """
        known, self._checked = self._checked, None
        return known or read_logs(self.data)

    def check(self) -> None:
        """Check that the logs hold what every part of the fit asks for, without fitting.

        Measured logs are read. In the place of simulated ones, which take long to fly, stand logs
        of the same channels, lengths and kinds.

        Raises:
            ResidnetError: what the run itself would refuse before it fits anything.
        """
        from residnet.data.simulated import stand_ins
        from residnet.identification.fitter import FittedModel, require_fit
        from residnet.identification.prepared import prepare_logs
        from residnet.tasks.booklet import require_flyable

        settings = self
        if isinstance(self.data, SimulatedTrials):
            logs: Splits = {"train": [], "validation": [], "test": []}
            drawn = self.data.splits(self.data.draw())
            for log, split in zip(stand_ins(self.data), drawn, strict=True):
                logs[split].append(log)
            # what masks leave of a motion is not known before it is flown
            prepare = self.prepare.model_copy(update={"masks": ()})
            settings = self.model_copy(update={"prepare": prepare})
        else:
            self._checked = logs = self.logs()
        fitter = require_fit(prepare_logs(logs, settings), self)
        if self.booklet is not None:
            name = self.booklet.model
            spec = fitter.spec(name, "baseline", self.all_baselines[name])
            require_flyable(self.booklet, FittedModel(spec, spec.build(), {}))

    def carry_out(self, folder: RunFolder) -> Outcome:
        """Fit all models and judge them in free run.

        Raises:
            ResidnetError: where the logs cannot be used, or do not determine a model.
        """
        from residnet.tasks.fit_run import run_fit

        return run_fit(self, folder)

    @classmethod
    def report_sections(cls, run: RunFolder) -> Sequence[Section]:
        from residnet.documents import study_sections
        from residnet.report.fit import fit_sections, write_fit_figures
        from residnet.report.run_reader import RunFiles

        files = RunFiles(run.path)
        write_fit_figures(files)
        sections = fit_sections(files)
        study = files.resolved.get("study")
        if study is not None and "test" in files.splits:
            sections += study_sections(study, run.path)
        return sections

    def evaluate_on(self, run: RunFolder, logs: Sequence[Path], out: Path | None) -> Finished:
        from residnet.tasks.fit_run import evaluate_on

        return evaluate_on(self, run, logs, out)

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
            logs: new logs, in the order of time.
            model: name of the model; `selected` for the one chosen on validation data.
            settings: of `MonitorConfig`.
            refit: folder of a run for the refitted model; None for no refit.

        Raises:
            UsageError: where there is no such model, or the folder may not be used.
            DataError: where a log cannot be used, or clean logs are too few.
        """
        from residnet.tasks.fit_service import Service, refit_run, require_refit

        if refit is not None:
            require_refit(run, refit, self)
        service = Service(self, run, logs, model, settings)
        return service.watched(), None if refit is None else refit_run(service, refit)

    def plan_trial(self, run: RunFolder, model: str, limits: Mapping[str, Any]) -> PlannedTrials:
        """Plan the next trials for a refitted baseline of a finished fit.

        Args:
            model: name of the baseline; empty for the booklet's, else the first that was refitted.
            limits: of `TrialLimits`.

        Raises:
            UsageError: where the run has no such refitted baseline, or no input steers.
            DataError: where no candidate stays within the limits.
        """
        from residnet.tasks.fit_service import plan_trials

        return plan_trials(self, run, model, limits)

    def export_model(self, asked: ExportRequest) -> Path:
        from residnet.tasks.fit_run import export_model

        return export_model(asked)

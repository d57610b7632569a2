"""Task `fit`: from logs to baselines, heads, a comparison in free run, report and export."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, final

from pydantic import PrivateAttr, model_validator

from residnet.core.config import Config, dump_config
from residnet.core.errors import DataError, UsageError
from residnet.core.names import suggest_name
from residnet.core.progress import begin_stage, log_message
from residnet.dynamics.store import load_model, model_names
from residnet.evaluation.band import bands_content
from residnet.evaluation.booklet import BookletConfig
from residnet.evaluation.goodness import build_goodness_content
from residnet.evaluation.soundness import build_sanity_content
from residnet.evaluation.verdict import list_model_objections
from residnet.evaluation.verdict import rate_model as verdict_level
from residnet.evaluation.verdict import write_verdict as verdict_sentences
from residnet.export.vessel import ExportedVessel
from residnet.identification.fit import fit_models
from residnet.identification.fitter import FittedModel, check_fit
from residnet.identification.identified import (
    build_goodness_rows,
    build_residual_table,
    build_term_table,
    evaluate_splits,
    make_candidates,
)
from residnet.identification.prepared import (
    check_window_fits,
    convert_to_motion_through_water,
    prepare_splits,
)
from residnet.identification.settings import FitSettings, check_known_names
from residnet.io.sources import DataConfig, LogsBySplit, list_input_files, read_split_logs
from residnet.manoeuvres.trials import SimulatedTrials, make_dummy_logs
from residnet.report.blocks import Section
from residnet.report.run_reader import RunFiles
from residnet.report.sections.verdict import collect_evidence
from residnet.runs.folder import Provenance, RunFolder, require_apart
from residnet.runs.model_store import RunModelStore
from residnet.runs.task import ComputingTask, ExportRequest, FinishedRun, TaskOutcome
from residnet.studies import STUDY_MODELS, StudyName, build_study_sections
from residnet.tasks.booklet import require_flyable, write_booklet
from residnet.tasks.fit_outcome import (
    EXTERNAL_SPLIT,
    build_fit_outcome,
    divergence_limit,
    read_external_logs,
    write_evaluation,
    write_inspection,
)

if TYPE_CHECKING:
    from residnet.tasks.fit_service import MonitoredLog, NextTrials, RefitResult

_MODEL_ALIASES = ("predictor", "selected")
"""What stands for a model's name: the one reported first, and the single one chosen."""


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

    supported_commands: ClassVar[tuple[str, ...]] = (
        "report",
        "evaluate",
        "export",
        "monitor",
        "plan-trial",
    )
    _checked_logs: LogsBySplit | None = PrivateAttr(None)

    @model_validator(mode="after")
    def _validate_outputs(self) -> FitConfig:
        if self.booklet is not None:
            check_known_names(
                "booklet.model", (self.booklet.model,), self.refit, "refitted baseline"
            )
            self.booklet.steering_input()
        if self.study is not None:
            missing_models = [m for m in STUDY_MODELS[self.study] if m not in self.model_names]
            if missing_models:
                raise ValueError(
                    f"study: {self.study} shows the models {', '.join(STUDY_MODELS[self.study])};"
                    f" '{missing_models[0]}' is absent; give it, or leave the study out (study=null)"
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

    def input_files(self) -> list[Path]:
        return list_input_files(self.data)

    def provenance_seed(self) -> int:
        return self.seed

    def load_logs(self) -> LogsBySplit:
        """Return the logs by split; those that a check has just read are not read again.

        Raises:
            ResidnetError: where a file is missing or its contents cannot be used.
        """
        cached_logs, self._checked_logs = self._checked_logs, None
        return cached_logs or read_split_logs(self.data)

    def check(self) -> None:
        """Check that the logs hold what every part of the fit asks for, without fitting.

        Measured logs are read. In the place of simulated ones, which take long to fly, stand logs
        of the same channels, lengths and kinds.

        Raises:
            ResidnetError: what the run itself would refuse before it fits anything.
        """
        settings = self
        if isinstance(self.data, SimulatedTrials):
            logs: LogsBySplit = {"train": [], "validation": [], "test": []}
            split_names = self.data.assign_splits(self.data.draw_manoeuvres())
            for log, split in zip(make_dummy_logs(self.data), split_names, strict=True):
                logs[split].append(log)
            # what masks leave of a motion is not known before it is flown
            prepare = self.prepare.model_copy(update={"masks": ()})
            settings = self.model_copy(update={"prepare": prepare})
        else:
            self._checked_logs = logs = self.load_logs()
        fitter = check_fit(prepare_splits(logs, settings), self)
        if self.booklet is not None:
            name = self.booklet.model
            spec = fitter.build_spec(name, "baseline", self.all_baselines[name])
            require_flyable(self.booklet, FittedModel(spec, spec.build(), {}))

    def execute(self, folder: RunFolder) -> TaskOutcome:
        """Fit all models, judge them in free run, and write what was found.

        Logs that ran in currents are taken through the water.

        Raises:
            ResidnetError: where the logs cannot be used, or do not determine a model.
        """
        begin_stage(f"{self.name}: reading logs")
        raw_logs = self.load_logs()
        write_inspection(folder, raw_logs, self)
        logs = prepare_splits(raw_logs, self)
        log_message(
            "  " + ", ".join(f"{split} {len(members)} logs" for split, members in logs.items())
        )
        logs, currents = convert_to_motion_through_water(logs, self)
        if self.current is not None:
            folder.write_json(folder.path / "currents.json", currents)
        identified_models = fit_models(logs, self, store=RunModelStore(folder))
        begin_stage("free runs")
        fitted_models, time_step = list(identified_models.values()), self.prepare.grid.step
        if self.bands is not None:
            bands = {entry.name: entry.bands for entry in fitted_models}
            folder.write_json(folder.bands, bands_content(self.name, bands))
        evaluation_logs = {str(split): logs[split] for split in self.evaluation.splits}
        evaluations = identified_models.evaluate(evaluation_logs, self.data)
        selection = identified_models.select_models(evaluations)
        predictor_text = (
            ""
            if selection.default_ensemble is None
            else f"; predictor: {selection.default_ensemble}"
        )
        log_message(f"  selected: {selection.selected}{predictor_text}")
        folder.write_json(folder.selection, selection.to_json())
        folder.write_json(folder.sanity, build_sanity_content(identified_models.sanity_findings))
        names = (selection.selected, selection.selected_ensemble, selection.default_model)
        write_evaluation(folder, self, evaluations, names, logs)
        for table_path, result_table in {
            folder.residuals: build_residual_table(fitted_models, logs["test"]),
            folder.path / "terms.parquet": build_term_table(fitted_models, logs["test"]),
        }.items():
            if len(result_table):
                folder.write_table(table_path, result_table)
        goodness_by_split = build_goodness_rows(fitted_models, logs, time_step)
        folder.write_json(
            folder.goodness, build_goodness_content(self.name, goodness_by_split, time_step)
        )
        failure = ""
        if self.booklet is not None:
            refitted = identified_models[self.booklet.model]
            try:
                log_message(
                    "  "
                    + write_booklet(
                        folder, self.booklet, refitted, logs, identified_models.velocity_limits
                    )
                )
            except DataError as error:
                # the fit itself is done, and its report is worth having
                failure = str(error)
        exports = {
            name: partial(self.export_model, ExportRequest(folder, name))
            for name in self.export.models
        }
        return build_fit_outcome(folder, "test", exports, failure)

    @classmethod
    def report_sections(cls, run: RunFolder) -> Sequence[Section]:
        from residnet.report.fit import fit_sections, write_fit_figures

        files = RunFiles(run.path)
        write_fit_figures(files)
        sections = fit_sections(files)
        study = files.resolved_config.get("study")
        if study is not None and "test" in files.splits:
            sections += build_study_sections(study, run.path)
        return sections

    def evaluate_on_logs(
        self,
        run: RunFolder,
        logs: Sequence[Path],
        output_folder: Path | None,
        *,
        resume: bool = False,
        overwrite: bool = False,
    ) -> FinishedRun:
        """Free-run every model of a fit on logs that it has never seen.

        Its reader, masks, protocols and scales are used; `zero` comes first, then the config's
        order.

        Args:
            output_folder: folder of the results; RUN/external-<time> where none is given.
            resume: carry out an interrupted evaluation of the same logs again in its folder.
            overwrite: replace an earlier evaluation in its folder.

        Raises:
            DataError: where a log cannot be used or is too short.
            UsageError: where a path or a channel is missing, or the folder may not be used.
        """
        folder_path = output_folder or run.path / time.strftime("external-%Y%m%dT%H%M%S")
        resolved = dump_config(self)
        # before the logs are read, which may take long
        require_apart(folder_path, [run.resolved_config])
        RunFolder(folder_path).require_usable(resolved, resume=resume, overwrite=overwrite)
        input_paths, raw_logs, prepared = read_external_logs(self, logs)
        for log in prepared:
            check_window_fits(log, self)
        provenance = Provenance(run.resolved_config, (), self.seed, input_paths, time.time())
        if resume:
            provenance.require_same_inputs(RunFolder(folder_path))
        if overwrite:
            require_apart(folder_path, input_paths)

        def evaluate_models(folder: RunFolder) -> TaskOutcome:
            store, model_order = RunModelStore(run), ["zero", *self.model_names]
            fitted_models = [store.load(name) for name in store.names()]
            fitted_models.sort(key=lambda model: (*model_order, model.name).index(model.name))
            log_message(f"{self.name}: {len(prepared)} logs, {len(fitted_models)} models")
            write_inspection(folder, {EXTERNAL_SPLIT: raw_logs}, self)
            is_simulated = isinstance(self.data, SimulatedTrials) and all(
                "vessel" in log.meta for log in raw_logs
            )
            models = [
                candidate
                for candidate in make_candidates(fitted_models, self.data)
                if candidate.model_kind != "truth" or is_simulated
            ]
            limit = divergence_limit(fitted_models[0].spec, self)
            evaluations = evaluate_splits(
                models, {EXTERNAL_SPLIT: prepared}, self.evaluation, self.prepare.grid.step, limit
            )
            # bands, and why the model was selected, are the fit's own; the report shows them
            for source_path, target_path in (
                (run.bands, folder.bands),
                (run.selection, folder.selection),
            ):
                if source_path.is_file():
                    folder.write(target_path, source_path.read_text(encoding="utf-8"))
            fit_metrics = run.read_metrics()
            selected = str(fit_metrics["selected"])
            predictor = str(fit_metrics.get("predictor", selected))
            names = (selected, fit_metrics.get("selected_ensemble"), predictor)
            write_evaluation(folder, self, evaluations, names, {EXTERNAL_SPLIT: prepared})
            return build_fit_outcome(folder, EXTERNAL_SPLIT)

        with RunFolder(folder_path).lock():
            folder = RunFolder.create(folder_path, resolved, resume=resume, overwrite=overwrite)
            return self.run_in_folder(folder, provenance, evaluate_models)

    def monitor(
        self,
        run: RunFolder,
        logs: Sequence[Path],
        model: str,
        settings: Mapping[str, Any],
        refit_folder: Path | None,
    ) -> tuple[list[MonitoredLog], RefitResult | None]:
        """Watch new logs with a model of a finished fit, and refit it to them where that is asked.

        Args:
            logs: new logs, in the order of time.
            model: name of the model; `selected` for the one chosen on validation data.
            settings: of `MonitorConfig`.
            refit_folder: folder of a run for the refitted model; None for no refit.

        Raises:
            UsageError: where there is no such model, or the folder may not be used.
            DataError: where a log cannot be used, or clean logs are too few.
        """
        from residnet.tasks.fit_service import FittedModelService, require_refit_folder, run_refit

        if refit_folder is not None:
            require_refit_folder(run, refit_folder, self)
        service = FittedModelService(self, run, logs, model, settings)
        return service.monitor_logs(), None if refit_folder is None else run_refit(
            service, refit_folder
        )

    def plan_trial(self, run: RunFolder, model: str, trial_limits: Mapping[str, Any]) -> NextTrials:
        """Plan the next trials for a refitted baseline of a finished fit.

        Args:
            model: name of the baseline; empty for the booklet's, else the first that was refitted.
            trial_limits: of `TrialLimits`.

        Raises:
            UsageError: where the run has no such refitted baseline, or no input steers.
            DataError: where no candidate stays within the limits.
        """
        from residnet.tasks.fit_service import plan_next_trials

        return plan_next_trials(self, run, model, trial_limits)

    def export_model(self, request: ExportRequest) -> Path:
        """Export one model of a fit, and return the file.

        `predictor` stands for the one that is reported first, `selected` for the single one chosen
        on validation data.

        Raises:
            UsageError: where there is no such model.
            WithheldError: where it is worse than doing without it, but for `asked.anyway`.
            ExportError: where the exported model does not agree with the one that it came from.
        """
        run, name, metrics = request.run, request.model, request.run.read_metrics()
        model_name = str(metrics.get(name, metrics["selected"])) if name in _MODEL_ALIASES else name
        available_models = model_names(run.models)
        if model_name not in available_models:
            raise UsageError(
                f"{run.path}: no model '{name}'{suggest_name(name, [*_MODEL_ALIASES, *available_models])}"
            )
        spec, model = load_model(run.models / model_name)
        rows = [
            row
            for row in metrics["rows"]
            if row["model"] == model_name and row["manoeuvre"] == "all"
        ]
        found = collect_evidence(RunFiles(run.path), model_name)
        # a model without free runs on the split that counts has no verdict
        sentences = verdict_sentences(found) if model_name in found.rows_by_model else []
        judged = (verdict_level(found), sentences)
        return request.write(
            ExportedVessel(spec, model, rows), list_model_objections(found), model_name, judged
        )

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
from residnet.core.names import nearest
from residnet.core.progress import begin, say
from residnet.data.simulated import SimulatedTrials, stand_ins
from residnet.data.sources import DataConfig, Splits, input_files, read_logs
from residnet.documents import STUDY_MODELS, StudyName, study_sections
from residnet.dynamics.store import load_model, model_names
from residnet.export.vessel import ExportedVessel
from residnet.identification.fit import fit
from residnet.identification.fitter import FittedModel, require_fit
from residnet.identification.identified import (
    candidates,
    evaluate,
    goodness_rows,
    residual_table,
    term_table,
)
from residnet.identification.prepared import (
    prepare_logs,
    require_window,
    through_currents,
)
from residnet.identification.settings import FitSettings, require_known
from residnet.judge.band import bands_content
from residnet.judge.booklet import BookletConfig
from residnet.judge.goodness import content
from residnet.judge.soundness import sanity_content
from residnet.judge.verdict import level as verdict_level
from residnet.judge.verdict import objections
from residnet.judge.verdict import verdict as verdict_sentences
from residnet.report.blocks import Section
from residnet.report.run_reader import RunFiles
from residnet.report.sections.verdict import evidence
from residnet.runs.folder import Provenance, RunFolder, require_apart
from residnet.runs.model_store import FolderStore
from residnet.runs.task import ComputingTask, ExportRequest, Finished, Outcome
from residnet.tasks.booklet import require_flyable, write_booklet
from residnet.tasks.fit_outcome import (
    SPLIT,
    external_logs,
    fit_outcome,
    limit_of,
    write_inspection,
    write_judged,
)

if TYPE_CHECKING:
    from residnet.tasks.fit_service import PlannedTrials, RefitRun, WatchedLog

_CHOSEN = ("predictor", "selected")
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
        """Fit all models, judge them in free run, and write what was found.

        Logs that ran in currents are taken through the water.

        Raises:
            ResidnetError: where the logs cannot be used, or do not determine a model.
        """
        begin(f"{self.name}: reading logs")
        read = self.logs()
        write_inspection(folder, read, self)
        logs = prepare_logs(read, self)
        say("  " + ", ".join(f"{split} {len(members)} logs" for split, members in logs.items()))
        logs, currents = through_currents(logs, self)
        if self.current is not None:
            folder.write_json(folder.path / "currents.json", currents)
        identified = fit(logs, self, store=FolderStore(folder))
        begin("free runs")
        fitted, step = list(identified.values()), self.prepare.grid.step
        if self.bands is not None:
            bands = {entry.name: entry.bands for entry in fitted}
            folder.write_json(folder.bands, bands_content(self.name, bands))
        held = {str(split): logs[split] for split in self.evaluation.splits}
        judged = identified.evaluate(held, self.data)
        chosen = identified.select(judged)
        told = "" if chosen.leading is None else f"; predictor: {chosen.leading}"
        say(f"  selected: {chosen.selected}{told}")
        folder.write_json(folder.selection, chosen.content())
        folder.write_json(folder.sanity, sanity_content(identified.findings))
        names = (chosen.selected, chosen.selected_ensemble, chosen.predictor)
        write_judged(folder, self, judged, names, logs)
        for place, found in {
            folder.residuals: residual_table(fitted, logs["test"]),
            folder.path / "terms.parquet": term_table(fitted, logs["test"]),
        }.items():
            if len(found):
                folder.write_table(place, found)
        splits = goodness_rows(fitted, logs, step)
        folder.write_json(folder.goodness, content(self.name, splits, step))
        failure = ""
        if self.booklet is not None:
            refitted = identified[self.booklet.model]
            try:
                say("  " + write_booklet(folder, self.booklet, refitted, logs, identified.limit))
            except DataError as error:
                # the fit itself is done, and its report is worth having
                failure = str(error)
        exports = {
            name: partial(self.export_model, ExportRequest(folder, name))
            for name in self.export.models
        }
        return fit_outcome(folder, "test", exports, failure)

    @classmethod
    def report_sections(cls, run: RunFolder) -> Sequence[Section]:
        from residnet.report.fit import fit_sections, write_fit_figures

        files = RunFiles(run.path)
        write_fit_figures(files)
        sections = fit_sections(files)
        study = files.resolved.get("study")
        if study is not None and "test" in files.splits:
            sections += study_sections(study, run.path)
        return sections

    def evaluate_on(
        self,
        run: RunFolder,
        logs: Sequence[Path],
        out: Path | None,
        *,
        resume: bool = False,
        overwrite: bool = False,
    ) -> Finished:
        """Free-run every model of a fit on logs that it has never seen.

        Its reader, masks, protocols and scales are used; `zero` comes first, then the config's
        order.

        Args:
            out: folder of the results; RUN/external-<time> where none is given.
            resume: carry out an interrupted evaluation of the same logs again in its folder.
            overwrite: replace an earlier evaluation in its folder.

        Raises:
            DataError: where a log cannot be used or is too short.
            UsageError: where a path or a channel is missing, or the folder may not be used.
        """
        place = out or run.path / time.strftime("external-%Y%m%dT%H%M%S")
        resolved = dump_config(self)
        # before the logs are read, which may take long
        require_apart(place, [run.resolved])
        RunFolder(place).require(resolved, resume=resume, overwrite=overwrite)
        files, read, prepared = external_logs(self, logs)
        for log in prepared:
            require_window(log, self)
        made_from = Provenance(run.resolved, (), self.seed, files, time.time())
        if resume:
            made_from.require_same_inputs(RunFolder(place))
        if overwrite:
            require_apart(place, files)

        def judge(folder: RunFolder) -> Outcome:
            store, order = FolderStore(run), ["zero", *self.model_names]
            fitted = [store.load(name) for name in store.names()]
            fitted.sort(key=lambda model: (*order, model.name).index(model.name))
            say(f"{self.name}: {len(prepared)} logs, {len(fitted)} models")
            write_inspection(folder, {SPLIT: read}, self)
            simulated = isinstance(self.data, SimulatedTrials) and all(
                "vessel" in log.meta for log in read
            )
            models = [c for c in candidates(fitted, self.data) if c.kind != "truth" or simulated]
            limit = limit_of(fitted[0].spec, self)
            judged = evaluate(
                models, {SPLIT: prepared}, self.evaluation, self.prepare.grid.step, limit
            )
            # bands, and why the model was selected, are the fit's own; the report shows them
            for own, copy in ((run.bands, folder.bands), (run.selection, folder.selection)):
                if own.is_file():
                    folder.write(copy, own.read_text(encoding="utf-8"))
            chosen = run.read_metrics()
            selected = str(chosen["selected"])
            predictor = str(chosen.get("predictor", selected))
            names = (selected, chosen.get("selected_ensemble"), predictor)
            write_judged(folder, self, judged, names, {SPLIT: prepared})
            return fit_outcome(folder, SPLIT)

        with RunFolder(place).held():
            folder = RunFolder.create(place, resolved, resume=resume, overwrite=overwrite)
            return self.conduct(folder, made_from, judge)

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
        """Export one model of a fit, and return the file.

        `predictor` stands for the one that is reported first, `selected` for the single one chosen
        on validation data.

        Raises:
            UsageError: where there is no such model.
            WithheldError: where it is worse than doing without it, but for `asked.anyway`.
            ExportError: where the exported model does not agree with the one that it came from.
        """
        run, name, metrics = asked.run, asked.model, asked.run.read_metrics()
        chosen = str(metrics.get(name, metrics["selected"])) if name in _CHOSEN else name
        known = model_names(run.models)
        if chosen not in known:
            raise UsageError(f"{run.path}: no model '{name}'{nearest(name, [*_CHOSEN, *known])}")
        spec, model = load_model(run.models / chosen)
        rows = [
            row for row in metrics["rows"] if row["model"] == chosen and row["manoeuvre"] == "all"
        ]
        found = evidence(RunFiles(run.path), chosen)
        # a model without free runs on the split that counts has no verdict
        sentences = verdict_sentences(found) if chosen in found.rows else []
        judged = (verdict_level(found), sentences)
        return asked.write(ExportedVessel(spec, model, rows), objections(found), chosen, judged)

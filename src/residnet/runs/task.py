"""Base classes of tasks: settings, the order of work in a run folder, and commands."""

from __future__ import annotations

import importlib
import math
import re
import time
from abc import abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple, final

from pydantic import Field

from residnet.core.config import Config, dump_config, load_mapping
from residnet.core.errors import DataError, ExportError, ResidnetError, UsageError, WithheldError
from residnet.core.files import stage_files
from residnet.core.names import suggest_name
from residnet.core.processes import retain_freed_memory
from residnet.core.registry import find_part_packages, iterate_configs
from residnet.core.run_records import ExportRow, ExportsFile, MainFigure
from residnet.physics.environment_config import ForceRaoConfig
from residnet.runs.folder import Provenance, RunFolder, require_apart, write_checksums

if TYPE_CHECKING:
    from residnet.export.base import Exportable
    from residnet.report.blocks import Section
    from residnet.report.browser import InteractiveFigures

PartName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")]
"""Name of a part of a run: a model, a controller or a variant."""
ExportWriters = Mapping[str, Callable[[], Path]]
"""Functions that write an export and return its file, by the name of the model."""


class ExportRequest(NamedTuple):
    """A request to export one model of a finished run.

    Attributes:
        run: the finished run.
        model: name of the model; `predictor` is the model that the run reports first, `selected`
            the single model chosen on validation data.
        output_path: file to write. If None, it is exports/<model> with the suffix of the format;
            for C formats exports/<run> for the predictor and exports/<run>_<model> otherwise.
        file_format: one of `residnet list formats`.
        allows_objections: whether a model that is worse than its reference is exported as well.
    """

    run: RunFolder
    model: str
    output_path: Path | None = None
    file_format: str = "torchscript"
    allows_objections: bool = False

    def write(
        self,
        exported: Exportable,
        objections: Sequence[str] = (),
        stem: str = "",
        model_verdict: tuple[str, Sequence[str]] | None = None,
    ) -> Path:
        """Write the export file; returns its path.

        Args:
            exported: the model, policy or force model to export.
            objections: reasons not to use the model; the model card lists them.
            stem: file name without suffix if the request names none; empty for the model's name.
            model_verdict: level and sentences of the verdict on this model; None for the verdict
                of the run.

        Raises:
            ConfigError: if there is no such format.
            WithheldError: if there are objections and `allows_objections` is False.
            ExportError: if the file does not reproduce the model.
        """
        from residnet.export import get_exporter
        from residnet.export.base import require_releasable
        from residnet.report.run_reader import RunFiles

        export_format = get_exporter(self.file_format)
        name = stem or exported.name
        if export_format.default_name_from_run:
            # the file name becomes part of all C symbols: models of two runs must not collide
            run = re.sub(r"\W", "_", self.run.path.resolve().name, flags=re.ASCII)
            name = run if self.model == "predictor" else f"{run}_{name}"
        base_path = self.output_path or self.run.exported_models / f"{name}{export_format.suffix}"
        file = (
            base_path
            if base_path.suffix
            else base_path.with_name(base_path.name + export_format.suffix)
        )
        exported = require_releasable(
            exported, objections, allows_objections=self.allows_objections
        )
        exported.assessment = RunFiles(self.run.path).assessment(model_verdict)
        with stage_files(file, file.parent.glob("*.masses.yaml")) as staged:
            export_format.export(exported, staged)
        return file

    def resolve_model_name(self, names: Collection[str]) -> str:
        """Return the name of the requested model.

        `predictor` and `selected` resolve to the only name if there is just one.

        Args:
            names: names of all models of the run.

        Raises:
            UsageError: if there is no model of that name.
        """
        if self.model in ("predictor", "selected") and len(names) == 1:
            return next(iter(names))
        if self.model not in names:
            suggestion = (
                suggest_name(self.model, names) or f"; give one with --model: {', '.join(names)}"
            )
            raise UsageError(f"{self.run.path}: no model '{self.model}' to export{suggestion}")
        return self.model


class SummaryMetric(NamedTuple):
    """A main figure of a run, in SI units.

    Attributes:
        value: the number.
        unit: unit of the value; `-` for a dimensionless number.
    """

    value: float
    unit: str = "-"

    def to_record(self) -> MainFigure:
        """Return the entry of summary.json; a value that is not finite becomes null."""
        value = float(self.value)
        return MainFigure(value=value if math.isfinite(value) else None, unit=self.unit)


@dataclass(frozen=True)
class TaskOutcome:
    """Summary of the results of a run.

    Attributes:
        verdict: complete sentences for a reader who reads nothing else.
        summary_metrics: main figures by name.
        table: text for the terminal; empty for none.
        failure: message if a result failed a check; the run is complete and ends with a
            `DataError` of this message. Empty if all checks passed.
        level: level of the verdict, one of `residnet.evaluation.verdict.LEVELS`; empty without a
            verdict.
        exports: functions that write each model for controllers, by its name; they are called
            after the report is written. If one fails, the complete run ends with an `ExportError`;
            a withheld model is only reported.
    """

    verdict: Sequence[str] = ()
    summary_metrics: Mapping[str, SummaryMetric] = field(default_factory=dict)
    table: str = ""
    failure: str = ""
    exports: ExportWriters = field(default_factory=dict)
    level: str = ""


@dataclass(frozen=True)
class FinishedRun:
    """A completed run.

    Attributes:
        folder: the run folder.
        outcome: summary of the results.
        exports: exported files for controllers.
    """

    folder: RunFolder
    outcome: TaskOutcome
    exports: Sequence[Path] = ()


class Task(Config):
    """Settings of a run and the methods that check, carry out and report it.

    A subclass adds the field `task` of type `Literal["its_name"]` and its own keys, and implements
    `execute` and the sections of the report.

    Attributes:
        task: name of the task.
        name: name of the run; its folder is runs/<name> unless another one is chosen.
        description: a sentence for the head of the report.
    """

    task: str
    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")
    description: str = ""

    supported_commands: ClassVar[tuple[str, ...]] = ("report",)
    """Commands that a finished run supports; each but `report` is a method of the task."""

    @abstractmethod
    def execute(self, folder: RunFolder) -> TaskOutcome:
        """Carry the task out and write its results into the run folder.

        Results of an interrupted run in the folder may be reused.

        Raises:
            ResidnetError: if the input does not allow it.
        """

    section_module: ClassVar[str]
    """Full name of the module whose `sections` build the report's page."""

    @classmethod
    def report_sections(cls, run: RunFolder) -> Sequence[Section]:
        """Draw the figures of a finished run and return the sections of its report.

        Only the run folder is read. The caller adds verdict, provenance and configuration.
        """
        from residnet.report.run_reader import RunFiles

        module = importlib.import_module(cls.section_module)
        sections: Sequence[Section] = module.sections(RunFiles(run.path))
        return sections

    def check(self) -> None:
        """Check files, models and packages, which the validation of the config does not read.

        Raises:
            ResidnetError: if a file, a model or a package is missing or does not fit.
        """

    def input_files(self) -> Sequence[Path]:
        """Return the files whose contents determine the results."""
        return ()

    @final
    def recorded_files(self) -> list[Path]:
        """Return the files whose checksums the provenance records: inputs and tables of waves."""
        tables = [part.file for part in iterate_configs(self) if isinstance(part, ForceRaoConfig)]
        return [*self.input_files(), *dict.fromkeys(tables)]

    def provenance_seed(self) -> int:
        """Return the seed of all random numbers, for provenance.json; 0 if the task draws none."""
        return 0

    @final
    def run(
        self,
        *,
        source: Path | None = None,
        overrides: Sequence[str] = (),
        output_folder: Path | None = None,
        resume: bool = False,
        overwrite: bool = False,
        report: bool = True,
        on_open: Callable[[Path], None] | None = None,
    ) -> FinishedRun:
        """Check the task, carry it out in a run folder, and mark the run as finished.

        Args:
            source: file of the config; None for a config made in Python.
            overrides: `key=value` overrides of the config, for the provenance.
            output_folder: run folder; None for runs/<name>.
            resume: continue an interrupted run in its folder.
            overwrite: replace an earlier run in its folder.
            report: write report and exports; if False, the run ends after its results.
            on_open: called with the run folder after it is created.

        Raises:
            ResidnetError: if the input does not allow it, or a result fails a check.
        """
        folder_path = self.resolve_folder(output_folder)
        resolved_yaml = dump_config(self)
        # refuse an unusable folder before the check, which may read large files
        RunFolder(folder_path).require_usable(resolved_yaml, resume=resume, overwrite=overwrite)
        self.check()
        provenance = Provenance(
            source, overrides, self.provenance_seed(), self.recorded_files(), time.time()
        )
        if resume:
            provenance.require_same_inputs(RunFolder(folder_path))
        if overwrite:
            require_apart(
                folder_path,
                provenance.input_paths if source is None else [source, *provenance.input_paths],
            )
        with RunFolder(folder_path).lock():
            folder = RunFolder.create(
                folder_path, resolved_yaml, resume=resume, overwrite=overwrite
            )
            if on_open is not None:
                on_open(folder.path)
            return self.run_in_folder(folder, provenance, self.execute, report=report)

    @final
    def resolve_folder(self, output_folder: Path | None) -> Path:
        """Return the requested run folder, or runs/<name> if none was requested."""
        return output_folder or Path("runs") / self.name

    @final
    def run_in_folder(
        self,
        folder: RunFolder,
        provenance: Provenance,
        work: Callable[[RunFolder], TaskOutcome],
        *,
        report: bool = True,
    ) -> FinishedRun:
        """Write provenance, results, report, exports and the finished mark, in this order.

        The report is written before the exports, and a second time with their outcome.

        Args:
            folder: the run folder.
            provenance: source, overrides, seed and inputs of the run.
            work: computes the results and writes them into the folder.
            report: write report and exports.

        Raises:
            ResidnetError: if the work fails, or its outcome fails a check.
            ExportError: if the run is complete, but a model could not be exported.
        """

        part_packages = find_part_packages(self)
        provenance.write(folder, part_packages)
        # exports of an earlier run in this folder must not appear in the new report
        folder.manifest.remove_if_owned(folder.exports)
        with self.reserve_resources():
            outcome = work(folder)
            write_summary = partial(
                folder.write_summary,
                self.task,
                figures={
                    name: figure.to_record() for name, figure in outcome.summary_metrics.items()
                },
                level=outcome.level,
            )
            write_summary(outcome.verdict, is_finished=False)
            # final version: the report shows it and must be reproducible
            provenance.write(folder, part_packages)
            verdict = list(outcome.verdict)
            files = list[Path]()
            export_errors = list[ResidnetError]()
            if report:
                from residnet.report.page import render_figures

                sections = self.report_sections(folder)
                interactive_figures = render_figures(sections)
                self._write_page(folder, sections, interactive_figures)
                if outcome.exports:
                    files, export_errors = _write_exports(folder, outcome.exports)
                    verdict += [f"Not exported: {export_error}." for export_error in export_errors]
                    write_summary(verdict, is_finished=False)
                    sections = self.add_exports_to_sections(folder, sections)
                    self._write_page(folder, sections, interactive_figures)
        write_summary(verdict, is_finished=True)
        write_checksums(folder.path)
        if outcome.failure:
            raise DataError(outcome.failure)
        for export_error in export_errors:
            if not isinstance(export_error, WithheldError):
                raise ExportError(f"{export_error}; the run itself is complete: {folder.report}")
        return FinishedRun(folder, outcome, files)

    @classmethod
    def add_exports_to_sections(
        cls, run: RunFolder, sections: Sequence[Section]
    ) -> Sequence[Section]:
        """Return the sections of `report_sections` after the exports of a run were written.

        The default returns them unchanged. A task overrides it where a section names exported
        files, because figures are not drawn again after an export.
        """
        return sections

    @classmethod
    def write_report(cls, run: RunFolder) -> Path:
        """Write figures and report from the run folder alone; returns the path of the page."""
        return cls._write_page(run, cls.report_sections(run))

    @classmethod
    def _write_page(
        cls,
        run: RunFolder,
        sections: Sequence[Section],
        interactive_figures: InteractiveFigures | None = None,
    ) -> Path:
        from residnet.report.page import exports_section, write_page

        exports = exports_section(run.path)
        summary = run.read_summary()
        return write_page(
            run.path,
            "",
            "",
            summary.verdict,
            [*sections, *([] if exports is None else [exports])],
            interactive_figures,
            level=summary.level,
        )

    @contextmanager
    def reserve_resources(self) -> Iterator[None]:
        """Configure the machine for the duration of the work, such as the number of threads."""
        yield

    @classmethod
    def unsupported_verb_error(cls, run: RunFolder) -> UsageError:
        """Return the error that lists the commands that a run supports."""
        task = load_mapping(run.resolved_config).get("task")
        return UsageError(
            f"{run.path}: the run is of task '{task}'; it has: {', '.join(cls.supported_commands)}"
        )


@contextmanager
def torch_threads(threads: int) -> Iterator[None]:
    """Set the number of PyTorch threads within the context; freed memory is kept for tensors."""
    import torch

    retain_freed_memory()
    previous_threads = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(previous_threads)


class PackageTask(Task):
    """A task of two modules: `config` holds its settings, `execute` the work.

    A config is then read without the imports of its work. The module `execute` is in the package of
    the config class and has the functions `execute(config, folder)`, optionally `check(config)`,
    and one for each command of the task. A check that needs no PyTorch is a method of the config.
    """

    @final
    @classmethod
    def executor(cls) -> ModuleType:
        """Return the module that carries the task out, imported now."""
        return importlib.import_module(f"{cls.__module__.rpartition('.')[0]}.execute")

    @final
    def call_executor(self, function: str, *arguments: Any, **options: Any) -> Any:
        """Call a function of the executor with this config as its first argument."""
        return getattr(self.executor(), function)(self, *arguments, **options)

    def execute(self, folder: RunFolder) -> TaskOutcome:
        outcome: TaskOutcome = self.call_executor("execute", folder)
        return outcome

    def check(self) -> None:
        if hasattr(self.executor(), "check"):
            self.call_executor("check")


class ComputingTask(Task):
    """A task that computes with PyTorch.

    Attributes:
        threads: number of PyTorch threads; results depend on it in the last digits. One thread is
            fastest for the small matrix products of these models.
    """

    threads: int = Field(default=1, ge=1, le=1_024)

    @contextmanager
    def reserve_resources(self) -> Iterator[None]:
        with torch_threads(self.threads):
            yield


def _write_exports(
    folder: RunFolder, exports: ExportWriters
) -> tuple[list[Path], list[ResidnetError]]:
    """Write all exports and exports.json, which lists their outcomes; returns files and errors.

    If one model cannot be exported, the other exports and the run still complete.
    """

    files = list[Path]()
    errors = list[ResidnetError]()
    rows = []
    for name, write_export in exports.items():
        try:
            file = write_export()
        except ResidnetError as error:
            errors.append(error)
            rows.append(ExportRow(model=name, file=None, fault=str(error)))
        else:
            files.append(file)
            relative_path = (
                file.relative_to(folder.path) if file.is_relative_to(folder.path) else file
            )
            rows.append(ExportRow(model=name, file=relative_path.as_posix(), fault=None))
    folder.write_record(
        folder.exports, ExportsFile(schema="residnet.exports/1", exports=tuple(rows))
    )
    return files, errors

"""What every kind of run has in common: its folder, its order of work and its verbs."""

from __future__ import annotations

import importlib
import math
import re
import time
from abc import abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple, final

from pydantic import Field

from residnet.core.config import Config, dump_config, load_mapping
from residnet.core.errors import DataError, ExportError, ResidnetError, UsageError, WithheldError
from residnet.core.files import stage_files
from residnet.core.names import suggest_name
from residnet.core.processes import retain_freed_memory
from residnet.report.blocks import EXPORTS
from residnet.runs.folder import Provenance, RunFolder, require_apart, write_checksums

if TYPE_CHECKING:
    from residnet.export.base import Exportable
    from residnet.report.blocks import Section
    from residnet.report.browser import InteractiveFigures

PartName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")]
"""Of a part of a run: a model, a controller, a variant."""
ExportWriters = Mapping[str, Callable[[], Path]]
"""What writes each export and returns its file, by the name of the model."""


class ExportRequest(NamedTuple):
    """Which model of a finished run is exported, and how.

    Attributes:
        run: the finished run.
        model: its name; `predictor` and `selected` stand for the one that the run puts first.
        output_path: file to write; where None, exports/<model> with the format's suffix, or for formats of
            C exports/<run> for the model that is reported first and exports/<run>_<model> else.
        file_format: one of `residnet list formats`.
        allows_objections: whether a model is wanted that is worse than doing without it, too.
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
        judged: tuple[str, Sequence[str]] | None = None,
    ) -> Path:
        """Write what was asked for; returns the file.

        Args:
            exported: the model, its policy or its force.
            objections: what speaks against it; its card names them.
            stem: name of the file where none was asked for; that of the model where empty.
            judged: level and sentences of the verdict on this model; None for those of the run.

        Raises:
            ConfigError: where there is no such format.
            WithheldError: where something speaks against it, but for `allows_objections`.
            ExportError: where the file does not reproduce it.
        """
        from residnet.export import get_exporter
        from residnet.export.base import require_releasable
        from residnet.report.run_reader import RunFiles

        export_format = get_exporter(self.file_format)
        name = stem or exported.name
        if export_format.default_name_from_run:
            # the file's name becomes part of all symbols, and models of two runs have one name
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
        exported.assessment = RunFiles(self.run.path).assessment(judged)
        with stage_files(file, file.parent.glob("*.masses.yaml")) as staged:
            export_format.export(exported, staged)
        return file

    def resolve_model_name(self, names: Collection[str]) -> str:
        """Return the name that is asked for; `predictor` and `selected` are the only one there is.

        Raises:
            UsageError: where there is none of that name.
        """
        if self.model in ("predictor", "selected") and len(names) == 1:
            return next(iter(names))
        if self.model not in names:
            suggestion = (
                suggest_name(self.model, names) or f"; give one with --model: {', '.join(names)}"
            )
            raise UsageError(
                f"{self.run.path}: nothing to export is named '{self.model}'{suggestion}"
            )
        return self.model


class SummaryMetric(NamedTuple):
    """A number that sums a run up, in SI units.

    Attributes:
        value: the number.
        unit: its unit; `-` for a number without one.
    """

    value: float
    unit: str = "-"

    def to_json(self) -> dict[str, Any]:
        """Return the figure as summary.json holds it; a value that is not finite becomes null."""
        value = float(self.value)
        return {"value": value if math.isfinite(value) else None, "unit": self.unit}


@dataclass(frozen=True)
class TaskOutcome:
    """What a run found.

    Attributes:
        verdict: whole sentences for a reader who reads nothing else.
        summary_metrics: main figures by name.
        table: text for the terminal; empty for none.
        failure: a line where a result fails a check; the run is complete, and ends as a `DataError`
            with this line.
        level: of the verdict, of `residnet.evaluation.verdict.LEVELS`; empty where none was passed.
        exports: what writes each model for controllers once the report stands, by its name; one
            that fails is reported, and the complete run ends as an `ExportError`. One that is
            withheld is reported alone.
    """

    verdict: Sequence[str] = ()
    summary_metrics: Mapping[str, SummaryMetric] = field(default_factory=dict)
    table: str = ""
    failure: str = ""
    exports: ExportWriters = field(default_factory=dict)
    level: str = ""


@dataclass(frozen=True)
class FinishedRun:
    """A run that came to its end.

    Attributes:
        folder: where everything stands.
        outcome: what the run found.
        exports: files for controllers that it wrote.
    """

    folder: RunFolder
    outcome: TaskOutcome
    exports: Sequence[Path] = ()


class Task(Config):
    """A kind of run: one YAML file that is checked, carried out in a folder and reported.

    A subclass adds a `task` of type `Literal["its_name"]` and the keys of its own, and says how it
    is carried out and which sections its report has.

    Attributes:
        task: the kind of run.
        name: of the run; its folder is runs/<name> unless another is given.
        description: a sentence for the head of the report.
    """

    task: str
    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")
    description: str = ""

    supported_commands: ClassVar[tuple[str, ...]] = ("report",)
    """Commands that a finished run answers to; each but `report` is a method of the task."""

    @abstractmethod
    def execute(self, folder: RunFolder) -> TaskOutcome:
        """Do the work, and write the results into the folder.

        What the folder holds already from an interrupted run may be used.

        Raises:
            ResidnetError: where the input does not allow it.
        """

    section_module: ClassVar[str]
    """Full name of the module whose `sections` build the report's page."""

    @classmethod
    def report_sections(cls, run: RunFolder) -> Sequence[Section]:
        """Draw the figures of a finished run and return the sections of its report.

        Everything is taken from the folder alone; verdict, provenance and configuration are added.
        """
        from residnet.report.run_reader import RunFiles

        module = importlib.import_module(cls.section_module)
        sections: Sequence[Section] = module.sections(RunFiles(run.path))
        return sections

    def check(self) -> None:
        """Check what reading the config does not show, without running.

        Raises:
            ResidnetError: where a file, a model or a package is missing or does not fit.
        """

    def input_files(self) -> Sequence[Path]:
        """Return the files whose contents the run depends on."""
        return ()

    def provenance_seed(self) -> int:
        """Return the seed that stands in the provenance."""
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
        """Carry the task out, from an empty folder to the finished mark.

        Args:
            output_folder: run folder; runs/<name> where not given.
            resume: continue an interrupted run in its folder.
            overwrite: replace an earlier run in its folder.
            report: draw the report and export; without them a run ends after its results.
            on_open: is told the run folder as soon as it stands; None for nobody.

        Raises:
            ResidnetError: where the input does not allow it, or a result fails a check.
        """
        folder_path, resolved_yaml = self.resolve_folder(output_folder), dump_config(self)
        # before the check, which may read much
        RunFolder(folder_path).require_usable(resolved_yaml, resume=resume, overwrite=overwrite)
        self.check()
        provenance = Provenance(
            source, overrides, self.provenance_seed(), self.input_files(), time.time()
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
        """Return the run folder: the one that was asked for, else runs/<name>."""
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
        """Carry work out in the one order: provenance, work, report, exports, finished mark.

        The report stands before anything is exported, and is written again with what came of it.

        Raises:
            ResidnetError: where the work does, or where its outcome fails a check.
            ExportError: where the run is complete, but a model could not be exported.
        """
        provenance.write(folder)
        # of an earlier run in this folder
        folder.manifest.remove_if_owned(folder.path / EXPORTS)
        with self.reserve_resources():
            outcome = work(folder)
            summary_fields: Any = {
                "figures": {
                    name: figure.to_json() for name, figure in outcome.summary_metrics.items()
                },
                "level": outcome.level,
            }
            folder.write_summary(self.task, outcome.verdict, **summary_fields, is_finished=False)
            # the last time, since the report shows it and must come out the same again
            provenance.write(folder)
            verdict, files, export_errors = (
                list(outcome.verdict),
                list[Path](),
                list[ResidnetError](),
            )
            if report:
                from residnet.report.page import render_figures

                sections = self.report_sections(folder)
                interactive_figures = render_figures(sections)
                self._write_page(folder, sections, interactive_figures)
                if outcome.exports:
                    files, export_errors = _write_exports(folder, outcome.exports)
                    verdict += [f"Not exported: {export_error}." for export_error in export_errors]
                    folder.write_summary(self.task, verdict, **summary_fields, is_finished=False)
                    self._write_page(folder, sections, interactive_figures)
        folder.write_summary(self.task, verdict, **summary_fields, is_finished=True)
        write_checksums(folder.path)
        if outcome.failure:
            raise DataError(outcome.failure)
        for export_error in export_errors:
            if not isinstance(export_error, WithheldError):
                raise ExportError(f"{export_error}; the run itself is complete: {folder.report}")
        return FinishedRun(folder, outcome, files)

    @classmethod
    def write_report(cls, run: RunFolder) -> Path:
        """Write figures and report from the run folder alone; returns the page's path."""
        return cls._write_page(run, cls.report_sections(run))

    @classmethod
    def _write_page(
        cls,
        run: RunFolder,
        sections: Sequence[Section],
        interactive_figures: InteractiveFigures | None = None,
    ) -> Path:
        from residnet.report.page import exports_section, write_page

        exports, summary = exports_section(run.path), run.read_summary()
        return write_page(
            run.path,
            "",
            "",
            summary["verdict"],
            [*sections, *([] if exports is None else [exports])],
            interactive_figures,
            level=str(summary.get("level") or ""),
        )

    @contextmanager
    def reserve_resources(self) -> Iterator[None]:
        """Hold what the work needs of the machine while it is carried out."""
        yield

    @classmethod
    def unsupported_verb_error(cls, run: RunFolder) -> UsageError:
        """Return the error that names the verbs that a run has."""
        task = load_mapping(run.resolved_config).get("task")
        return UsageError(
            f"{run.path}: the run is of task '{task}'; it has: {', '.join(cls.supported_commands)}"
        )


@contextmanager
def torch_threads(threads: int) -> Iterator[None]:
    """Set PyTorch's number of threads, put back in the end, and keep freed memory for tensors."""
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

    A config is then read without importing what its work needs. `execute` lies beside the module
    of the class and has the functions `execute(config, folder)`, optionally `check(config)`, and
    one for each command of the task.
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
        threads: of PyTorch; part of what makes a run repeatable. One is fastest for the small
            products of these models.
    """

    threads: int = Field(default=1, ge=1, le=1_024)

    @contextmanager
    def reserve_resources(self) -> Iterator[None]:
        with torch_threads(self.threads):
            yield


def _write_exports(
    folder: RunFolder, exports: ExportWriters
) -> tuple[list[Path], list[ResidnetError]]:
    """Write all exports, and exports.json, which says what came of each; return files and faults.

    A model that cannot be exported does not keep the others, or the run, from coming to their end.
    """
    files, errors, rows = list[Path](), list[ResidnetError](), []
    for name, write_export in exports.items():
        try:
            file = write_export()
        except ResidnetError as error:
            errors.append(error)
            rows.append({"model": name, "file": None, "fault": str(error)})
        else:
            files.append(file)
            relative_path = (
                file.relative_to(folder.path) if file.is_relative_to(folder.path) else file
            )
            rows.append({"model": name, "file": relative_path.as_posix(), "fault": None})
    folder.write_json(folder.path / EXPORTS, {"schema": "residnet.exports/1", "exports": rows})
    return files, errors

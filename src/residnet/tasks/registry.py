"""The registry of tasks: read configs, open finished runs, list parts and runs.

A task is imported when a config names it, so that this module does not wait for PyTorch. The entry
of a task names the class of its settings. A task that is a package, such as `fit`, has its work in
the module `execute` of its package (`residnet.runs.task.PackageTask`).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from residnet.baselines import BaselineConfig
from residnet.core.config import load_config, load_mapping
from residnet.core.errors import ConfigError, ResidnetError, UsageError
from residnet.core.files import (
    find_config_folder,
    find_shipped_configs,
    require_free_space,
)
from residnet.core.names import suggest_name
from residnet.core.ownership import require_regular
from residnet.core.registry import (
    EntryPointPart,
    PluginUnion,
    describe_broken_part,
    find_broken_vessels,
    find_vessel_files,
    get_plugin_union,
    list_parts,
)
from residnet.core.run_loader import SIZE_LIMITS, name_damaged_key
from residnet.core.run_records import SummaryFile
from residnet.export import EXPORT_FORMATS
from residnet.heads import HeadConfig
from residnet.io.readers import ReaderConfig
from residnet.manoeuvres import ManoeuvreConfig
from residnet.runs.folder import RunFolder, require_recorded, write_checksums
from residnet.runs.task import Task

if TYPE_CHECKING:
    from residnet.report.blocks import Column
    from residnet.report.records import RunRow

_TASK_BASE = "residnet.runs.task:Task"
SINGLE_TASKS = {
    "fit": "residnet.tasks.fit.config:FitConfig",
    "simulate": "residnet.tasks.simulate.config:SimulateConfig",
}
"""Tasks of the core but the sweep, which varies any task; wings add their own."""
_ALL_TASKS = {**SINGLE_TASKS, "sweep": "residnet.tasks.sweep.config:SweepConfig"}
TaskConfig = Annotated[Task, PluginUnion("residnet.tasks", _TASK_BASE, _ALL_TASKS, key="task")]
SweepableConfig = Annotated[
    Task, PluginUnion("residnet.tasks", _TASK_BASE, SINGLE_TASKS, key="task")
]

_CONFIG_UNIONS: dict[str, Any] = {
    "heads": HeadConfig,
    "manoeuvres": ManoeuvreConfig,
    "readers": ReaderConfig,
    "tasks": TaskConfig,
    "baselines": BaselineConfig,
    "formats": EXPORT_FORMATS,
}
_AGE_UNITS = (("d", 86_400.0), ("h", 3_600.0), ("min", 60.0), ("s", 1.0))
"""Units in which the age of a run is shown, with their length in s; the first below it is used."""


def load_task(path: Path, overrides: Sequence[str] = ()) -> Task:
    """Read the task of a config file with overrides.

    Args:
        path: YAML file, or the name of a config that comes with residnet, such as `quickstart`.
        overrides: `dotted.key=value`, in order; `~dotted.key` removes a key.

    Raises:
        ConfigError: if the config is not valid; the message names file or override, key, error and
            the nearest valid name.
    """
    task: Task = load_config(resolve_config_file(path), overrides, TaskConfig)
    return task


def resolve_config_file(path: Path) -> Path:
    """Return the file of a config: the path itself, or the shipped config of this name.

    Raises:
        ConfigError: if neither exists; the message names the nearest shipped config.
    """
    try:
        if path.is_file() or path.suffix or path.is_absolute():
            return path
    except OSError as error:
        raise ConfigError(f"{path}: is no path ({error.strerror})") from error
    shipped = find_shipped_configs()
    if (name := path.as_posix()) in shipped:
        return shipped[name]
    raise ConfigError(
        f"{path}: no such file, and no config of this name comes with residnet"
        f"{suggest_name(name, shipped)}; residnet list configs shows them"
    )


def get_task_class(run: RunFolder) -> type[Task]:
    """Return the class of a run's task, by the name in its resolved.yaml.

    The class is enough to write the report, even if the inputs of the run no longer exist.

    Raises:
        UsageError: if there is no such task, or it cannot be used.
    """
    plugin_union = get_plugin_union(TaskConfig)
    name = str(load_mapping(run.resolved_config).get("task"))
    if name not in (task_names := plugin_union.kind_names()):
        raise UsageError(f"{run.resolved_config}: no task '{name}'{suggest_name(name, task_names)}")
    task_type: type[Task] | EntryPointPart = plugin_union.find_kind(name)
    if isinstance(task_type, EntryPointPart):
        raise UsageError(f"{run.resolved_config}: task {task_type.error_message}")
    return task_type


def open_finished_task(path: Path, command: str) -> tuple[RunFolder, Any]:
    """Return folder and config of a finished run whose task supports a command.

    Raises:
        UsageError: if there is no finished run, or its task does not support the command.
    """
    run = RunFolder.open(path)
    task_type = get_task_class(run)
    if command not in task_type.supported_commands:
        # raised before the config is read: its inputs may no longer exist
        raise task_type.unsupported_verb_error(run)
    return run, load_config(run.resolved_config, [], task_type)


def report_run(path: Path) -> Path:
    """Write figures and report of a finished run from its folder alone; returns the page.

    Raises:
        UsageError: if there is no finished run, or its task is unknown.
    """
    run = RunFolder.open(path)
    require_free_space(path)
    require_recorded(path)
    # refuse to replace files of the user before any figure is drawn
    run.manifest.require_recorded_unchanged(run.report.name, run.figures.name)
    with name_damaged_key(path):
        page = get_task_class(run).write_report(run)
    # the report of a study rewrites its comparison file
    write_checksums(path)
    return page


def write_client_pdf(
    path: Path,
    output_file: Path | None,
    template: str,
    logo: Path | None,
    text_file: Path | None,
) -> Path:
    """Write the client report of a finished fit as PDF; returns the file.

    Args:
        path: folder of the run.
        output_file: the PDF; None for client_report.pdf in the folder.
        template: `client`, or a Typst file.
        logo: image in the head; None for none.
        text_file: YAML file with the user's own text; None for none.

    Raises:
        UsageError: if there is no finished fit, a file is missing, or Typst is not installed.
        ConfigError: if the text has an unknown key.
        DataError: if the template cannot be compiled.
    """
    from residnet.report.client import read_client_text, write_client_report

    run = RunFolder.open(path)
    pdf_file = output_file or path / "client_report.pdf"
    require_free_space(pdf_file.parent)
    if pdf_file.suffix.lower() != ".pdf":
        raise UsageError(f"--out {pdf_file}: expected a file name that ends in .pdf")
    text = None if text_file is None else read_client_text(text_file)
    with name_damaged_key(path):
        return write_client_report(run.path, pdf_file, template=template, logo=logo, text=text)


def list_catalogue(part_kind: str) -> list[tuple[str, str]]:
    """Return names and one-line descriptions of all parts of a kind, third-party ones included.

    Args:
        part_kind: `vessels`, `heads`, `manoeuvres`, `readers`, `tasks`, `baselines`, `formats` or
            `configs`.
    """
    if part_kind == "vessels":
        vessels = [
            (name, _vessel_description(name, file)) for name, file in find_vessel_files().items()
        ]
        return vessels + [
            (broken_part.name, describe_broken_part(broken_part))
            for broken_part in find_broken_vessels()
        ]
    if part_kind == "configs":
        files = {file: name for name, file in reversed(find_shipped_configs().items())}
        return [
            (name, str(load_mapping(file).get("description") or ""))
            for file, name in sorted(files.items())
        ]
    return list_parts(_CONFIG_UNIONS[part_kind])


def _vessel_description(name: str, file: Path) -> str:
    if file.is_relative_to(find_config_folder()):
        return str(load_mapping(file).get("description") or "")
    from residnet.physics.vessel import load_vessel

    try:
        return load_vessel(name).description
    except ResidnetError as error:
        # one wrong file of another package must not hide all others
        return f"(cannot be used: {error})"


def list_runs(folder: Path) -> list[RunRow]:
    """Describe the runs below a folder, the newest first.

    Raises:
        UsageError: if the folder does not exist.
    """
    if not folder.is_dir():
        raise UsageError(
            f"{folder}: no such folder; runs are in the folder runs unless --out was given"
        )
    entries = [_describe_run(file.parent) for file in folder.rglob("resolved.yaml")]
    return sorted(entries, key=lambda entry: entry.age)


def format_runs(folder: Path, entries: Sequence[RunRow]) -> str:
    """Format the list of runs as a table for the terminal."""
    # reading a config does not import the report
    from residnet.report.blocks import build_table

    if not entries:
        return f"{folder}: no runs"

    def format_best(entry: RunRow) -> str:
        if entry.best is None:
            return ""
        value = "not finite" if entry.best.value is None else f"{entry.best.value:.4g}"
        return f"{entry.best.name} {value} {entry.best.unit}".removesuffix(" -")

    columns: list[Column[RunRow]] = [
        ("run", lambda entry: entry.run),
        ("task", lambda entry: entry.task),
        ("state", lambda entry: entry.state),
        ("best", format_best),
        ("age", _format_age),
    ]
    return build_table(entries, columns).to_text()


def _format_age(entry: RunRow) -> str:
    unit, unit_seconds = next((pair for pair in _AGE_UNITS if entry.age >= pair[1]), _AGE_UNITS[-1])
    return f"{entry.age / unit_seconds:.0f} {unit}"


def _describe_run(folder: Path) -> RunRow:
    from residnet.report.records import RunFigure, RunRow

    config = folder / "resolved.yaml"
    row = RunRow(run=str(folder), age=time.time() - config.stat().st_mtime)
    try:
        require_regular(config, SIZE_LIMITS[".yaml"])
        task = str(load_mapping(config).get("task", "unknown"))
        row = row.model_copy(update={"task": task})
        if not (folder / "summary.json").is_file():
            return row
        summary = SummaryFile.read(folder / "summary.json")
    except (ResidnetError, ValueError, AttributeError, OSError):
        return row.model_copy(update={"state": "damaged"})
    figures = [
        RunFigure(name=name, value=figure.value, unit=figure.unit)
        for name, figure in summary.figures.items()
    ]
    state = "finished" if summary.finished else "unfinished"
    return row.model_copy(update={"state": state, "best": next(iter(figures), None)})

"""What `residnet report`, `evaluate` and `export` do with a finished run of any task."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from residnet.core.config import load_config, load_mapping
from residnet.core.errors import UsageError
from residnet.core.files import require_file_place, require_room
from residnet.core.names import nearest
from residnet.core.registry import kinds
from residnet.runs.folder import RunFolder, seal
from residnet.runs.task import Finished, Task
from residnet.tasks.fit.config import FitTaskSettings
from residnet.tasks.fit.planning import PlannedTrials, plan_trials
from residnet.tasks.fit.refitting import RefitRun, refit_run, require_refit
from residnet.tasks.fit.watching import WatchedLog, in_service, watch_logs
from residnet.tasks.union import TaskConfig


def report_run(path: Path) -> Path:
    """Write figures and report of a finished run from its folder alone; returns the page's path.

    Raises:
        UsageError: where there is no finished run, or its task is not known.
    """
    run = RunFolder.open(path)
    require_room(path)
    page = task_class(run).write_report(run)
    # a study writes its comparison anew with the report
    seal(path)
    return page


def evaluate_run(path: Path, logs: Sequence[Path], out: Path | None) -> Finished:
    """Judge the models of a finished run on other logs.

    Raises:
        UsageError: where runs of this task have no such models.
        ResidnetError: where a log cannot be used.
    """
    run = RunFolder.open(path)
    require_room(out or path)
    return _task(run, "evaluate").evaluate_on(run, logs, out)


def export_run(path: Path, model: str, out: Path | None, file_format: str) -> Path:
    """Export one model of a finished run; returns the file.

    Raises:
        UsageError: where runs of this task have nothing to export, or there is no such model.
        ExportError: where the exported model does not agree with the one that it came from.
    """
    run = RunFolder.open(path)
    require_file_place(out or run.exports / model)
    return _task(run, "export").export_model(run, model, out, file_format)


def monitor_run(
    path: Path,
    logs: Sequence[Path],
    model: str,
    settings: Mapping[str, Any],
    refit: Path | None = None,
) -> tuple[list[WatchedLog], RefitRun | None]:
    """Watch new logs with a model of a finished fit, and refit it to them where that is asked.

    Args:
        path: of the run.
        logs: new logs, in the order of time.
        model: name of the model.
        settings: of the monitor.
        refit: folder of a run for the refitted model; None for no refit.

    Raises:
        UsageError: where the run is no fit, or there is no such model.
        ResidnetError: where a log cannot be used.
    """
    run = RunFolder.open(path)
    config = _task(run, "monitor")
    assert isinstance(config, FitTaskSettings)
    if refit is not None:
        require_refit(run, refit, config)
    service = in_service(config, run, logs, model, settings)
    watched = watch_logs(service)
    return watched, None if refit is None else refit_run(config, run, service, refit)


def plan_run(path: Path, model: str, limits: Mapping[str, Any]) -> PlannedTrials:
    """Plan the next trials for a refitted baseline of a finished fit.

    Raises:
        UsageError: where the run is no fit, or has no such baseline.
        DataError: where no candidate stays within the limits.
    """
    run = RunFolder.open(path)
    config = _task(run, "plan-trial")
    assert isinstance(config, FitTaskSettings)
    return plan_trials(config, run, model, limits)


def task_class(run: RunFolder) -> type[Task]:
    """Return the class of a run's task, by the name in its resolved.yaml.

    The class alone can write the report, so that a run can be reported whose inputs have gone.

    Raises:
        UsageError: where there is no such task.
    """
    known = kinds(TaskConfig)
    name = str(load_mapping(run.resolved).get("task"))
    if name not in known:
        raise UsageError(f"{run.resolved}: no task '{name}'{nearest(name, known)}")
    found: type[Task] = known[name]
    return found


def _task(run: RunFolder, verb: str) -> Task:
    found = task_class(run)
    if verb not in found.verbs:
        # said before the config is read: its inputs may have gone
        raise found.lacks_verb(run)
    return load_config(run.resolved, [], found)

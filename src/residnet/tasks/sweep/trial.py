"""One trial of a sweep, carried out in a process of its own."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from residnet.core.config import load_config
from residnet.core.errors import ResidnetError
from residnet.core.files import read_json
from residnet.core.progress import Progress, listen
from residnet.runs.folder import RunFolder
from residnet.runs.task import Task
from residnet.tasks.registry import SweepableConfig
from residnet.tasks.sweep.config import SweepConfig
from residnet.tasks.sweep.journal import open_study


class Ended(NamedTuple):
    """How a trial ended.

    Attributes:
        value: of the objective; None where there is none.
        pruned: whether it was ended early.
        fault: one line where it failed; else empty.
        seconds: that its run took.
    """

    value: float | None
    pruned: bool
    fault: str
    seconds: float


def trial_folder(folder: Path, number: int) -> Path:
    """Return the run folder of a trial within that of its sweep."""
    return folder / "trials" / f"{number:05d}"


def trial_task(config: SweepConfig, values: dict[str, Any], name: str) -> Task:
    """Return the run that values of the space describe.

    Raises:
        ConfigError: where they do not make a valid config.
    """
    task: Task = load_config(config.base, config.overrides(values, name), SweepableConfig)
    return task


def carry_out_trial(
    config: SweepConfig, folder: Path, trial: int, number: int, values: dict[str, Any]
) -> Ended:
    """Carry out a trial unless its run is finished.

    Args:
        config: of the sweep.
        folder: of the sweep.
        trial: the trial's mark in the journal.
        number: of the trial.
        values: by key, as the distributions know them.
    """
    import optuna

    run = RunFolder(trial_folder(folder, number))
    name = f"{config.name}.{number:05d}"
    fault = ""
    try:
        if not run.finished:
            with listen(_watch(config, folder, trial)):
                trial_task(config, values, name).run(
                    source=config.base,
                    overrides=config.overrides(values, name),
                    out=run.path,
                    resume=True,
                    report=False,
                )
    except optuna.TrialPruned:
        return Ended(None, True, "", _seconds(run))
    except ResidnetError as error:
        # a complete run whose results fail a check has a value all the same
        fault = str(error)
    if fault and not run.finished:
        return Ended(None, False, fault, _seconds(run))
    try:
        return Ended(config.objective.value(run), False, "", _seconds(run))
    except ResidnetError as error:
        return Ended(None, False, str(error), _seconds(run))


def _watch(config: SweepConfig, folder: Path, number: int) -> Any:
    """Return what hears of a trial's progress; None where no trial is ended early."""
    if config.pruning is None:
        return None
    import optuna

    trial = optuna.Trial(open_study(config, folder), number)
    watched = f"training {config.objective.watched}"

    def heard(progress: Progress) -> None:
        if progress.stage != watched or progress.score is None or progress.done is None:
            return
        trial.report(progress.score, round(progress.done))
        if trial.should_prune():
            raise optuna.TrialPruned

    return heard


def _seconds(run: RunFolder) -> float:
    return float(read_json(run.provenance)["seconds"]) if run.provenance.is_file() else 0.0

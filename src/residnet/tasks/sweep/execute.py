"""Carry out the task `sweep`; `variants.py` carries out the search `variants`.

Optuna records the trials in a journal, so that an interrupted sweep can be resumed. Each trial is a
run in its own process.
"""

from __future__ import annotations

import itertools
import json
import logging
import math
from collections import Counter
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, wait
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from residnet.core.config import dump_config
from residnet.core.errors import ResidnetError, UsageError
from residnet.core.format import format_count
from residnet.core.progress import Progress, log_message, on_progress, report_progress
from residnet.core.run_records import ProvenanceFile
from residnet.report.records import SweepFile, SweepTrial, TrialState
from residnet.report.sections.sweep import format_value, trials_table
from residnet.runs.folder import RunFolder
from residnet.runs.task import SummaryMetric, TaskOutcome
from residnet.tasks.sweep.config import GridSearch, TpeSearch, VariantSearch
from residnet.tasks.sweep.variants import compare_variants_of_fit

if TYPE_CHECKING:
    import optuna

    from residnet.tasks.sweep.config import SweepConfig

_MAX_LOST_PROCESSES = 3
"""Number of lost processes after which a trial has failed."""
_LOCK_TIMEOUT = 10
"""Seconds after which the lock of a killed process is removed."""
_SEED_STRIDE = 7_919
"""Factor that makes the trial seeds of neighbouring search seeds different."""
JOURNAL_FILE = "journal.log"
BEST_CONFIG_FILE = "best.yaml"
_STATE_NAMES: dict[str, TrialState] = {
    "COMPLETE": "finished",
    "PRUNED": "ended early",
    "FAIL": "failed",
}


def execute(config: SweepConfig, folder: RunFolder) -> TaskOutcome:
    """Run all trials and write their results; finished trials are reused.

    Raises:
        ResidnetError: if a trial cannot be run, or the journal is damaged.
    """
    if isinstance(config.search, VariantSearch):
        return compare_variants_of_fit(config, config.search, folder)
    journal = folder.path / JOURNAL_FILE
    for file in (journal, journal.with_name(f"{JOURNAL_FILE}.lock")):
        folder.manifest.record(file, None)
    if journal.is_file():
        # the last line may be incomplete after a kill
        content = journal.read_bytes()
        journal.write_bytes(content[: content.rfind(b"\n") + 1])
    study = open_optuna_study(config, folder.path)
    queue = TrialQueue(config, study)
    # the first trial may take long
    queue.report_finished()
    trial_by_future = dict[Future[TrialResult], Any]()
    n_lost = Counter[int]()
    restart_queue = list[Any]()
    with config.runner.open_executor() as pool:
        while True:
            while len(trial_by_future) < config.runner.n_parallel and (
                trial := restart_queue.pop(0) if restart_queue else queue.start_next()
            ):
                trial_arguments = (
                    config,
                    folder.path,
                    trial._trial_id,
                    trial.number,
                    dict(trial.params),
                )
                trial_by_future[pool.submit(run_sweep_trial, *trial_arguments)] = trial
            if not trial_by_future:
                return _write_results(config, study, folder)
            completed, _ = wait(trial_by_future, return_when=FIRST_COMPLETED)
            # in the order of the trial numbers, for reproducible results
            for future in sorted(
                completed, key=lambda completed_future: trial_by_future[completed_future].number
            ):
                trial = trial_by_future.pop(future)
                try:
                    queue.record_result(trial, future.result())
                except config.runner.worker_lost_errors as error:
                    n_lost[trial.number] += 1
                    if n_lost[trial.number] < _MAX_LOST_PROCESSES:
                        log_message(
                            f"  trial {trial.number}: its process was lost, the trial is repeated"
                        )
                        restart_queue.append(trial)
                        continue
                    error_line = str(error).partition("\n")[0]
                    error_message = (
                        f"its process was lost {_MAX_LOST_PROCESSES} times ({error_line});"
                        " memory may be insufficient: reduce runner.workers"
                    )
                    queue.record_result(trial, TrialResult(None, False, error_message, 0.0))


def open_optuna_study(config: SweepConfig, folder: Path) -> optuna.Study:
    """Create the Optuna study of a sweep, or open the study of an interrupted sweep.

    Raises:
        UsageError: if the journal is damaged.
    """
    import optuna
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend, JournalFileSymlinkLock

    optuna.logging.set_verbosity(logging.ERROR)
    path = str((folder / JOURNAL_FILE).absolute())
    pruning = config.pruning
    try:
        return optuna.create_study(
            storage=JournalStorage(
                JournalFileBackend(path, JournalFileSymlinkLock(path, _LOCK_TIMEOUT))
            ),
            study_name=config.name,
            direction="minimize" if config.objective.is_minimized else "maximize",
            load_if_exists=True,
            pruner=optuna.pruners.NopPruner()
            if pruning is None
            else optuna.pruners.MedianPruner(pruning.startup, pruning.warmup),
        )
    except (ValueError, KeyError) as error:
        raise UsageError(
            f"{path}: is not a journal of this sweep ({error}); restore it, or restart with"
            " --overwrite"
        ) from error


class TrialQueue:
    """Queue of the remaining trials of a sweep."""

    def __init__(self, config: SweepConfig, study: optuna.Study) -> None:
        from optuna.trial import TrialState

        self.config = config
        self.study = study
        self.distributions = {key: values.to_distribution() for key, values in config.space.items()}
        existing_trials = study.get_trials(deepcopy=False)
        # trials that were interrupted by a kill are continued first
        self._interrupted = [
            trial for trial in existing_trials if trial.state is TrialState.RUNNING
        ]
        self._n_started = sum(trial.state is not TrialState.WAITING for trial in existing_trials)
        if isinstance(config.search, GridSearch):
            # itertools.product varies the last key fastest
            grid = itertools.product(*(values.grid_values() for values in config.space.values()))
            for values in itertools.islice(grid, len(existing_trials), None):
                study.enqueue_trial(dict(zip(config.space, values, strict=True)))

    def start_next(self) -> optuna.Trial | None:
        """Return the next trial; None if all trials were started."""
        import optuna

        if self._interrupted:
            number = self._interrupted[0].number
            trial = optuna.Trial(self.study, self._interrupted.pop(0)._trial_id)
            self.study.sampler = self._make_sampler(number)
            for key, distribution in self.distributions.items():
                # a kill may have occurred before all values were written
                trial._suggest(key, distribution)
            return trial
        if self._n_started >= self.config.n_trials:
            return None
        self._n_started += 1
        self.study.sampler = self._make_sampler(self._n_started - 1)
        return self.study.ask(self.distributions)

    def _make_sampler(self, number: int) -> Any:
        """Return the sampler of a trial; its seed depends on the trial number only."""
        from optuna.samplers import RandomSampler, TPESampler

        search = self.config.search
        seed = self.config.provenance_seed() * _SEED_STRIDE + number
        if isinstance(search, TpeSearch):
            return TPESampler(n_startup_trials=search.startup, seed=seed, constant_liar=True)
        return RandomSampler(seed=seed)

    def report_finished(self) -> None:
        """Send the number of finished trials, of all processes, to the progress display."""
        n_finished = sum(
            stored_trial.state.is_finished()
            for stored_trial in self.study.get_trials(deepcopy=False)
        )
        report_progress("trials of the sweep", n_finished, self.config.n_trials)

    def record_result(self, trial: optuna.Trial, result: TrialResult) -> None:
        """Record the result of a trial in the journal and report it."""
        from optuna.trial import TrialState

        trial.set_user_attr("seconds", result.seconds)
        if result.error_message:
            trial.set_user_attr("fault", result.error_message)
        state = TrialState.COMPLETE
        if result.value is None:
            state = TrialState.PRUNED if result.is_pruned else TrialState.FAIL
        self.study.tell(trial.number, result.value, state=state)
        self.report_finished()
        outcome_text = "ended early" if result.is_pruned else f"failed: {result.error_message}"
        if result.value is not None:
            outcome_text = f"{result.value:.5g} (the best so far {self.study.best_value:.5g})"
        log_message(f"  trial {trial.number}: {outcome_text}")


class TrialResult(NamedTuple):
    """Result of a trial.

    Attributes:
        value: value of the objective; None if the trial has none.
        is_pruned: whether the trial was ended early.
        error_message: error in one line; empty without an error.
        seconds: duration of the run in s.
    """

    value: float | None
    is_pruned: bool
    error_message: str
    seconds: float


def _trial_folder_path(folder: Path, number: int) -> Path:
    return folder / "trials" / f"{number:05d}"


def run_sweep_trial(
    config: SweepConfig, folder: Path, trial_id: int, number: int, values: dict[str, Any]
) -> TrialResult:
    """Run a trial unless its run is finished.

    Args:
        config: config of the sweep.
        folder: folder of the sweep.
        trial_id: Optuna id of the trial.
        number: number of the trial.
        values: values by key, as represented in the distributions.
    """
    import optuna

    run = RunFolder(_trial_folder_path(folder, number))
    value = None
    is_pruned = False
    error_message = ""
    try:
        if not run.is_finished:
            task, overrides = config.build_trial(values, f"{config.name}.{number:05d}")
            with on_progress(make_pruning_callback(config, folder, trial_id)):
                task.run(
                    source=config.base,
                    overrides=overrides,
                    output_folder=run.path,
                    resume=True,
                    report=False,
                )
    except optuna.TrialPruned:
        is_pruned = True
    except ResidnetError as error:
        error_message = str(error)
    # a complete run whose results failed a check has a value, too
    if run.is_finished and not is_pruned:
        try:
            value = config.objective.read_value(run)
            error_message = ""
            if value is None or not math.isfinite(value):
                value = None
                error_message = f"{run.path}: the objective is not finite"
        except ResidnetError as error:
            error_message = str(error)
    provenance = ProvenanceFile.read_optional(run.path, run.provenance.name)
    seconds = 0.0 if provenance is None else provenance.seconds
    return TrialResult(value, is_pruned, error_message, seconds)


def make_pruning_callback(
    config: SweepConfig, folder: Path, number: int
) -> Callable[[Progress], None] | None:
    """Return the progress callback that prunes a trial; None without pruning."""
    if config.pruning is None:
        return None
    import optuna

    trial = optuna.Trial(open_optuna_study(config, folder), number)
    monitored_stage = f"training {config.objective.monitored_model}"

    def report_to_pruner(progress: Progress) -> None:
        if progress.stage != monitored_stage or progress.score is None or progress.done is None:
            return
        trial.report(progress.score, round(progress.done))
        if trial.should_prune():
            raise optuna.TrialPruned

    return report_to_pruner


def _write_results(config: SweepConfig, study: optuna.Study, folder: RunFolder) -> TaskOutcome:
    """Write sweep.json and best.yaml; returns the outcome of the sweep."""
    rows = [_trial_row(config, trial) for trial in study.get_trials(deepcopy=False)]
    by_state = {
        state: [row for row in rows if row.state == state] for state in _STATE_NAMES.values()
    }
    n_finished = len(by_state["finished"])
    content = SweepFile(
        schema="residnet.sweep/1",
        run=config.name,
        objective=config.objective.description,
        minimized=config.objective.is_minimized,
        search=config.search.kind,
        keys=tuple(config.space),
        log=tuple(key for key, values in config.space.items() if values.log),
        best=None,
        importance=_parameter_importance(study, n_finished),
        trials=tuple(rows),
    )
    direction_sign = 1.0 if content.minimized else -1.0
    best_row, best_value = min(
        content.completed,
        key=lambda pair: (direction_sign * pair[1], pair[0].number),
        default=(None, math.nan),
    )
    if best_row is not None:
        content = content.model_copy(update={"best": best_row.number})
    folder.write_record(folder.path / "sweep.json", content)
    summary_metrics = {
        state_name.replace(" ", "_"): SummaryMetric(len(state_rows))
        for state_name, state_rows in by_state.items()
    }
    if best_row is None:
        first_error = next((row.fault for row in rows if row.fault), "no trial was completed")
        return TaskOutcome(
            ["No trial of the sweep has a value."],
            summary_metrics,
            failure=f"{config.name}: no trial has a value; the first fault: {first_error}",
        )
    texts = {key: json.dumps(value) for key, value in best_row.values.items()}
    folder.write(
        folder.path / BEST_CONFIG_FILE,
        dump_config(config.build_trial(texts, f"{config.name}.best")[0]),
    )
    key_values = best_row.values.items()
    verdict = [
        f"Trial {best_row.number} of {len(rows)} is the best:"
        f" {config.objective.description.removesuffix(' [-]')} {best_value:.5g}, with"
        f" {', '.join(f'{key} = {format_value(value)}' for key, value in key_values)}.",
        f"Its run folder is {_trial_folder_path(Path(), best_row.number)}; {BEST_CONFIG_FILE} is"
        " its config.",
    ]
    if by_state["ended early"]:
        verdict.append(f"Ended early: {format_count(len(by_state['ended early']), 'trial')}.")
    if failed_rows := by_state["failed"]:
        first_fault = failed_rows[0].fault
        verdict.append(
            f"{format_count(len(failed_rows), 'trial')} failed; the first: {first_fault}."
        )
    if n_finished > 1:
        verdict.append(
            f"The best of {n_finished} validation errors is biased by the selection:"
            f" evaluate it"
            " on other data, such as the test split of its run."
        )
    summary_metrics = {"best": SummaryMetric(best_value), **summary_metrics}
    return TaskOutcome(verdict, summary_metrics, trials_table(content).to_text())


def _trial_row(config: SweepConfig, trial: optuna.trial.FrozenTrial) -> SweepTrial:
    trial_values = {key: trial.params[key] for key in config.space}
    return SweepTrial(
        number=trial.number,
        state=_STATE_NAMES[trial.state.name],
        value=trial.value if trial.state.name == "COMPLETE" else None,
        seconds=trial.user_attrs.get("seconds", 0.0),
        fault=trial.user_attrs.get("fault", ""),
        values={k: json.loads(v) if isinstance(v, str) else v for k, v in trial_values.items()},
    )


def _parameter_importance(study: optuna.Study, n_finished: int) -> dict[str, float]:
    """Return the share of each key in the variance of the objective (fANOVA).

    The result is empty for fewer than four trials.
    """
    if n_finished < 4:
        return {}
    from optuna.importance import FanovaImportanceEvaluator, get_param_importances

    try:
        importances = get_param_importances(study, evaluator=FanovaImportanceEvaluator(seed=0))
    except (RuntimeError, ValueError):
        # all objective values are equal
        return {}
    return {key: float(share) for key, share in importances.items()}

"""Carrying out a sweep: as many trials at a time as its runner takes, each told to the journal."""

from __future__ import annotations

from concurrent.futures import FIRST_COMPLETED, Future, wait
from typing import TYPE_CHECKING

from residnet.core.progress import report, say
from residnet.runs.folder import RunFolder
from residnet.tasks.sweep.config import SweepConfig
from residnet.tasks.sweep.journal import Trials, mend, open_study
from residnet.tasks.sweep.trial import Ended, carry_out_trial

if TYPE_CHECKING:
    import optuna


def run_trials(config: SweepConfig, folder: RunFolder) -> optuna.Study:
    """Carry out all trials that are not done yet; returns the study that keeps them.

    Raises:
        FitError: where the system ends a process.
        UsageError: where the journal of an interrupted sweep is damaged.
    """
    mend(folder.path)
    study = open_study(config, folder.path)
    trials = Trials(config, study)
    running: dict[Future[Ended], optuna.Trial] = {}
    with config.runner.executor() as pool:
        while True:
            while len(running) < config.runner.side_by_side and (trial := trials.next()):
                work = (config, folder.path, trial._trial_id, trial.number, dict(trial.params))
                running[pool.submit(carry_out_trial, *work)] = trial
            if not running:
                return study
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            # in the order of their numbers, so that nothing hangs on chance
            for future in sorted(done, key=lambda one: running[one].number):
                _tell(study, running.pop(future), future.result(), config)


def _tell(study: optuna.Study, trial: optuna.Trial, ended: Ended, config: SweepConfig) -> None:
    from optuna.trial import TrialState

    trial.set_user_attr("seconds", ended.seconds)
    if ended.fault:
        trial.set_user_attr("fault", ended.fault)
    state = TrialState.COMPLETE
    if ended.value is None:
        state = TrialState.PRUNED if ended.pruned else TrialState.FAIL
    study.tell(trial.number, ended.value, state=state)
    over = sum(kept.state.is_finished() for kept in study.get_trials(deepcopy=False))
    report("trials of the sweep", over, config.trials)
    words = "ended early" if ended.pruned else f"failed: {ended.fault}"
    if ended.value is not None:
        words = f"{ended.value:.5g} (the best so far {study.best_value:.5g})"
    say(f"  trial {trial.number}: {words}")

"""The trials of a sweep as Optuna keeps them, in a journal that survives any kill."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

from residnet.core.errors import MissingPackageError, UsageError
from residnet.tasks.sweep.config import GridSearch, RandomSearch, SweepConfig, TpeSearch

if TYPE_CHECKING:
    import optuna

JOURNAL = "journal.log"
_STALE = 10
"""Seconds after which the lock of a killed process is taken away."""
_PRIME = 7_919


def require_optuna() -> None:
    """Check that Optuna is installed.

    Raises:
        MissingPackageError: where it is not.
    """
    try:
        import optuna  # noqa: F401
    except ImportError as error:
        raise MissingPackageError(
            "task sweep needs the package optuna; install it with: pip install 'residnet[sweep]'"
        ) from error


def open_study(config: SweepConfig, folder: Path) -> optuna.Study:
    """Return the study of a sweep, new or as an interrupted sweep left it.

    Raises:
        UsageError: where the journal is damaged.
    """
    import optuna
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend, JournalFileSymlinkLock

    optuna.logging.set_verbosity(logging.ERROR)
    path = (folder / JOURNAL).absolute()
    try:
        storage = JournalStorage(
            JournalFileBackend(str(path), JournalFileSymlinkLock(str(path), _STALE))
        )
        return optuna.create_study(
            storage=storage,
            study_name=config.name,
            direction="minimize" if config.objective.minimized else "maximize",
            load_if_exists=True,
            pruner=_pruner(config),
        )
    except (ValueError, KeyError) as error:
        raise UsageError(
            f"{path}: is no journal of this sweep ({error}); restore it, or begin anew with"
            " --overwrite"
        ) from error


def mend(folder: Path) -> None:
    """Cut off the last line of a journal where a kill left it without its end."""
    path = folder / JOURNAL
    if not path.is_file():
        return
    content = path.read_bytes()
    whole = content[: content.rfind(b"\n") + 1]
    if len(whole) < len(content):
        path.write_bytes(whole)


def _pruner(config: SweepConfig) -> Any:
    from optuna.pruners import MedianPruner, NopPruner

    if config.pruning is None:
        return NopPruner()
    return MedianPruner(
        n_startup_trials=config.pruning.startup, n_warmup_steps=config.pruning.warmup
    )


class Trials:
    """The trials of a sweep that have still to be carried out, in their order.

    Args:
        config: of the sweep.
        study: that keeps them.
    """

    def __init__(self, config: SweepConfig, study: optuna.Study) -> None:
        from optuna.trial import TrialState

        self.config, self.study = config, study
        self.space = {key: values.distribution() for key, values in config.space.items()}
        kept = study.get_trials(deepcopy=False)
        # a kill leaves trials without an end: they go on
        self._begun = [trial for trial in kept if trial.state is TrialState.RUNNING]
        known = sum(trial.state is not TrialState.WAITING for trial in kept)
        self._left = config.trials - known
        for values in self._planned()[len(kept) :]:
            study.enqueue_trial(values)

    def _planned(self) -> list[dict[str, Any]]:
        """Return the values of all trials, where they do not depend on what trials find."""
        if isinstance(self.config.search, GridSearch):
            return self.config.combinations()
        if isinstance(self.config.search, RandomSearch):
            return drawn(self.config, self.config.trials)
        return []

    def next(self) -> optuna.Trial | None:
        """Return the next trial to be carried out; None where all have begun."""
        if self._begun:
            return self._taken_up(self._begun.pop(0))
        if self._left <= 0:
            return None
        self._left -= 1
        self.study.sampler = self._sampler(self.config.trials - self._left - 1)
        return self.study.ask(self.space)

    def _taken_up(self, kept: Any) -> optuna.Trial:
        import optuna

        self.study.sampler = self._sampler(kept.number)
        trial = optuna.Trial(self.study, kept._trial_id)
        for key, distribution in self.space.items():
            # a kill may have come before all values were written
            trial._suggest(key, distribution)
        return trial

    def _sampler(self, number: int) -> Any:
        """Return the sampler of a trial; its seed is that of the trial alone."""
        from optuna.samplers import RandomSampler, TPESampler

        search = self.config.search
        if isinstance(search, TpeSearch):
            seed = search.seed * _PRIME + number
            return TPESampler(n_startup_trials=search.startup, seed=seed, constant_liar=True)
        # every value is planned
        return RandomSampler(seed=0)


def drawn(config: SweepConfig, count: int) -> list[dict[str, Any]]:
    """Return random values of trials; they depend on the seed of the search alone."""
    import optuna

    optuna.logging.set_verbosity(logging.ERROR)
    seed = 0 if isinstance(config.search, GridSearch) else config.search.seed
    sampler = optuna.samplers.RandomSampler(seed=seed)
    study = optuna.create_study(sampler=sampler)
    space = {key: values.distribution() for key, values in config.space.items()}
    return [dict(study.ask(space).params) for _ in range(count)]

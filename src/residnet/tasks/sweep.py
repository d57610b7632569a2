"""Task `sweep`: keys of any config varied by grid, at random or by TPE, trial by trial.

Optuna keeps the trials in a journal that survives any kill; each is a run in a process of its own.
"""

from __future__ import annotations

import itertools
import json
import logging
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple, final

import numpy as np
from pydantic import Field, JsonValue, model_validator

from residnet.core.config import BaseConfig, Config, dump_config, load_config
from residnet.core.errors import DataError, FitError, ResidnetError, UsageError, require_package
from residnet.core.files import read_json
from residnet.core.names import nearest
from residnet.core.processes import ApartProcesses, ThisProcess, spread
from residnet.core.progress import Progress, listen, report, say
from residnet.report.run_reader import RunFiles
from residnet.report.sections.sweep import trials_table
from residnet.runs.folder import RunFolder
from residnet.runs.task import MainFigure, Outcome, Task
from residnet.tasks.registry import SweepableConfig

if TYPE_CHECKING:
    import optuna

_MOST = 100_000
"""Most trials of a sweep."""
_LOSSES = 3
"""Times that a trial may lose its process before it has failed: twice is an accident."""
_STALE = 10
"""Seconds after which the lock of a killed process is taken away."""
_PRIME = 7_919
"""Keeps the seeds of the trials of neighbouring seeds of a search apart."""
JOURNAL, BEST = "journal.log", "best.yaml"
_STATES = {"COMPLETE": "finished", "PRUNED": "ended early", "FAIL": "failed"}


class Values(Config):
    """Values that a key of the base takes: `choices`, or a range from `low` to `high`.

    Attributes:
        choices: any values of the key, lists and mappings included; null for a range.
        low: least value of a range, in the key's SI unit; with `high` a whole number, the values
            are whole numbers.
        high: greatest value of a range.
        log: the range is covered evenly in its logarithm.
        points: of the range on a grid, ends included; null for all whole numbers.
    """

    choices: tuple[JsonValue, ...] | None = Field(default=None, min_length=1)
    low: int | float | None = None
    high: int | float | None = None
    log: bool = False
    points: int | None = Field(default=None, ge=2, le=10_000)

    @model_validator(mode="after")
    def _one_kind(self) -> Values:
        if self.choices is not None:
            if self.low is not None or self.high is not None or self.points or self.log:
                raise ValueError("give choices, or low and high, not both")
            if len(set(self._texts)) < len(self.choices):
                raise ValueError("choices: each only once")
        elif self.low is None or self.high is None:
            raise ValueError("give choices, or low and high")
        elif not self.low < self.high:
            raise ValueError(f"low ({self.low:g}) must be less than high ({self.high:g})")
        elif self.log and self.low <= 0:
            raise ValueError(f"low ({self.low:g}) must be above zero where log is true")
        return self

    @property
    def _texts(self) -> list[str]:
        """Choices as Optuna knows them."""
        return [json.dumps(choice) for choice in self.choices or ()]

    @property
    def _whole(self) -> bool:
        return isinstance(self.low, int) and isinstance(self.high, int)

    def distribution(self) -> Any:
        """Return the Optuna distribution; a choice is its JSON text there."""
        from optuna import distributions as of

        if self.choices is not None:
            return of.CategoricalDistribution(self._texts)
        kind: Any = of.IntDistribution if self._whole else of.FloatDistribution
        return kind(self.low, self.high, log=self.log)

    def grid(self) -> list[Any]:
        """Return all values of a grid, as the distribution knows them.

        Raises:
            ValueError: for a range without a number of points.
        """
        if self.choices is not None:
            return list(self._texts)
        assert self.low is not None
        assert self.high is not None
        if self.points is None:
            if not self._whole:
                raise ValueError("a grid needs the number of points of a range")
            return list(range(int(self.low), int(self.high) + 1))
        found = (np.geomspace if self.log else np.linspace)(self.low, self.high, self.points)
        # the ends themselves, or rounding may leave the range
        found[0], found[-1] = self.low, self.high
        return sorted({round(value) for value in found.tolist()}) if self._whole else found.tolist()

    def extremes(self) -> list[Any]:
        """Return values that a check tries: all choices, or the ends of a range."""
        return self.grid() if self.choices is not None else [self.low, self.high]


class GridSearch(Config):
    """Every combination of all values, once.

    Attributes:
        kind: of the search.
    """

    kind: Literal["grid"]


class RandomSearch(Config):
    """Values drawn at random, independently of what other trials found.

    Attributes:
        kind: of the search.
        trials: number of trials.
        seed: of the draws.
    """

    kind: Literal["random"]
    trials: int = Field(ge=1, le=_MOST)
    seed: int = Field(default=0, ge=0)


class TpeSearch(RandomSearch):
    """Values drawn where earlier trials did well: Optuna's tree-structured Parzen estimator.

    What a trial draws depends on which trials had ended by then, so that only one worker repeats
    a search exactly.

    Attributes:
        startup: trials that are drawn at random first.
    """

    kind: Literal["tpe"]  # type: ignore[assignment]
    startup: int = Field(default=10, ge=1)


class PruningConfig(Config):
    """Ending a trial early: where its network validates worse than the median of trials by then.

    The validation error in free run that the training itself watches is compared, at the same
    epoch.

    Attributes:
        startup: trials that must have ended before any is ended early.
        warmup: epochs that every trial is given.
    """

    startup: int = Field(default=5, ge=1)
    warmup: int = Field(default=0, ge=0)


class FreeRunObjective(Config):
    """The least mean NRMSE in free run over the validation data of a fit.

    The protocol is the one that the fit itself selects by. Test data have no say.

    Attributes:
        kind: of the objective.
        model: whose error counts; `selected` for the one that each fit selects.
    """

    kind: Literal["free_run"] = "free_run"
    model: str = "selected"

    minimized: ClassVar[bool] = True

    @property
    def watched(self) -> str | None:
        """The model whose training may be ended early; None where it is not named."""
        return None if self.model == "selected" else self.model

    @property
    def words(self) -> str:
        """What is sought, for tables and axes."""
        return f"validation NRMSE of {self.model} [-]"

    def check(self, task: Task) -> None:
        """Check that runs of a task have this objective.

        Raises:
            UsageError: where the task is no fit, or has no such model.
        """
        if task.task != "fit":
            raise UsageError(
                f"objective: task {task.task} has no free-run error; give objective: {{kind:"
                " figure, name: ..., direction: ...} with a main figure of its summary.json"
            )
        models = ("selected", *task.model_names)  # type: ignore[attr-defined]
        if self.model not in models:
            raise UsageError(
                f"objective.model: no model is named '{self.model}'{nearest(self.model, models)}"
            )

    def value(self, run: RunFolder) -> float | None:
        """Return the objective of a finished run.

        Raises:
            DataError: where the run has no such error.
        """
        files = RunFiles(run.path)
        model = files.selected if self.model == "selected" else self.model
        row = files.row(model, "validation", files.evaluation["selection"])
        if row is None:
            raise DataError(f"{run.metrics}: has no validation error of model '{model}'")
        return float(row["nrmse"]["mean"])


class FigureObjective(Config):
    """A main figure of summary.json.

    Attributes:
        kind: of the objective.
        name: of the figure, for example `cost`.
        direction: `minimize` or `maximize`.
    """

    kind: Literal["figure"]
    name: str
    direction: Literal["minimize", "maximize"] = "minimize"

    # no training shows the figure before a run ends
    watched: ClassVar[None] = None

    @property
    def minimized(self) -> bool:
        """Whether a lesser figure is better."""
        return self.direction == "minimize"

    @property
    def words(self) -> str:
        """What is sought, for tables and axes."""
        return self.name

    def check(self, task: Task) -> None:
        """Check that the figure may be sought.

        Raises:
            UsageError: where the task is a fit, whose main figures are errors on test data.
        """
        if task.task == "fit":
            raise UsageError(
                "objective: the main figures of a fit are errors on test data, which must not"
                " choose anything; take objective: {kind: free_run}"
            )

    def value(self, run: RunFolder) -> float | None:
        """Return the objective of a finished run.

        Raises:
            DataError: where the run has no such figure.
        """
        figures = run.read_summary()["figures"]
        if self.name not in figures:
            raise DataError(
                f"{run.summary}: has no main figure '{self.name}'{nearest(self.name, figures)}"
            )
        found: float | None = figures[self.name]["value"]
        return found


class ProcessesConfig(Config):
    """Processes of this machine, side by side.

    Attributes:
        kind: of the runner.
        workers: number of processes; null for as many as there are cores. One works without a
            process of its own.
    """

    kind: Literal["processes"] = "processes"
    workers: int | None = Field(default=None, ge=1, le=1_024)

    def check(self) -> None:
        """Check nothing: processes need no package."""

    @property
    def side_by_side(self) -> int:
        """How many trials run at a time."""
        if self.workers is not None:
            return self.workers
        from joblib import cpu_count

        return int(cpu_count())

    @contextmanager
    def executor(self) -> Iterator[Executor]:
        """Hold the processes; an interruption ends them all at once. One worker is this process."""
        if self.side_by_side == 1:
            with spread(1):
                yield ThisProcess()
            return
        with ApartProcesses(self.side_by_side) as pool:
            yield pool

    @property
    def losses(self) -> tuple[type[Exception], ...]:
        """Errors with which a trial ends whose process was lost."""
        return (BrokenProcessPool,)


class RayConfig(Config):
    """Tasks of a Ray cluster, or of Ray on this machine.

    The run folder must lie where every node sees it under the same path.

    Attributes:
        kind: of the runner.
        workers: trials at a time.
        address: of the cluster, for example `auto` on one of its nodes; null starts Ray on this
            machine.
        cpus: cores that a trial takes.
        gpus: share of a GPU that a trial takes.
    """

    kind: Literal["ray"]
    workers: int = Field(ge=1, le=100_000)
    address: str | None = None
    cpus: float = Field(default=1.0, gt=0)
    gpus: float = Field(default=0.0, ge=0)

    def check(self) -> None:
        """Check that Ray is installed.

        Raises:
            MissingPackageError: where it is not.
        """
        require_package("ray", "runner.kind: ray", "ray")

    @property
    def side_by_side(self) -> int:
        """How many trials run at a time."""
        return self.workers

    @contextmanager
    def executor(self) -> Iterator[Executor]:
        """Hold a connection to Ray, whose processes end with this one.

        Raises:
            FitError: where the cluster cannot be reached, or ends a trial that was not lost.
        """
        self.check()
        import ray

        try:
            ray.init(
                address=self.address,
                # a cluster has cores of its own
                num_cpus=None if self.address else max(round(self.workers * self.cpus), 1),
                include_dashboard=None if self.address else False,
                log_to_driver=False,
                configure_logging=False,
            )
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise FitError(f"runner.address: Ray cannot be reached ({error})") from error
        try:
            yield _RayExecutor(ray, self.cpus, self.gpus)
        except ray.exceptions.RayError as error:
            raise FitError(
                f"runner: Ray has ended a trial ({str(error).partition(chr(10))[0]}); continue with"
                " --resume"
            ) from error
        finally:
            ray.shutdown()

    @property
    def losses(self) -> tuple[type[Exception], ...]:
        """Errors with which a trial ends whose process, node or memory was lost."""
        from ray import exceptions as lost

        return (
            lost.WorkerCrashedError,
            lost.NodeDiedError,
            lost.OutOfMemoryError,
            lost.ObjectLostError,
        )


class _RayExecutor(Executor):
    """An executor whose work runs as Ray tasks."""

    def __init__(self, ray: Any, cpus: float, gpus: float) -> None:
        # the sweep counts what is lost, and begins it again
        self._wrap = ray.remote(num_cpus=cpus, num_gpus=gpus, max_retries=0)

    def submit(self, work: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        found: Future[Any] = self._wrap(work).remote(*args, **kwargs).future()
        return found


SearchConfig = Annotated[GridSearch | RandomSearch | TpeSearch, Field(discriminator="kind")]
ObjectiveConfig = Annotated[FreeRunObjective | FigureObjective, Field(discriminator="kind")]
RunnerConfig = Annotated[ProcessesConfig | RayConfig, Field(discriminator="kind")]


@final
class SweepConfig(Task):
    """Keys of a config varied over a search space; every trial is a run of its own.

    Attributes:
        base: config of any task but a sweep, by its path or by the name of one that comes with
            residnet, such as `quickstart`; paths in it are taken from its own folder.
        common: overrides of the base for all trials.
        space: values by the key of the base that they are for, such as `heads.mlp.hidden`.
        search: how the space is searched.
        objective: what is sought.
        pruning: ends poor trials early; null lets each come to its end.
        runner: where trials run.
    """

    page: ClassVar[str] = "sweep"

    task: Literal["sweep"]
    base: BaseConfig
    common: tuple[str, ...] = ()
    space: dict[str, Values] = Field(min_length=1)
    search: SearchConfig
    objective: ObjectiveConfig = FreeRunObjective()
    pruning: PruningConfig | None = None
    runner: RunnerConfig = ProcessesConfig()

    @model_validator(mode="after")
    def _combination(self) -> SweepConfig:
        if isinstance(self.search, GridSearch):
            for key, values in self.space.items():
                try:
                    values.grid()
                except ValueError as error:
                    raise ValueError(f"space.{key}: {error}") from None
            if self.trials > _MOST:
                raise ValueError(f"space: a grid of {self.trials} trials; at most {_MOST}")
        if self.pruning is not None and self.objective.watched is None:
            raise ValueError(
                "pruning: objective must be of kind free_run and name the network whose training"
                " is watched in objective.model"
            )
        return self

    @property
    def trials(self) -> int:
        """Number of trials that the search asks for; of a grid, all its combinations."""
        if isinstance(self.search, GridSearch):
            return math.prod(len(values.grid()) for values in self.space.values())
        return self.search.trials

    def trial(self, values: Mapping[str, Any], name: str) -> tuple[Any, list[str]]:
        """Return the run that values of the space describe, and the overrides of its base.

        Args:
            values: by key, as the distributions know them.

        Raises:
            ConfigError: where they do not make a valid config.
        """
        drawn = {key: values[key] for key in self.space}
        texts = [f"{k}={v if isinstance(v, str) else json.dumps(v)}" for k, v in drawn.items()]
        overrides = [*self.common, *texts, f"name={name}"]
        return load_config(self.base, overrides, SweepableConfig), overrides

    def check(self) -> None:
        """Check that the base and each value make a valid run, and that all packages are there.

        The ends of a range are tried, each with the first values of the other keys.

        Raises:
            ResidnetError: where one does not, or the objective does not fit the task.
        """
        require_package("optuna", "task sweep", "sweep")
        self.runner.check()
        first = {key: values.extremes()[0] for key, values in self.space.items()}
        for key, values in self.space.items():
            for value in values.extremes():
                self.trial({**first, key: value}, f"{self.name}.check")
        task, _ = self.trial(first, f"{self.name}.check")
        self.objective.check(task)
        task.check()

    def input_files(self) -> list[Path]:
        """Return the base and the files that it reads."""
        base = load_config(self.base, self.common, SweepableConfig)
        return [self.base, *base.input_files()]

    def recorded_seed(self) -> int:
        return 0 if isinstance(self.search, GridSearch) else self.search.seed

    def carry_out(self, folder: RunFolder) -> Outcome:
        """Carry out all trials and write what they found; those that are done already are kept.

        Raises:
            ResidnetError: where the system ends a process, or a journal is damaged.
        """
        journal = folder.path / JOURNAL
        for file in (journal, journal.with_name(f"{JOURNAL}.lock")):
            folder.manifest.record(file, None)
        if journal.is_file():
            # a kill may have left the last line without its end
            content = journal.read_bytes()
            journal.write_bytes(content[: content.rfind(b"\n") + 1])
        study = open_study(self, folder.path)
        trials, running = Trials(self, study), dict[Future[Ended], Any]()
        lost, again = Counter[int](), list[Any]()
        with self.runner.executor() as pool:
            while True:
                while len(running) < self.runner.side_by_side and (
                    trial := again.pop(0) if again else trials.next()
                ):
                    work = (self, folder.path, trial._trial_id, trial.number, dict(trial.params))
                    running[pool.submit(carry_out_trial, *work)] = trial
                if not running:
                    return _results(self, study, folder)
                done, _ = wait(running, return_when=FIRST_COMPLETED)
                # in the order of their numbers, so that nothing hangs on chance
                for future in sorted(done, key=lambda one: running[one].number):
                    trial = running.pop(future)
                    try:
                        trials.tell(trial, future.result())
                    except self.runner.losses as error:
                        lost[trial.number] += 1
                        if lost[trial.number] < _LOSSES:
                            say(f"  trial {trial.number}: its process was lost, it goes on anew")
                            again.append(trial)
                            continue
                        said = str(error).partition("\n")[0]
                        fault = (
                            f"its process was lost {_LOSSES} times ({said});"
                            " the memory may not be enough, so give fewer runner.workers"
                        )
                        trials.tell(trial, Ended(None, False, fault, 0.0))


def open_study(config: SweepConfig, folder: Path) -> optuna.Study:
    """Return the study of a sweep, new or as an interrupted sweep left it.

    Raises:
        UsageError: where the journal is damaged.
    """
    import optuna
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend, JournalFileSymlinkLock

    optuna.logging.set_verbosity(logging.ERROR)
    path, pruning = str((folder / JOURNAL).absolute()), config.pruning
    try:
        return optuna.create_study(
            storage=JournalStorage(JournalFileBackend(path, JournalFileSymlinkLock(path, _STALE))),
            study_name=config.name,
            direction="minimize" if config.objective.minimized else "maximize",
            load_if_exists=True,
            pruner=optuna.pruners.NopPruner()
            if pruning is None
            else optuna.pruners.MedianPruner(pruning.startup, pruning.warmup),
        )
    except (ValueError, KeyError) as error:
        raise UsageError(
            f"{path}: is no journal of this sweep ({error}); restore it, or begin anew with"
            " --overwrite"
        ) from error


class Trials:
    """The trials of a sweep that have still to be carried out, in their order."""

    def __init__(self, config: SweepConfig, study: optuna.Study) -> None:
        from optuna.trial import TrialState

        self.config, self.study = config, study
        self.space = {key: values.distribution() for key, values in config.space.items()}
        kept = study.get_trials(deepcopy=False)
        # a kill leaves trials without an end: they go on
        self._begun = [trial for trial in kept if trial.state is TrialState.RUNNING]
        self._next = sum(trial.state is not TrialState.WAITING for trial in kept)
        if isinstance(config.search, GridSearch):
            # the last key varies fastest
            grid = itertools.product(*(values.grid() for values in config.space.values()))
            for values in itertools.islice(grid, len(kept), None):
                study.enqueue_trial(dict(zip(config.space, values, strict=True)))

    def next(self) -> optuna.Trial | None:
        """Return the next trial to be carried out; None where all have begun."""
        import optuna

        if self._begun:
            number = self._begun[0].number
            trial = optuna.Trial(self.study, self._begun.pop(0)._trial_id)
            self.study.sampler = self._sampler(number)
            for key, distribution in self.space.items():
                # a kill may have come before all values were written
                trial._suggest(key, distribution)
            return trial
        if self._next >= self.config.trials:
            return None
        self._next += 1
        self.study.sampler = self._sampler(self._next - 1)
        return self.study.ask(self.space)

    def _sampler(self, number: int) -> Any:
        """Return the sampler of a trial; its seed is that of the trial alone."""
        from optuna.samplers import RandomSampler, TPESampler

        search = self.config.search
        seed = self.config.recorded_seed() * _PRIME + number
        if isinstance(search, TpeSearch):
            return TPESampler(n_startup_trials=search.startup, seed=seed, constant_liar=True)
        return RandomSampler(seed=seed)

    def tell(self, trial: optuna.Trial, ended: Ended) -> None:
        """Write into the journal how a trial ended, and say so."""
        from optuna.trial import TrialState

        trial.set_user_attr("seconds", ended.seconds)
        if ended.fault:
            trial.set_user_attr("fault", ended.fault)
        state = TrialState.COMPLETE
        if ended.value is None:
            state = TrialState.PRUNED if ended.pruned else TrialState.FAIL
        self.study.tell(trial.number, ended.value, state=state)
        over = sum(kept.state.is_finished() for kept in self.study.get_trials(deepcopy=False))
        report("trials of the sweep", over, self.config.trials)
        words = "ended early" if ended.pruned else f"failed: {ended.fault}"
        if ended.value is not None:
            words = f"{ended.value:.5g} (the best so far {self.study.best_value:.5g})"
        say(f"  trial {trial.number}: {words}")


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


def _trial_folder(folder: Path, number: int) -> Path:
    return folder / "trials" / f"{number:05d}"


def carry_out_trial(
    config: SweepConfig, folder: Path, trial: int, number: int, values: dict[str, Any]
) -> Ended:
    """Carry out a trial unless its run is finished.

    Args:
        values: by key, as the distributions know them.
    """
    import optuna

    run = RunFolder(_trial_folder(folder, number))
    value, pruned, fault = None, False, ""
    try:
        if not run.finished:
            task, overrides = config.trial(values, f"{config.name}.{number:05d}")
            with listen(watch(config, folder, trial)):
                task.run(
                    source=config.base, overrides=overrides, out=run.path, resume=True, report=False
                )
    except optuna.TrialPruned:
        pruned = True
    except ResidnetError as error:
        fault = str(error)
    # a complete run whose results fail a check has a value all the same
    if run.finished and not pruned:
        try:
            value, fault = config.objective.value(run), ""
            if value is None or not math.isfinite(value):
                value, fault = None, f"{run.path}: what is sought is not finite"
        except ResidnetError as error:
            fault = str(error)
    known = run.provenance.is_file()
    seconds = float(read_json(run.provenance)["seconds"]) if known else 0.0
    return Ended(value, pruned, fault, seconds)


def watch(config: SweepConfig, folder: Path, number: int) -> Callable[[Progress], None] | None:
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


def _results(config: SweepConfig, study: optuna.Study, folder: RunFolder) -> Outcome:
    """Write sweep.json and best.yaml; returns what the sweep found."""
    rows = [_row(config, trial) for trial in study.get_trials(deepcopy=False)]
    by_state = {state: [row for row in rows if row["state"] == state] for state in _STATES.values()}
    finished, sign = by_state["finished"], 1.0 if config.objective.minimized else -1.0
    best = min(finished, key=lambda row: (sign * row["value"], row["number"]), default=None)
    content = {
        "schema": "residnet.sweep/1",
        "run": config.name,
        "objective": config.objective.words,
        "minimized": config.objective.minimized,
        "search": config.search.kind,
        "keys": list(config.space),
        "log": [key for key, values in config.space.items() if values.log],
        "best": None if best is None else best["number"],
        "importance": _importance(study, len(finished)),
        "trials": rows,
    }
    folder.write_json(folder.path / "sweep.json", content)
    figures = {s.replace(" ", "_"): MainFigure(len(found)) for s, found in by_state.items()}
    if best is None:
        first = next((row["fault"] for row in rows if row["fault"]), "none came to its end")
        return Outcome(
            ["No trial of the sweep has a value."],
            figures,
            failure=f"{config.name}: no trial has a value; the first fault: {first}",
        )
    texts = {key: json.dumps(value) for key, value in best["values"].items()}
    folder.write(folder.path / BEST, dump_config(config.trial(texts, f"{config.name}.best")[0]))
    verdict = [
        f"Trial {best['number']} of {len(rows)} is the best:"
        f" {config.objective.words.removesuffix(' [-]')} {best['value']:.5g}, with"
        f" {', '.join(f'{key} = {text}' for key, text in texts.items())}.",
        f"Its run is {_trial_folder(Path(), best['number'])} in the sweep's folder, and the config"
        f" {BEST} there repeats it.",
    ]
    if by_state["ended early"]:
        verdict.append(f"{len(by_state['ended early'])} trials were ended early.")
    if failed := by_state["failed"]:
        verdict.append(f"{len(failed)} trials failed; the first: {failed[0]['fault']}.")
    if len(finished) > 1:
        verdict.append(
            f"The best of {len(finished)} values is lucky as well as good: judge it on data that"
            " chose nothing, such as the test split of its run."
        )
    figures = {"best": MainFigure(best["value"]), **figures}
    return Outcome(verdict, figures, trials_table(content).text())


def _row(config: SweepConfig, trial: Any) -> dict[str, Any]:
    drawn = {key: trial.params[key] for key in config.space}
    return {
        "number": trial.number,
        "state": _STATES[trial.state.name],
        "value": trial.value if trial.state.name == "COMPLETE" else None,
        "seconds": trial.user_attrs.get("seconds", 0.0),
        "fault": trial.user_attrs.get("fault", ""),
        "values": {k: json.loads(v) if isinstance(v, str) else v for k, v in drawn.items()},
    }


def _importance(study: optuna.Study, finished: int) -> dict[str, float]:
    """Return the share of each key in the variance of the objective; empty for too few trials."""
    if finished < 4:
        return {}
    from optuna.importance import FanovaImportanceEvaluator, get_param_importances

    try:
        found = get_param_importances(study, evaluator=FanovaImportanceEvaluator(seed=0))
    except (RuntimeError, ValueError):
        # all values are alike: there is no variance to share
        return {}
    return {key: float(share) for key, share in found.items()}

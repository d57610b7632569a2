"""Task `sweep`: search over keys of any config by grid, random or TPE search.

Optuna records the trials in a journal, so that an interrupted sweep can be resumed. Each trial is a
run in its own process.
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
from residnet.core.names import suggest_name
from residnet.core.processes import InlineExecutor, IsolatedProcessPool, worker_limit
from residnet.core.progress import Progress, log_message, on_progress, report_progress
from residnet.report.run_reader import RunFiles
from residnet.report.sections.sweep import trials_table
from residnet.runs.folder import RunFolder
from residnet.runs.task import SummaryMetric, Task, TaskOutcome
from residnet.tasks.registry import SweepableConfig

if TYPE_CHECKING:
    import optuna

_MAX_TRIALS = 100_000
"""Maximum number of trials of a sweep."""
_MAX_LOST_PROCESSES = 3
"""Number of lost processes after which a trial has failed."""
_LOCK_TIMEOUT = 10
"""Seconds after which the lock of a killed process is removed."""
_SEED_STRIDE = 7_919
"""Factor that makes the trial seeds of neighbouring search seeds different."""
JOURNAL_FILE, BEST_CONFIG_FILE = "journal.log", "best.yaml"
_STATE_NAMES = {"COMPLETE": "finished", "PRUNED": "ended early", "FAIL": "failed"}


class SearchValues(Config):
    """Values of one key of the base: `choices`, or a range from `low` to `high`.

    Attributes:
        choices: any values of the key, including lists and mappings; null for a range.
        low: lower bound of a range, in the SI unit of the key; if `low` and `high` are integers,
            the values are integers.
        high: upper bound of a range.
        log: sample the range on a logarithmic scale.
        points: number of grid points in the range, including its ends; null for all integers.
    """

    choices: tuple[JsonValue, ...] | None = Field(default=None, min_length=1)
    low: int | float | None = None
    high: int | float | None = None
    log: bool = False
    points: int | None = Field(default=None, ge=2, le=10_000)

    @model_validator(mode="after")
    def _validate_range(self) -> SearchValues:
        if self.choices is not None:
            if self.low is not None or self.high is not None or self.points or self.log:
                raise ValueError("give choices, or low and high, not both")
            if len(set(self._choice_texts)) < len(self.choices):
                raise ValueError("choices: each only once")
        elif self.low is None or self.high is None:
            raise ValueError("give choices, or low and high")
        elif not self.low < self.high:
            raise ValueError(f"low ({self.low:g}) must be less than high ({self.high:g})")
        elif self.log and self.low <= 0:
            raise ValueError(f"low ({self.low:g}) must be above zero where log is true")
        return self

    @property
    def _choice_texts(self) -> list[str]:
        """JSON texts of the choices, which Optuna stores."""
        return [json.dumps(choice) for choice in self.choices or ()]

    @property
    def _is_integer(self) -> bool:
        return isinstance(self.low, int) and isinstance(self.high, int)

    def to_distribution(self) -> Any:
        """Return the Optuna distribution; choices are represented by their JSON texts."""
        from optuna import distributions

        if self.choices is not None:
            return distributions.CategoricalDistribution(self._choice_texts)
        distribution_type: Any = (
            distributions.IntDistribution if self._is_integer else distributions.FloatDistribution
        )
        return distribution_type(self.low, self.high, log=self.log)

    def grid_values(self) -> list[Any]:
        """Return all values of a grid, as represented in the distribution.

        Raises:
            ValueError: if a range of real numbers has no `points`.
        """
        if self.choices is not None:
            return list(self._choice_texts)
        assert self.low is not None
        assert self.high is not None
        if self.points is None:
            if not self._is_integer:
                raise ValueError("a grid needs the number of points of a range")
            return list(range(int(self.low), int(self.high) + 1))
        points_on_range = (np.geomspace if self.log else np.linspace)(
            self.low, self.high, self.points
        )
        # rounding must not move the ends out of the range
        points_on_range[0], points_on_range[-1] = self.low, self.high
        return (
            sorted({round(value) for value in points_on_range.tolist()})
            if self._is_integer
            else points_on_range.tolist()
        )

    def boundary_values(self) -> list[Any]:
        """Return the values that a check tests: all choices, or the ends of a range."""
        return self.grid_values() if self.choices is not None else [self.low, self.high]


class GridSearch(Config):
    """Grid search: every combination of all values.

    Attributes:
        kind: kind of the search.
    """

    kind: Literal["grid"]


class RandomSearch(Config):
    """Random search: values drawn independently for each trial.

    Attributes:
        kind: kind of the search.
        trials: number of trials.
        seed: seed of the random numbers.
    """

    kind: Literal["random"]
    trials: int = Field(ge=1, le=_MAX_TRIALS)
    seed: int = Field(default=0, ge=0)


class TpeSearch(RandomSearch):
    """Bayesian search with Optuna's tree-structured Parzen estimator.

    The values of a trial depend on the trials that ended before, so that a search is reproducible
    with one worker only.

    Attributes:
        startup: number of random trials at the start.
    """

    kind: Literal["tpe"]  # type: ignore[assignment]
    startup: int = Field(default=10, ge=1)


class PruningConfig(Config):
    """Median pruning: end a trial early if its network is worse than the median of other trials.

    The validation errors in free run during training are compared at the same epoch.

    Attributes:
        startup: number of completed trials before any trial is pruned.
        warmup: number of epochs before a trial may be pruned.
    """

    startup: int = Field(default=5, ge=1)
    warmup: int = Field(default=0, ge=0)


class FreeRunObjective(Config):
    """Mean NRMSE of a fit in free run over its validation data, to be minimised.

    The protocol is that of the model selection. Test data are not used.

    Attributes:
        kind: kind of the objective.
        model: name of the model; `selected` for the model that each fit selects.
    """

    kind: Literal["free_run"] = "free_run"
    model: str = "selected"

    is_minimized: ClassVar[bool] = True

    @property
    def monitored_model(self) -> str | None:
        """Model whose training may be pruned; None for `selected`."""
        return None if self.model == "selected" else self.model

    @property
    def description(self) -> str:
        """Label of the objective for tables and axes."""
        return f"validation NRMSE of {self.model} [-]"

    def require_valid_task(self, task: Task) -> None:
        """Check that runs of a task have this objective.

        Raises:
            UsageError: if the task is not a fit, or has no such model.
        """
        if task.task != "fit":
            raise UsageError(
                f"objective: task {task.task} has no free-run error; give objective: {{kind:"
                " figure, name: ..., direction: ...} with a main figure of its summary.json"
            )
        models = ("selected", *task.model_names)  # type: ignore[attr-defined]
        if self.model not in models:
            raise UsageError(
                f"objective.model: no model is named '{self.model}'{suggest_name(self.model, models)}"
            )

    def read_value(self, run: RunFolder) -> float | None:
        """Return the objective of a finished run.

        Raises:
            DataError: if the run has no such error.
        """
        files = RunFiles(run.path)
        model = files.selected if self.model == "selected" else self.model
        row = files.find_row(model, "validation", files.evaluation["selection"])
        if row is None:
            raise DataError(f"{run.metrics}: has no validation error of model '{model}'")
        return float(row["nrmse"]["mean"])


class FigureObjective(Config):
    """A main figure of summary.json as objective.

    Attributes:
        kind: kind of the objective.
        name: name of the figure, for example `cost`.
        direction: `minimize` or `maximize`.
    """

    kind: Literal["figure"]
    name: str
    direction: Literal["minimize", "maximize"] = "minimize"

    # the figure is known at the end of a run only, so that no trial can be pruned
    monitored_model: ClassVar[None] = None

    @property
    def is_minimized(self) -> bool:
        """Whether the figure is minimised."""
        return self.direction == "minimize"

    @property
    def description(self) -> str:
        """Label of the objective for tables and axes."""
        return self.name

    def require_valid_task(self, task: Task) -> None:
        """Check that the figure may be optimised.

        Raises:
            UsageError: if the task is a fit, whose main figures are errors on test data.
        """
        if task.task == "fit":
            raise UsageError(
                "objective: the main figures of a fit are errors on test data, which must not be"
                " used for selection; use objective: {kind: free_run}"
            )

    def read_value(self, run: RunFolder) -> float | None:
        """Return the objective of a finished run.

        Raises:
            DataError: if the run has no such figure.
        """
        summary_figures = run.read_summary()["figures"]
        if self.name not in summary_figures:
            raise DataError(
                f"{run.summary}: has no main figure '{self.name}'{suggest_name(self.name, summary_figures)}"
            )
        figure_value: float | None = summary_figures[self.name]["value"]
        return figure_value


class ProcessesConfig(Config):
    """Parallel processes on this machine.

    Attributes:
        kind: kind of the runner.
        workers: number of processes; null for the number of cores. A single worker runs in the
            main process.
    """

    kind: Literal["processes"] = "processes"
    workers: int | None = Field(default=None, ge=1, le=1_024)

    def require_available(self) -> None:
        """Do nothing: processes need no optional package."""

    @property
    def n_parallel(self) -> int:
        """Number of trials that run in parallel."""
        if self.workers is not None:
            return self.workers
        from joblib import cpu_count

        return int(cpu_count())

    @contextmanager
    def open_executor(self) -> Iterator[Executor]:
        """Open the process pool; an interruption ends all processes. One worker is this process."""
        if self.n_parallel == 1:
            with worker_limit(1):
                yield InlineExecutor()
            return
        with IsolatedProcessPool(self.n_parallel) as pool:
            yield pool

    @property
    def worker_lost_errors(self) -> tuple[type[Exception], ...]:
        """Exceptions of a trial whose process was lost."""
        return (BrokenProcessPool,)


class RayConfig(Config):
    """Tasks of a Ray cluster, or of Ray on this machine.

    All nodes must see the run folder under the same path.

    Attributes:
        kind: kind of the runner.
        workers: number of trials that run in parallel.
        address: address of the cluster, for example `auto` on one of its nodes; null starts Ray on
            this machine.
        cpus: number of cores of a trial.
        gpus: share of a GPU of a trial.
    """

    kind: Literal["ray"]
    workers: int = Field(ge=1, le=100_000)
    address: str | None = None
    cpus: float = Field(default=1.0, gt=0)
    gpus: float = Field(default=0.0, ge=0)

    def require_available(self) -> None:
        """Check that Ray is installed.

        Raises:
            MissingPackageError: if Ray is not installed.
        """
        require_package("ray", "runner.kind: ray", "ray")

    @property
    def n_parallel(self) -> int:
        """Number of trials that run in parallel."""
        return self.workers

    @contextmanager
    def open_executor(self) -> Iterator[Executor]:
        """Connect to Ray within the context.

        Raises:
            FitError: if the cluster cannot be reached, or Ray ends a trial.
        """
        self.require_available()
        import ray

        try:
            ray.init(
                address=self.address,
                # a cluster knows its number of cores
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
    def worker_lost_errors(self) -> tuple[type[Exception], ...]:
        """Exceptions of a trial whose process, node or memory was lost."""
        from ray import exceptions

        return (
            exceptions.WorkerCrashedError,
            exceptions.NodeDiedError,
            exceptions.OutOfMemoryError,
            exceptions.ObjectLostError,
        )


class _RayExecutor(Executor):
    """Executor that submits functions as Ray tasks."""

    def __init__(self, ray: Any, cpus: float, gpus: float) -> None:
        # no retries by Ray: the sweep counts lost processes and repeats their trials
        self._make_remote = ray.remote(num_cpus=cpus, num_gpus=gpus, max_retries=0)

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = self._make_remote(function).remote(*args, **kwargs).future()
        return future


SearchConfig = Annotated[GridSearch | RandomSearch | TpeSearch, Field(discriminator="kind")]
ObjectiveConfig = Annotated[FreeRunObjective | FigureObjective, Field(discriminator="kind")]
RunnerConfig = Annotated[ProcessesConfig | RayConfig, Field(discriminator="kind")]


@final
class SweepConfig(Task):
    """Search over keys of a config; every trial is a separate run.

    Attributes:
        base: config of any task but a sweep: a path, or the name of a config that comes with
            residnet, such as `quickstart`; paths in it are relative to its own folder.
        common: overrides of the base for all trials.
        space: values by key of the base, such as `heads.mlp.hidden`.
        search: search method.
        objective: optimised quantity.
        pruning: early end of poor trials; null for none.
        runner: processes that run the trials.
    """

    section_module: ClassVar[str] = "residnet.report.sections.sweep"

    task: Literal["sweep"]
    base: BaseConfig
    common: tuple[str, ...] = ()
    space: dict[str, SearchValues] = Field(min_length=1)
    search: SearchConfig
    objective: ObjectiveConfig = FreeRunObjective()
    pruning: PruningConfig | None = None
    runner: RunnerConfig = ProcessesConfig()

    @model_validator(mode="after")
    def _validate_sweep(self) -> SweepConfig:
        if isinstance(self.search, GridSearch):
            for key, values in self.space.items():
                try:
                    values.grid_values()
                except ValueError as error:
                    raise ValueError(f"space.{key}: {error}") from None
            if self.n_trials > _MAX_TRIALS:
                raise ValueError(f"space: a grid of {self.n_trials} trials; at most {_MAX_TRIALS}")
        if self.pruning is not None and self.objective.monitored_model is None:
            raise ValueError(
                "pruning: objective must have the kind free_run, and objective.model must name the"
                " network whose training is monitored"
            )
        return self

    @property
    def n_trials(self) -> int:
        """Number of trials of the search; for a grid, the number of combinations."""
        if isinstance(self.search, GridSearch):
            return math.prod(len(values.grid_values()) for values in self.space.values())
        return self.search.trials

    def build_trial(self, values: Mapping[str, Any], name: str) -> tuple[Any, list[str]]:
        """Return the task of a trial and the overrides of its base.

        Args:
            values: values by key, as represented in the distributions.
            name: name of the run.

        Raises:
            ConfigError: if the config is not valid.
        """
        trial_values = {key: values[key] for key in self.space}
        value_overrides = [
            f"{k}={v if isinstance(v, str) else json.dumps(v)}" for k, v in trial_values.items()
        ]
        overrides = [*self.common, *value_overrides, f"name={name}"]
        return load_config(self.base, overrides, SweepableConfig), overrides

    def check(self) -> None:
        """Check the base with each value of the space, the objective and required packages.

        The ends of a range are tested, each with the first values of the other keys.

        Raises:
            ResidnetError: if a config is not valid, or the objective does not fit the task.
        """
        require_package("optuna", "task sweep", "sweep")
        self.runner.require_available()
        first_values = {key: values.boundary_values()[0] for key, values in self.space.items()}
        for key, values in self.space.items():
            for value in values.boundary_values():
                self.build_trial({**first_values, key: value}, f"{self.name}.check")
        task, _ = self.build_trial(first_values, f"{self.name}.check")
        self.objective.require_valid_task(task)
        task.check()

    def input_files(self) -> list[Path]:
        """Return the base and its input files."""
        base = load_config(self.base, self.common, SweepableConfig)
        return [self.base, *base.input_files()]

    def provenance_seed(self) -> int:
        return 0 if isinstance(self.search, GridSearch) else self.search.seed

    def execute(self, folder: RunFolder) -> TaskOutcome:
        """Run all trials and write their results; finished trials are reused.

        Raises:
            ResidnetError: if a trial cannot be run, or the journal is damaged.
        """
        journal = folder.path / JOURNAL_FILE
        for file in (journal, journal.with_name(f"{JOURNAL_FILE}.lock")):
            folder.manifest.record(file, None)
        if journal.is_file():
            # the last line may be incomplete after a kill
            content = journal.read_bytes()
            journal.write_bytes(content[: content.rfind(b"\n") + 1])
        study = open_optuna_study(self, folder.path)
        queue, trial_by_future = TrialQueue(self, study), dict[Future[TrialResult], Any]()
        n_lost, restart_queue = Counter[int](), list[Any]()
        with self.runner.open_executor() as pool:
            while True:
                while len(trial_by_future) < self.runner.n_parallel and (
                    trial := restart_queue.pop(0) if restart_queue else queue.start_next()
                ):
                    trial_arguments = (
                        self,
                        folder.path,
                        trial._trial_id,
                        trial.number,
                        dict(trial.params),
                    )
                    trial_by_future[pool.submit(run_sweep_trial, *trial_arguments)] = trial
                if not trial_by_future:
                    return _write_results(self, study, folder)
                completed, _ = wait(trial_by_future, return_when=FIRST_COMPLETED)
                # in the order of the trial numbers, for reproducible results
                for future in sorted(
                    completed, key=lambda completed_future: trial_by_future[completed_future].number
                ):
                    trial = trial_by_future.pop(future)
                    try:
                        queue.record_result(trial, future.result())
                    except self.runner.worker_lost_errors as error:
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
    path, pruning = str((folder / JOURNAL_FILE).absolute()), config.pruning
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

        self.config, self.study = config, study
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
        n_finished = sum(
            stored_trial.state.is_finished()
            for stored_trial in self.study.get_trials(deepcopy=False)
        )
        report_progress("trials of the sweep", n_finished, self.config.n_trials)
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
    value, is_pruned, error_message = None, False, ""
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
            value, error_message = config.objective.read_value(run), ""
            if value is None or not math.isfinite(value):
                value, error_message = None, f"{run.path}: the objective is not finite"
        except ResidnetError as error:
            error_message = str(error)
    has_provenance = run.provenance.is_file()
    seconds = float(read_json(run.provenance)["seconds"]) if has_provenance else 0.0
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
        state: [row for row in rows if row["state"] == state] for state in _STATE_NAMES.values()
    }
    finished_rows, direction_sign = (
        by_state["finished"],
        1.0 if config.objective.is_minimized else -1.0,
    )
    best_row = min(
        finished_rows, key=lambda row: (direction_sign * row["value"], row["number"]), default=None
    )
    content = {
        "schema": "residnet.sweep/1",
        "run": config.name,
        "objective": config.objective.description,
        "minimized": config.objective.is_minimized,
        "search": config.search.kind,
        "keys": list(config.space),
        "log": [key for key, values in config.space.items() if values.log],
        "best": None if best_row is None else best_row["number"],
        "importance": _parameter_importance(study, len(finished_rows)),
        "trials": rows,
    }
    folder.write_json(folder.path / "sweep.json", content)
    summary_metrics = {
        state_name.replace(" ", "_"): SummaryMetric(len(state_rows))
        for state_name, state_rows in by_state.items()
    }
    if best_row is None:
        first_error = next((row["fault"] for row in rows if row["fault"]), "no trial was completed")
        return TaskOutcome(
            ["No trial of the sweep has a value."],
            summary_metrics,
            failure=f"{config.name}: no trial has a value; the first fault: {first_error}",
        )
    texts = {key: json.dumps(value) for key, value in best_row["values"].items()}
    folder.write(
        folder.path / BEST_CONFIG_FILE,
        dump_config(config.build_trial(texts, f"{config.name}.best")[0]),
    )
    verdict = [
        f"Trial {best_row['number']} of {len(rows)} is the best:"
        f" {config.objective.description.removesuffix(' [-]')} {best_row['value']:.5g}, with"
        f" {', '.join(f'{key} = {text}' for key, text in texts.items())}.",
        f"Its run is {_trial_folder_path(Path(), best_row['number'])} in the sweep's folder, and the config"
        f" {BEST_CONFIG_FILE} there repeats it.",
    ]
    if by_state["ended early"]:
        verdict.append(f"{len(by_state['ended early'])} trials were ended early.")
    if failed_rows := by_state["failed"]:
        verdict.append(f"{len(failed_rows)} trials failed; the first: {failed_rows[0]['fault']}.")
    if len(finished_rows) > 1:
        verdict.append(
            f"The best of {len(finished_rows)} validation errors is biased by the selection: evaluate it"
            " on other data, such as the test split of its run."
        )
    summary_metrics = {"best": SummaryMetric(best_row["value"]), **summary_metrics}
    return TaskOutcome(verdict, summary_metrics, trials_table(content).to_text())


def _trial_row(config: SweepConfig, trial: Any) -> dict[str, Any]:
    trial_values = {key: trial.params[key] for key in config.space}
    return {
        "number": trial.number,
        "state": _STATE_NAMES[trial.state.name],
        "value": trial.value if trial.state.name == "COMPLETE" else None,
        "seconds": trial.user_attrs.get("seconds", 0.0),
        "fault": trial.user_attrs.get("fault", ""),
        "values": {k: json.loads(v) if isinstance(v, str) else v for k, v in trial_values.items()},
    }


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

"""Settings of the task `sweep`: search space, search, objective, pruning and runner."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor, Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, final

import numpy as np
from pydantic import Field, JsonValue, model_validator

from residnet.core.config import BaseConfig, Config, load_config
from residnet.core.errors import DataError, FitError, UsageError, require_package
from residnet.core.names import suggest_name
from residnet.core.processes import InlineExecutor, IsolatedProcessPool, worker_limit
from residnet.report.run_reader import RunFiles
from residnet.runs.folder import RunFolder
from residnet.runs.task import PackageTask, PartName, Task
from residnet.tasks.registry import SweepableConfig

_MAX_TRIALS = 100_000
"""Maximum number of trials of a sweep."""


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


class VariantSearch(Config):
    """Ablation: named variants of a fit, each over several seeds, compared window by window.

    Attributes:
        kind: kind of the search.
        variants: overrides of the base by name of the variant.
        reference: variant with which the others are compared.
        model: model whose free-run errors are compared; `selected` for the model that each run
            selects on validation data.
        split: split of the compared windows.
        seeds: seeds with which each variant is fitted.
    """

    kind: Literal["variants"]
    variants: dict[PartName, tuple[str, ...]] = Field(min_length=2)
    reference: str
    model: str = "selected"
    split: Literal["validation", "test"] = "test"
    seeds: tuple[Annotated[int, Field(ge=0)], ...] = Field(default=(0, 1, 2), min_length=1)

    @model_validator(mode="after")
    def _validate_reference(self) -> VariantSearch:
        if self.reference not in self.variants:
            raise ValueError(
                "reference: no variant is named"
                f" '{self.reference}'{suggest_name(self.reference, self.variants)}"
            )
        if len(set(self.seeds)) < len(self.seeds):
            raise ValueError(f"seeds: each only once, given {list(self.seeds)}")
        return self


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

    The protocol of the model selection is used. Test data are not used.

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
                f"objective.model: no model is named"
                f" '{self.model}'{suggest_name(self.model, models)}"
            )

    def read_value(self, run: RunFolder) -> float | None:
        """Return the objective of a finished run.

        Raises:
            DataError: if the run has no such error.
        """
        files = RunFiles(run.path)
        model = files.selected if self.model == "selected" else self.model
        row = files.find_row(model, "validation", files.selection_protocol)
        if row is None:
            raise DataError(f"{run.metrics}: has no validation error of model '{model}'")
        return row.mean_nrmse


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
        """Whether smaller values of the figure are better."""
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
        summary_figures = run.read_summary().figures
        if self.name not in summary_figures:
            raise DataError(
                f"{run.summary}: has no main figure"
                f" '{self.name}'{suggest_name(self.name, summary_figures)}"
            )
        return summary_figures[self.name].value


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


SearchConfig = Annotated[
    GridSearch | RandomSearch | TpeSearch | VariantSearch, Field(discriminator="kind")
]
ObjectiveConfig = Annotated[FreeRunObjective | FigureObjective, Field(discriminator="kind")]
RunnerConfig = Annotated[ProcessesConfig | RayConfig, Field(discriminator="kind")]


@final
class SweepConfig(PackageTask):
    """Search over keys of a config; every trial is a separate run.

    Attributes:
        base: config of any task but a sweep: a path, or the name of a config that comes with
            residnet, such as `quickstart`; paths in it are relative to its own folder.
        common: overrides of the base for all trials.
        space: values by key of the base, such as `heads.mlp.hidden`; empty with
            `search: {kind: variants}`.
        search: search method, or `variants` of a fit.
        objective: optimised quantity; not used by `variants`.
        pruning: early end of poor trials; null for none.
        runner: processes that run the trials.
    """

    section_module: ClassVar[str] = "residnet.report.sections.sweep"

    task: Literal["sweep"]
    base: BaseConfig
    common: tuple[str, ...] = ()
    space: dict[str, SearchValues] = Field(default_factory=dict)
    search: SearchConfig
    objective: ObjectiveConfig = FreeRunObjective()
    pruning: PruningConfig | None = None
    runner: RunnerConfig = ProcessesConfig()

    @model_validator(mode="after")
    def _validate_sweep(self) -> SweepConfig:
        if isinstance(self.search, VariantSearch):
            if self.space or self.pruning is not None:
                raise ValueError(
                    "search.kind: variants have no search space and no pruning; remove space and"
                    " pruning"
                )
            if not isinstance(self.runner, ProcessesConfig):
                raise ValueError("runner: variants are fitted in processes of this machine")
            return self
        if not self.space:
            raise ValueError("space: missing; give values by key of the base")
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
        if isinstance(self.search, VariantSearch):
            return len(self.search.variants) * len(self.search.seeds)
        return self.search.trials

    def build_variant(self, variant: str, seed: int) -> tuple[Any, list[str]]:
        """Return the fit of a variant with a seed, and the overrides of its base.

        Raises:
            ConfigError: if the config is not valid.
            UsageError: if the base is no fit, or has no model of the compared name.
        """
        assert isinstance(self.search, VariantSearch)
        overrides = [
            *self.common,
            *self.search.variants[variant],
            f"name={self.name}.{variant}.{seed}",
            f"seed={seed}",
        ]
        task = load_config(self.base, overrides, SweepableConfig)
        if task.task != "fit":
            raise UsageError(f"search: variants are compared of a fit, and {self.base} is no fit")
        models = ("selected", *task.model_names)
        if self.search.model not in models:
            raise UsageError(
                f"variant {variant}: no model is named"
                f" '{self.search.model}'{suggest_name(self.search.model, models)}"
            )
        return task, overrides

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
        if isinstance(self.search, VariantSearch):
            for variant in self.search.variants:
                self.build_variant(variant, self.search.seeds[0])[0].check()
            return
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
        """Return the config file that the sweep varies, and the files that it reads."""
        base = load_config(self.base, self.common, SweepableConfig)
        return [self.base, *base.recorded_files()]

    def provenance_seed(self) -> int:
        if isinstance(self.search, VariantSearch):
            return self.search.seeds[0]
        return 0 if isinstance(self.search, GridSearch) else self.search.seed

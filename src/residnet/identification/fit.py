"""Fit baselines, heads (residual models) and ensembles on logs; compare them in free run."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from multiprocessing import get_context
from pathlib import Path
from threading import Event, Thread
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from residnet.core.arrays import paged
from residnet.core.errors import DataError, FitError, MissingPackageError
from residnet.core.model_names import CONSTANT_VELOCITY
from residnet.core.processes import available_cores, process_pool, retain_freed_memory
from residnet.core.progress import (
    Progress,
    begin_stage,
    get_callback,
    log_message,
    on_progress,
    report_progress,
)
from residnet.core.registry import is_python_part
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec, restore_module
from residnet.heads.genetic_config import GeneticConfig
from residnet.identification.bands import calibrate_bands
from residnet.identification.fitter import FitStore, FittedModel, Fitter
from residnet.identification.identified import IdentifiedModels
from residnet.identification.recipe import CANDIDATE_HEADS, LONG_TRAINING_DURATION
from residnet.identification.settings import FitSettings
from residnet.preprocessing.prepare import PreparedLog

if TYPE_CHECKING:
    from residnet.training.trainer import TrainerExtensions

Logs = Mapping[str, Sequence[PreparedLog]]
_MIN_PARALLEL_STEPS = 100_000
"""Number of integration steps from which a training gets a separate process.

So many steps take 13 s, and the start of a process with its imports takes 4.5 s of CPU time.
"""


def fit_models(
    logs: Logs,
    settings: FitSettings,
    *,
    store: FitStore | None = None,
    extensions: TrainerExtensions | None = None,
) -> IdentifiedModels:
    """Fit the baselines, then heads on their residuals, then ensembles.

    Args:
        logs: prepared logs by split; `train` is fitted, `validation` selects and stops early.
        settings: settings of the identification.
        store: saves every finished model and returns finished heads of an interrupted fit; None to
            save nothing.
        extensions: callbacks and logger of the user for trainings; None for none.

    Raises:
        FitError: if the logs do not determine the parameters of a model, or every training
            diverged in free run.
        DataError: if a split has no sample or no window.
    """
    store = store or FitStore()
    fitter = Fitter(logs, settings, store, extensions=extensions)
    if not should_include_validation(fitter.settings, logs["train"]):
        return _fit_all_parts(fitter, logs)
    log_message(
        "  logs are short and validation selects no model: validation logs are used in training"
    )
    logs_with_validation = {**logs, "train": [*logs["train"], *logs["validation"]]}
    return _fit_all_parts(
        Fitter(
            logs_with_validation,
            fitter.settings,
            store,
            resolve_recipe=False,
            validation_in_training=True,
            extensions=extensions,
        ),
        logs_with_validation,
    )


def should_include_validation(settings: FitSettings, train: Sequence[PreparedLog]) -> bool:
    """Return whether a fit also uses the validation logs, as the recipe does for short logs.

    With a few minutes of logs, more training data improve a network more than a selection among
    models does.
    """
    training_duration = sum(len(log) for log in train) * settings.prepare.grid.step
    return settings.recipe is not None and training_duration < LONG_TRAINING_DURATION


def _fit_all_parts(fitter: Fitter, logs: Logs) -> IdentifiedModels:
    """Fit baselines, heads and ensembles, and return the models by name."""
    settings = fitter.settings
    models = {CONSTANT_VELOCITY: fitter.build_constant_velocity()}
    for name in settings.all_baselines:
        with _skip_if_optional(settings, name):
            begin_stage(f"fitting {name}")
            models[name] = fitter.fit_baseline(name)
            log_message(f"  {name}: {_describe_validation(models[name])}")
    _fit_heads(fitter, logs, models)
    for name, members in settings.ensembles.items():
        models[name] = fitter.build_acceleration_ensemble(
            name, [models[member] for member in members]
        )
        log_message(f"  {name}: {_describe_validation(models[name])}")
    for name, members in settings.means.items():
        with _skip_if_optional(settings, name):
            candidate_names = CANDIDATE_HEADS if settings.recipe is not None else ()
            models[name] = fitter.build_trajectory_ensemble(
                name,
                [models[member] for member in members if member in models],
                [models[candidate] for candidate in candidate_names if candidate in models],
            )
            log_message(f"  {name}: {_describe_validation(models[name])}")
    identified = IdentifiedModels(
        settings,
        models,
        fitter.velocity_limits,
        fitter.training_logs,
        fitter.validation_in_training,
    )
    if settings.bands is not None:
        identified.models.update(calibrate_bands(identified, logs["validation"], settings.bands))
        for model in identified.values():
            fitter.store.save(model)
    return identified


@contextmanager
def _skip_if_optional(settings: FitSettings, name: str) -> Iterator[None]:
    """Skip a model that is optional in the recipe, or whose optional package is not installed.

    The recipe skips models that the logs do not determine, except the first one. Heads of kind
    `genetic` can be `optional`.
    """
    head = settings.heads.get(name)
    try:
        yield
    except MissingPackageError as error:
        if not (isinstance(head, GeneticConfig) and head.optional):
            raise
        log_message(f"  {name} is skipped: {error}")
    except (DataError, FitError) as error:
        if settings.recipe is None or name == "baseline":
            raise
        log_message(f"  {name} is skipped: {error}")


def _describe_validation(fitted_model: FittedModel) -> str:
    n_diverged = fitted_model.notes.get("validation_diverged", 0)
    diverged_text = f" ({n_diverged} windows DIVERGED)" if n_diverged else ""
    return f"validation free-run error {fitted_model.notes['validation']:.4f}{diverged_text}"


def _fit_heads(fitter: Fitter, logs: Logs, models: dict[str, FittedModel]) -> None:
    """Fit the heads whose baseline was fitted; all long trainings but one in worker processes."""
    settings = fitter.settings
    n_threads = torch.get_num_threads()
    head_names = [name for name in settings.heads if settings.get_baseline_name(name) in models]
    n_parallel = count_parallel_heads(fitter)
    long_heads = [
        name
        for name in head_names
        if n_parallel > 1
        and is_long_training(fitter, name)
        and fitter.store.load_finished(name) is None
    ]
    # this process would only wait while workers train, so it trains the first head itself; with
    # more long trainings than workers, all of them queue for the pool
    worker_heads = long_heads[1:] if len(long_heads) <= n_parallel else long_heads
    initializer_arguments = (dict(logs), settings, fitter.store.training_folder, n_threads)
    with _forward_progress() if worker_heads else nullcontext() as progress_queue:
        n_workers = min(n_parallel, len(worker_heads))
        executor_context = (
            process_pool(n_workers, _initialize_worker, (*initializer_arguments, progress_queue))
            if worker_heads
            else nullcontext()
        )
        with executor_context as executor:
            futures: dict[str, Any] = {}
            for name in worker_heads:
                fitted_baseline = models[settings.get_baseline_name(name)]
                if executor is not None:
                    futures[name] = executor.submit(
                        _run_in_worker, name, _serialize_model(fitted_baseline)
                    )
            for name in head_names:
                begin_stage(f"fitting {name}")
                with _skip_if_optional(settings, name):
                    if name in futures:
                        models[name] = _deserialize_model(futures[name].result())
                        fitter.store.save(models[name])
                    else:
                        models[name] = fitter.fit_head(
                            name, models[settings.get_baseline_name(name)]
                        )
                    fit_duration = models[name].notes["seconds"]
                    log_message(
                        f"  {name}: {_describe_validation(models[name])} after {fit_duration:.1f} s"
                    )


def count_parallel_heads(fitter: Fitter) -> int:
    """Return how many heads are fitted in parallel.

    Only trainings that take longer than the start of a process run in parallel. Heads are fitted
    one after another if the samples are kept in memory-mapped files, which worker processes would
    have to copy, or if a training already uses a GPU or several processes.
    Callbacks and loggers of the user belong to this process.
    """
    settings = fitter.settings
    is_distributed = any(
        training_config.processes > 1 or training_config.device != "cpu"
        for training_config in settings.training.values()
    )
    if fitter.extensions is not None or is_distributed:
        return 1
    if len(fitter.training_samples) > paged.MAX_SAMPLES_IN_MEMORY:
        return 1
    n_long_trainings = sum(is_long_training(fitter, name) for name in settings.heads)
    return max(min(available_cores() // torch.get_num_threads(), n_long_trainings), 1)


def is_long_training(fitter: Fitter, name: str) -> bool:
    """Return whether the training of a head takes long enough for a separate process."""
    settings = fitter.settings
    training_config = settings.training.get(name)
    # heads in closed form are not trained; a class that only this process registered cannot be
    # built by a worker
    if training_config is None or is_python_part(settings.heads[name]):
        return False
    one_step_config = training_config.one_step
    epochs_and_lengths = [
        (one_step_config.epochs, one_step_config.window),
        *((stage.epochs, stage.horizon) for stage in training_config.multi_step),
    ]
    steps_per_window = (
        sum(epochs * window_duration for epochs, window_duration in epochs_and_lengths)
        / settings.prepare.grid.step
    )
    return training_config.steps * steps_per_window >= _MIN_PARALLEL_STEPS


_SerializedModel = tuple[ModelSpec, dict[str, Any], Tensor | None, dict[str, Tensor]]
"""A fitted model as passed between processes: its description and parameter values."""


def _serialize_model(fitted_model: FittedModel) -> _SerializedModel:
    return (
        fitted_model.spec,
        fitted_model.notes,
        fitted_model.covariance,
        fitted_model.model.state_dict(),
    )


def _deserialize_model(serialized: _SerializedModel) -> FittedModel:
    spec, notes, covariance, state_dict = serialized
    model = restore_module(spec, state_dict)
    assert isinstance(model, HybridDynamics)
    return FittedModel(spec, model, notes, covariance)


_fit_in_worker: Callable[[str, _SerializedModel], _SerializedModel]
"""Function that fits a head on a baseline, set by `_initialize_worker` in each worker process."""


def _initialize_worker(
    logs: Logs, settings: FitSettings, folder: Path | None, n_threads: int, progress_queue: Any
) -> None:
    global _fit_in_worker
    retain_freed_memory()
    torch.set_num_threads(n_threads)
    fitters: list[Fitter] = []

    def fit_head_in_worker(name: str, serialized_baseline: _SerializedModel) -> _SerializedModel:
        with on_progress(progress_queue.put):
            # built at the first head: its samples take memory, and a worker may get no head
            if not fitters:
                fitters.append(Fitter(logs, settings, FitStore(folder), resolve_recipe=False))
            return _serialize_model(
                fitters[0].fit_head(name, _deserialize_model(serialized_baseline))
            )

    _fit_in_worker = fit_head_in_worker


def _run_in_worker(name: str, serialized_baseline: _SerializedModel) -> _SerializedModel:
    return _fit_in_worker(name, serialized_baseline)


@contextmanager
def _forward_progress() -> Iterator[Any]:
    """Provide a queue that forwards progress reports of workers to the callback of this process."""
    callback = get_callback()
    stop_event = Event()
    progress_queue: Any = get_context("spawn").SimpleQueue()

    def forward_reports() -> None:
        with on_progress(callback):
            while (
                # after the stop event the reports still in the queue are forwarded before the
                # thread ends
                not stop_event.wait(0.0 if not progress_queue.empty() else 0.1)
                or not progress_queue.empty()
            ):
                while not progress_queue.empty():
                    progress: Progress = progress_queue.get()
                    report_progress(
                        progress.stage,
                        progress.done,
                        progress.total,
                        progress.message,
                        progress.score,
                    )

    thread = Thread(target=forward_reports, daemon=True)
    thread.start()
    try:
        yield progress_queue
    finally:
        stop_event.set()
        thread.join(1.0)

"""The fit: prepared logs to baselines, heads and ensembles, judged in free run."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from multiprocessing import get_context
from pathlib import Path
from threading import Event, Thread
from typing import Any

import torch
from torch import Tensor

from residnet.core.arrays import paged
from residnet.core.errors import DataError, FitError, MissingPackageError
from residnet.core.processes import free_cores, keep_freed_memory, processes
from residnet.core.progress import Progress, begin, listen, listener, report, say
from residnet.data.prepare import Prepared
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec, restored
from residnet.heads.base import ClosedFormHead
from residnet.heads.genetic import GeneticConfig
from residnet.identification.bands import calibrate_bands
from residnet.identification.fitter import FitStore, FittedModel, Fitter
from residnet.identification.identified import Identified
from residnet.identification.recipe import LONG
from residnet.identification.settings import FitSettings
from residnet.training.config import TrainingConfig

Logs = Mapping[str, Sequence[Prepared]]
_LONG_TRAINING = 100_000
"""Steps of windows that a training runs through, from which it is worth a process of its own: they
take 13 s, and a process that imports all that it needs 4.5 s of a processor.
"""


def fit(logs: Logs, settings: FitSettings, *, store: FitStore | None = None) -> Identified:
    """Fit the baselines, then heads on what each leaves, then ensembles.

    Args:
        logs: prepared logs by split; `train` is fitted, `validation` chooses and stops early.
        store: keeps every model as it is done and hands finished heads back; None to keep none.

    Raises:
        FitError: where the data do not determine a part, or a training never ran freely.
        DataError: where a split holds no sample or no window.
    """
    store = store or FitStore()
    fitter = Fitter(logs, settings, store)
    if not final_fit(fitter.settings, logs["train"]):
        return _fitted(fitter, logs)
    say("  logs are short, and nothing is chosen: validation logs are fitted too")
    whole = {**logs, "train": [*logs["train"], *logs["validation"]]}
    return _fitted(Fitter(whole, fitter.settings, store, settle=False, seen=True), whole)


def final_fit(settings: FitSettings, train: Sequence[Prepared]) -> bool:
    """Return whether a fit uses the validation logs too: the recipe's does, of short logs.

    A quarter of five minutes tells networks more than it tells a choice.
    """
    seconds = sum(len(log) for log in train) * settings.prepare.grid.step
    return settings.recipe is not None and seconds < LONG


def _fitted(fitter: Fitter, logs: Logs) -> Identified:
    """Fit all parts on the training logs."""
    settings = fitter.settings
    models = {"zero": fitter.zero()}
    for name in settings.all_baselines:
        with _optional(settings, name):
            begin(f"fitting {name}")
            models[name] = fitter.baseline(name)
            say(f"  {name}: {_said(models[name])}")
    _fit_heads(fitter, logs, models)
    for name, members in settings.ensembles.items():
        models[name] = fitter.ensemble(name, [models[member] for member in members])
        say(f"  {name}: {_said(models[name])}")
    for name, members in settings.means.items():
        with _optional(settings, name):
            models[name] = fitter.mean(name, [models[one] for one in members if one in models])
            say(f"  {name}: {_said(models[name])}")
    identified = Identified(settings, models, fitter.limit, fitter.train, fitter.seen)
    if settings.bands is not None:
        identified.models.update(calibrate_bands(identified, logs["validation"], settings.bands))
        for model in identified.values():
            fitter.store.keep(model)
    return identified


@contextmanager
def _optional(settings: FitSettings, name: str) -> Iterator[None]:
    """Leave a model out that the recipe can do without, or whose optional package is not installed.

    The recipe does without what the logs do not determine, except its first model. A head of kind
    `genetic` can be `optional`.
    """
    head = settings.heads.get(name)
    try:
        yield
    except MissingPackageError as error:
        if not (isinstance(head, GeneticConfig) and head.optional):
            raise
        say(f"  {name} is left out: {error}")
    except (DataError, FitError) as error:
        if settings.recipe is None or name == "baseline":
            raise
        say(f"  {name} is left out: {error}")


def _said(fitted: FittedModel) -> str:
    diverged = fitted.notes.get("validation_diverged", 0)
    lost = f" ({diverged} windows DIVERGED)" if diverged else ""
    return f"validation free-run error {fitted.notes['validation']:.4f}{lost}"


def _fit_heads(fitter: Fitter, logs: Logs, models: dict[str, FittedModel]) -> None:
    """Fit the heads whose baseline is there, long trainings but one in processes of their own."""
    settings, threads = fitter.settings, torch.get_num_threads()
    heads = [name for name in settings.heads if settings.baseline_name_of(name) in models]
    places = side_by_side(fitter)
    long = [
        name
        for name in heads
        if places > 1 and is_long(fitter, name) and fitter.store.finished(name) is None
    ]
    # this process trains the first itself, where each of the others has one
    apart = long[1:] if len(long) <= places else long
    given = (dict(logs), settings, fitter.store.training_folder, threads)
    with _heard() if apart else nullcontext() as wire:
        workers = min(places, len(apart))
        pooled = processes(workers, _begin, (*given, wire)) if apart else nullcontext()
        with pooled as pool:
            there: dict[str, Any] = {}
            for name in apart:
                base = models[settings.baseline_name_of(name)]
                if pool is not None:
                    there[name] = pool.submit(_fit_there, name, _sent(base))
            for name in heads:
                begin(f"fitting {name}")
                with _optional(settings, name):
                    if name in there:
                        models[name] = _opened(there[name].result())
                        fitter.store.keep(models[name])
                    else:
                        models[name] = fitter.head(name, models[settings.baseline_name_of(name)])
                    seconds = models[name].notes["seconds"]
                    say(f"  {name}: {_said(models[name])} after {seconds:.1f} s")


def side_by_side(fitter: Fitter) -> int:
    """Return how many heads are to be fitted at a time.

    Only what takes longer than a process needs to start is worth one. Large logs lie in files that
    processes do not share, and a GPU and trainings in several processes are shared out already.
    """
    settings = fitter.settings
    trainings = [settings.training.get(name, TrainingConfig()) for name in settings.heads]
    elsewhere = any(t.processes > 1 or t.device != "cpu" for t in trainings)
    if elsewhere or len(fitter.samples) > paged.LARGE:
        return 1
    long = sum(is_long(fitter, name) for name in settings.heads)
    return max(min(free_cores() // torch.get_num_threads(), long), 1)


def is_long(fitter: Fitter, name: str) -> bool:
    """Return whether a head is trained through so many steps that a process pays."""
    settings = fitter.settings
    if isinstance(settings.heads[name].build(fitter.signals.names), ClosedFormHead):
        return False
    training = settings.training.get(name, TrainingConfig())
    first = training.one_step
    stages = [(first.epochs, first.window), *((s.epochs, s.horizon) for s in training.multi_step)]
    steps = sum(epochs * length for epochs, length in stages) / settings.prepare.grid.step
    return training.steps * steps >= _LONG_TRAINING


_Sent = tuple[ModelSpec, dict[str, Any], Tensor | None, dict[str, Tensor]]
"""A fitted model as it goes from one process to another: numbers in place of modules."""


def _sent(fitted: FittedModel) -> _Sent:
    return fitted.spec, fitted.notes, fitted.covariance, fitted.model.state_dict()


def _opened(sent: _Sent) -> FittedModel:
    spec, notes, covariance, state = sent
    model = restored(spec, state)
    assert isinstance(model, HybridDynamics)
    return FittedModel(spec, model, notes, covariance)


_work: Callable[[str, _Sent], _Sent]
"""Fits a head on a baseline, in a process that `_begin` has prepared."""


def _begin(logs: Logs, settings: FitSettings, folder: Path | None, threads: int, wire: Any) -> None:
    global _work
    keep_freed_memory()
    torch.set_num_threads(threads)
    made: list[Fitter] = []

    def work(name: str, base: _Sent) -> _Sent:
        with listen(wire.put):
            if not made:
                made.append(Fitter(logs, settings, FitStore(folder), settle=False))
            return _sent(made[0].head(name, _opened(base)))

    _work = work


def _fit_there(name: str, base: _Sent) -> _Sent:
    return _work(name, base)


@contextmanager
def _heard() -> Iterator[Any]:
    """Hold a queue whose reports of progress reach who listens to this process."""
    callback, over = listener(), Event()
    wire: Any = get_context("spawn").SimpleQueue()

    def hand_on() -> None:
        with listen(callback):
            while not over.wait(0.0 if not wire.empty() else 0.1) or not wire.empty():
                while not wire.empty():
                    one: Progress = wire.get()
                    report(one.stage, one.done, one.total, one.message, one.score)

    thread = Thread(target=hand_on, daemon=True)
    thread.start()
    try:
        yield wire
    finally:
        over.set()
        thread.join(1.0)

"""The baselines and heads of a fit: what each needs first, one after the other or side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from contextlib import contextmanager
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from threading import Event, Thread
from typing import Any, Protocol

import torch
from torch import Tensor

from residnet.core.arrays import paged
from residnet.core.arrays.heap import keep_freed_memory
from residnet.core.processes import ThisProcess, free_cores, processes
from residnet.core.progress import Progress, listen, listener, report, say
from residnet.data.prepare import Prepared
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec, restored
from residnet.heads import ClosedFormHead
from residnet.identification.fitter import FittedPart, Fitter
from residnet.identification.models import FitStore, FittedModel, NoStore
from residnet.identification.settings import FitSettings
from residnet.training.config import TrainingConfig

Logs = Mapping[str, Sequence[Prepared]]
_LONG_TRAINING = 20_000
"""Steps of windows that a training runs through, from which it is worth a process of its own."""
_LONG_REFIT = 5_000
"""Training samples from which a refit with a choice among priors is."""


@dataclass(frozen=True)
class Part:
    """A baseline or a head, which is fitted by itself once the models are there that it needs.

    Attributes:
        name: of the model.
        needs: models that have to be fitted before: for a head its baseline, then the head whose
            weights its training starts from, if there is one.
        learned: whether it is a head.
    """

    name: str
    needs: tuple[str, ...]
    learned: bool

    def fitted_by(self, fitter: Fitter, models: Mapping[str, FittedModel]) -> FittedPart:
        """Fit it on models that are there."""
        if not self.learned:
            return fitter.baseline(self.name)
        base, *begin = (models[name] for name in self.needs)
        return FittedPart(fitter.head(self.name, base, begin[0] if begin else None))


def parts_of(settings: FitSettings) -> list[Part]:
    """Return the baselines, then the heads, in the order of the settings."""
    parts = [Part(name, (), learned=False) for name in settings.all_baselines]
    for name in settings.heads:
        begin = settings.training[name].begin_with if name in settings.training else None
        base = settings.baseline_name_of(name)
        parts.append(Part(name, (base,) if begin is None else (base, begin), learned=True))
    return parts


class Guard(Protocol):
    """What decides whether a fit goes on without a part that failed."""

    def __call__(self, settings: FitSettings, name: str) -> Any:
        """Return a context that passes on, or swallows, what the fit of a part raises."""


def fit_parts(
    fitter: Fitter, logs: Logs, settings: FitSettings, models: dict[str, FittedModel], guard: Guard
) -> None:
    """Fit all baselines and heads, and add them to the models in the order of the settings.

    Args:
        fitter: of the fit.
        logs: prepared logs by split that it was made of.
        settings: that it was made of.
        models: that are there; what is fitted comes to them.
        guard: swallows what a part raises that the fit can do without.
    """
    waiting = parts_of(fitter.settings)
    order = [part.name for part in waiting]
    running: dict[Future[FittedPart], Part] = {}
    found: dict[str, FittedPart] = {}
    with _bench(fitter, logs, settings, waiting) as bench:
        while waiting or running:
            to_come = {part.name for part in (*waiting, *running.values())}
            waiting = [p for p in waiting if all(n in models or n in to_come for n in p.needs)]
            ready = [part for part in waiting if all(name in models for name in part.needs)]
            for part in ready[: bench.places - len(running)]:
                waiting.remove(part)
                if part.learned:
                    say(f"  fitting {part.name}")
                running[bench.submit(part, models)] = part
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                part = running.pop(future)
                with guard(fitter.settings, part.name):
                    found[part.name] = bench.received(future)
                    models[part.name] = found[part.name].model
                    say(f"  {part.name}: {_said(part, models[part.name])}")
    for name in (name for name in order if name in found):
        fitter.adopt(found[name])
        models[name] = models.pop(name)


def said(fitted: FittedModel) -> str:
    """Return the validation error of a model in words, its divergences beside it."""
    diverged = fitted.notes.get("validation_diverged", 0)
    lost = f" ({diverged} windows DIVERGED)" if diverged else ""
    return f"validation free-run error {fitted.notes['validation']:.4f}{lost}"


def _said(part: Part, fitted: FittedModel) -> str:
    return said(fitted) + (f" after {fitted.notes['seconds']:.1f} s" if part.learned else "")


class _Bench(Protocol):
    """Where parts are fitted."""

    @property
    def places(self) -> int:
        """Parts at a time."""

    def submit(self, part: Part, models: Mapping[str, FittedModel]) -> Future[Any]:
        """Begin to fit a part."""

    def received(self, future: Future[Any]) -> FittedPart:
        """Return a fitted part, or raise what its fit raised."""


@contextmanager
def _bench(
    fitter: Fitter, logs: Logs, settings: FitSettings, parts: Sequence[Part]
) -> Iterator[_Bench]:
    """Hold processes where several parts take long and cores are free; else this one."""
    places = side_by_side(fitter, parts)
    if places == 1:
        yield _Here(fitter)
        return
    with (
        _heard() as wire,
        processes(
            places,
            _begin,
            (dict(logs), settings, fitter.store.training_folder, torch.get_num_threads(), wire),
        ) as pool,
    ):
        yield _There(pool, places, fitter.store)


def side_by_side(fitter: Fitter, parts: Sequence[Part]) -> int:
    """Return how many parts are to be fitted at a time.

    Only what takes longer than a process needs to start is worth one. Large logs lie in files that
    processes do not share, and a GPU and trainings in several processes are shared out already.
    """
    settings, samples = fitter.settings, len(fitter.samples)
    trainings = {n: settings.training.get(n, TrainingConfig()) for n in settings.heads}
    elsewhere = any(t.processes > 1 or t.device != "cpu" for t in trainings.values())
    if elsewhere or samples > paged.LARGE:
        return 1
    step, names = settings.prepare.grid.step, fitter.signals.names
    long = [
        part
        for part in parts
        if (
            not isinstance(settings.heads[part.name].build(names), ClosedFormHead)
            and _windows_run(trainings[part.name], step) >= _LONG_TRAINING
            if part.learned
            else part.name in settings.refit
            and len(settings.refit[part.name].priors) > 1
            and samples >= _LONG_REFIT
        )
    ]
    return max(min(free_cores() // torch.get_num_threads(), len(long)), 1)


def _windows_run(training: TrainingConfig, step: float) -> float:
    """Return the steps of windows that a training runs through."""
    first = training.one_step
    stages = [(first.epochs, first.window), *((s.epochs, s.horizon) for s in training.multi_step)]
    return training.steps * sum(epochs * length / step for epochs, length in stages)


class _Here:
    """One part after the other, in this process."""

    places = 1

    def __init__(self, fitter: Fitter) -> None:
        self._fitter = fitter

    def submit(self, part: Part, models: Mapping[str, FittedModel]) -> Future[Any]:
        """Fit a part at once."""
        return ThisProcess().submit(part.fitted_by, self._fitter, models)

    def received(self, future: Future[Any]) -> FittedPart:
        """Return the part, or raise what its fit raised."""
        result: FittedPart = future.result()
        return result


class _There:
    """Several parts at a time, in processes of their own; this one keeps what they make."""

    def __init__(self, pool: Executor, places: int, store: FitStore) -> None:
        self.places = places
        self._pool = pool
        self._store = store

    def submit(self, part: Part, models: Mapping[str, FittedModel]) -> Future[Any]:
        """Hand a part over; a head that an earlier fit had finished is taken from the store."""
        done = self._store.finished(part.name) if part.learned else None
        if done is not None:
            return ThisProcess().submit(_Sent.of, FittedPart(done))
        needed = {name: _Sent.of(FittedPart(models[name])) for name in part.needs}
        return self._pool.submit(_fit_there, part, needed)

    def received(self, future: Future[Any]) -> FittedPart:
        """Build the model that was sent, and keep it."""
        sent: _Sent = future.result()
        part = sent.opened()
        self._store.keep(part.model)
        return part


@dataclass(frozen=True)
class _Sent:
    """A fitted part as it goes from one process to another: numbers in place of modules."""

    part: FittedPart
    state: dict[str, Tensor]

    @classmethod
    def of(cls, part: FittedPart) -> _Sent:
        """Take the module out."""
        bare: Any = replace(part.model, model=None)  # type: ignore[arg-type]
        return cls(replace(part, model=bare), part.model.model.state_dict())

    def opened(self) -> FittedPart:
        """Build the module again."""
        spec: ModelSpec = self.part.model.spec
        model = restored(spec, self.state)
        assert isinstance(model, HybridDynamics)
        return replace(self.part, model=replace(self.part.model, model=model))


class _Trainings(NoStore):
    """Keeps no model, but the checkpoints of trainings."""

    def __init__(self, folder: Path | None) -> None:
        self.training_folder = folder


_fitter: Callable[[], Fitter]
"""Makes the fitter of a process that fits parts for another one."""
_tell: Callable[[Progress], None]
"""Takes the progress there."""


def _begin(
    logs: Logs, settings: FitSettings, folder: Path | None, threads: int, wire: _Wire
) -> None:
    """Prepare a process for parts of a fit."""
    global _fitter, _tell
    keep_freed_memory()
    torch.set_num_threads(threads)
    made: list[Fitter] = []

    def fitter() -> Fitter:
        if not made:
            made.append(Fitter(logs, settings, _Trainings(folder)))
        return made[0]

    _fitter, _tell = fitter, wire


def _fit_there(part: Part, needed: Mapping[str, _Sent]) -> _Sent:
    """Fit a part in a process that `_begin` has prepared."""
    with listen(_tell):
        models = {name: sent.opened().model for name, sent in needed.items()}
        return _Sent.of(part.fitted_by(_fitter(), models))


@dataclass(frozen=True)
class _Wire:
    """The way of progress out of the processes; they write one at a time."""

    sender: Any
    lock: Any

    def __call__(self, progress: Progress) -> None:
        """Send a report."""
        with self.lock:
            self.sender.send(progress)


@contextmanager
def _heard() -> Iterator[_Wire]:
    """Hold a wire whose reports of progress reach who listens to this process."""
    context, callback, over = get_context("spawn"), listener(), Event()
    receiver, sender = context.Pipe(duplex=False)

    def hand_on() -> None:
        with listen(callback):
            while receiver.poll(0.0 if over.is_set() else 0.1) or not over.is_set():
                if receiver.poll():
                    one = receiver.recv()
                    report(one.stage, one.done, one.total, one.message, one.score)

    thread = Thread(target=hand_on, daemon=True)
    thread.start()
    try:
        yield _Wire(sender, context.Lock())
    finally:
        # the lock is left alone: a process that was ended may have held it
        over.set()
        thread.join(1.0)

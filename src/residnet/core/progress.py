"""Progress of long work: one callback hears of it, on the command line and in Python alike.

Code that takes long calls `report_progress`. Whoever wants to hear of it installs a callback with `on_progress`;
without one nothing is printed. The callback is held in a context variable, so that it need not be
handed through every function, and so that two threads can listen separately.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass


@dataclass(frozen=True)
class Progress:
    """One report of long work.

    Attributes:
        stage: what is being done, for example `training lstm`.
        done: how much of it is done, in any unit; None where the work cannot be counted.
        total: how much there is to do in the same unit; None where it is not known.
        message: a line for the log; empty where there is only a count.
        score: of a training by then, its best validation error in free run; None where there is
            none.
    """

    stage: str
    done: float | None = None
    total: float | None = None
    message: str = ""
    score: float | None = None


ProgressCallback = Callable[[Progress], None]

_callback: ContextVar[ProgressCallback | None] = ContextVar("residnet_progress", default=None)


def report_progress(
    stage: str,
    done: float | None = None,
    total: float | None = None,
    message: str = "",
    score: float | None = None,
) -> None:
    """Tell the callback that listens, if there is one, how far a stage is.

    Args:
        done: how much of it is done, in any unit; None where the work cannot be counted.
        total: how much there is to do in the same unit; None where it is not known.
        score: best validation error in free run of a training by then.
    """
    callback = _callback.get()
    if callback is not None:
        callback(Progress(stage, done, total, message, score))


def get_callback() -> ProgressCallback | None:
    """Return the callback that listens, for threads, which do not inherit it; None for none."""
    return _callback.get()


def log_message(message: str) -> None:
    """Tell the callback that listens, if there is one, what the work has found."""
    report_progress("", message=message)


def begin_stage(stage: str) -> None:
    """Tell the callback that listens, if there is one, what is being done from now on."""
    report_progress(stage, message=f"  {stage}")


@contextmanager
def on_progress(callback: ProgressCallback | None) -> Iterator[None]:
    """Send the progress of everything within the context to `callback`; None keeps silent."""
    token = _callback.set(callback)
    try:
        yield
    finally:
        _callback.reset(token)

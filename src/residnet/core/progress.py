"""Report the progress of long computations to one callback.

Long computations call `report_progress`. The command line or a program installs a callback with
`on_progress`; without one nothing is printed. The callback is a context variable, so that it is not
passed through every function and each thread can have its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass


@dataclass(frozen=True)
class Progress:
    """One progress report.

    Attributes:
        stage: name of the current step, for example `training lstm`.
        done: completed amount in any unit; None if it cannot be counted.
        total: total amount in the same unit; None if unknown.
        message: line for the log; empty for a pure count.
        score: best validation error in free run of a training so far; None before the first.
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
    """Send a progress report to the installed callback, if any.

    Args:
        stage: name of the current step.
        done: completed amount in any unit; None if it cannot be counted.
        total: total amount in the same unit; None if unknown.
        message: line for the log.
        score: best validation error in free run of a training so far.
    """
    callback = _callback.get()
    if callback is not None:
        callback(Progress(stage, done, total, message, score))


def get_callback() -> ProgressCallback | None:
    """Return the installed callback, to install it in a new thread; None without a callback."""
    return _callback.get()


def log_message(message: str) -> None:
    """Send a log message to the installed callback, if any."""
    report_progress("", message=message)


def begin_stage(stage: str) -> None:
    """Report the start of a stage to the installed callback, if any."""
    report_progress(stage, message=f"  {stage}")


@contextmanager
def on_progress(callback: ProgressCallback | None) -> Iterator[None]:
    """Install a callback for progress reports within the context; None discards them."""
    token = _callback.set(callback)
    try:
        yield
    finally:
        _callback.reset(token)

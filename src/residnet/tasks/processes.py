"""Work in processes side by side, which end with the process that began them."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import active_children, connection, get_context, parent_process
from threading import Thread
from typing import Any

from residnet.core.errors import FitError


@contextmanager
def processes(workers: int) -> Iterator[Executor]:
    """Hold processes for work side by side; an interruption ends them all at once.

    Args:
        workers: number of processes; each is started when it is first needed.

    Raises:
        FitError: where the system ends one of the processes.
    """
    with ProcessPoolExecutor(
        workers, mp_context=get_context("spawn"), initializer=begin_worker
    ) as pool:
        try:
            yield pool
        except BrokenProcessPool as error:
            raise FitError(
                "workers: the system has ended one of the processes; the memory may not be enough"
                " for so many side by side, so give fewer and continue with --resume"
            ) from error
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in active_children():
                process.terminate()
            raise


class ThisProcess(Executor):
    """An executor that does its work at once, in the process that hands it over."""

    def submit(self, work: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Do the work; returns a future that is done."""
        future: Future[Any] = Future()
        future.set_result(work(*args, **kwargs))
        return future


def begin_worker() -> None:
    """Leave Ctrl-C to the process that began this one, and end with it, however it ends.

    Ctrl-C reaches every process of a terminal; a process that is killed cannot tell its children.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    if parent is not None:
        Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    connection.wait([sentinel])
    os._exit(1)

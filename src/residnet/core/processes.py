"""Work in processes side by side, which end with the one that began them; memory that they keep."""

from __future__ import annotations

import ctypes
import os
import platform
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from contextvars import ContextVar
from multiprocessing import active_children, connection, get_context, parent_process
from threading import Thread
from typing import Any

from residnet.core.errors import FitError
from residnet.core.trust import is_trusted, set_trusted

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
"""Numbers of the settings in malloc.h of the GNU C library."""
_MAX_KEPT_BYTES = 128 << 20
_MAX_REUSED_BYTES = 64 << 20


def retain_freed_memory() -> None:
    """Let this process keep up to 128 MB of freed memory, so that tensors find it ready again.

    By default the GNU C library gives the memory of tensors back when they are freed, and each new
    one has to be filled with zeros page by page: a third of the time of training an LSTM of 100
    units. Larger arrays than 64 MB are given back as before. Other C libraries are left alone.
    """
    if platform.libc_ver()[0] != "glibc":
        return
    library = ctypes.CDLL(None)
    library.mallopt(_MMAP_THRESHOLD, _MAX_REUSED_BYTES)
    library.mallopt(_TRIM_THRESHOLD, _MAX_KEPT_BYTES)


_core_limit: ContextVar[int] = ContextVar("residnet_cores", default=1)


def available_cores() -> int:
    """Return how many cores work may spread over, where nobody names a number of processes.

    One, unless `worker_limit` says otherwise: a new process imports the program that it belongs to again,
    and a program of the user's own need not be made for that.
    """
    return _core_limit.get()


@contextmanager
def worker_limit(cores: int | None = None) -> Iterator[None]:
    """Let the work within the context spread over several cores.

    Args:
        cores: number of them; None for all that this process may use.
    """
    if cores is None:
        from joblib import cpu_count

        cores = int(cpu_count())
    token = _core_limit.set(cores)
    try:
        yield
    finally:
        _core_limit.reset(token)


@contextmanager
def process_pool(
    workers: int,
    initializer: Callable[..., None] | None = None,
    initializer_arguments: tuple[Any, ...] = (),
) -> Iterator[Executor]:
    """Hold processes for work side by side; an interruption ends them all at once.

    Args:
        workers: number of processes; each is started when it is first needed.
        initializer: is called once in each process, before its first work.
        initializer_arguments: to `initializer`.

    Raises:
        FitError: where the system ends one of the processes.
    """
    with _make_pool(workers, initializer, initializer_arguments) as pool:
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


def _make_pool(
    workers: int,
    initializer: Callable[..., None] | None = None,
    initializer_arguments: tuple[Any, ...] = (),
) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(
        workers,
        get_context("spawn"),
        initializer=_begin_pooled,
        initargs=(is_trusted(), initializer, initializer_arguments),
    )


class IsolatedProcessPool(Executor):
    """Processes of which one that the system ends loses its own work alone, and is replaced.

    That work ends with a `BrokenProcessPool`. Leaving a `with` block by an exception ends all
    processes at once.

    Args:
        workers: number of processes, and of the works that may be under way.
    """

    def __init__(self, workers: int) -> None:
        # one pool for each: a lost process ends its whole pool
        self._pools = [_make_pool(1) for _ in range(workers)]
        self._last_futures: list[Future[Any] | None] = [None] * workers

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Hand work to a process that is free."""
        free_index = next(
            i
            for i, last_future in enumerate(self._last_futures)
            if last_future is None or last_future.done()
        )
        try:
            future = self._pools[free_index].submit(function, *args, **kwargs)
        except BrokenProcessPool:
            self._pools[free_index].shutdown()
            self._pools[free_index] = _make_pool(1)
            future = self._pools[free_index].submit(function, *args, **kwargs)
        self._last_futures[free_index] = future
        return future

    def shutdown(self, wait_for_work: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes, after their work where it is waited for."""
        for pool in self._pools:
            pool.shutdown(wait_for_work, cancel_futures=cancel_futures)

    def __exit__(self, error_type: Any, error: Any, traceback: Any) -> None:
        if error_type is not None:
            self.shutdown(wait_for_work=False, cancel_futures=True)
            for process in active_children():
                process.terminate()
        self.shutdown()


class InlineExecutor(Executor):
    """An executor that does its work at once, in the process that hands it over."""

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Do the work; returns a future that is done, with what the work raised where it failed."""
        future: Future[Any] = Future()
        try:
            future.set_result(function(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def _begin_pooled(
    trust: bool, begin: Callable[..., None] | None = None, given: tuple[Any, ...] = ()
) -> None:
    """Take over what the parent may load, then begin as every worker."""
    set_trusted(trust)
    initialise_worker(begin, given)


def initialise_worker(
    initializer: Callable[..., None] | None = None, initializer_arguments: tuple[Any, ...] = ()
) -> None:
    """Leave Ctrl-C to the process that began this one, and end with it, however it ends.

    Ctrl-C reaches every process of a terminal; a process that is killed cannot tell its children.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    if parent is not None:
        Thread(target=_exit_with_parent, args=(parent.sentinel,), daemon=True).start()
    if initializer is not None:
        initializer(*initializer_arguments)


def _exit_with_parent(sentinel: int) -> None:
    connection.wait([sentinel])
    os._exit(1)

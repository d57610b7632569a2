"""Process pools whose workers end with their parent, and reuse of freed memory."""

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

# numbers of the parameters of `mallopt` in malloc.h of the GNU C library, not defined in Python
_TRIM_THRESHOLD = -1
"""M_TRIM_THRESHOLD: bytes of free memory above which it is returned to the system."""
_MMAP_THRESHOLD = -3
"""M_MMAP_THRESHOLD: size in bytes from which a block is allocated and returned separately."""
_MAX_KEPT_BYTES = 128 << 20
"""Freed memory in bytes that the process retains at most."""
_MAX_REUSED_BYTES = 64 << 20
"""Size in bytes of a block above which it is returned to the system at once."""


def retain_freed_memory() -> None:
    """Let this process retain up to 128 MB of freed memory for new tensors.

    By default the GNU C library returns the memory of freed tensors to the system, and the system
    clears each page of a new tensor: a third of the time of training an LSTM of 100 units. Arrays
    above 64 MB are returned as before. Other C libraries are not changed.
    """
    if platform.libc_ver()[0] != "glibc":
        return
    library = ctypes.CDLL(None)
    library.mallopt(_MMAP_THRESHOLD, _MAX_REUSED_BYTES)
    library.mallopt(_TRIM_THRESHOLD, _MAX_KEPT_BYTES)


_core_limit: ContextVar[int] = ContextVar("residnet_cores", default=1)


def available_cores() -> int:
    """Return the default number of worker processes, set by `worker_limit`.

    The default is one, because a new process imports the main program again, and the program of a
    user may not be protected against that.
    """
    return _core_limit.get()


@contextmanager
def worker_limit(cores: int | None = None) -> Iterator[None]:
    """Set the default number of worker processes within the context.

    Args:
        cores: number of processes; None for all cores that this process may use.
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
    """Create a process pool; an exception within the context terminates all workers.

    Args:
        workers: largest number of processes; each is started when it is first needed.
        initializer: called once in each process before its first task.
        initializer_arguments: arguments of `initializer`.

    Raises:
        FitError: if the system kills one of the processes.
    """
    with _make_pool(workers, initializer, initializer_arguments) as pool:
        try:
            yield pool
        except BrokenProcessPool as error:
            raise FitError(
                "workers: the system killed a process, possibly because the memory is exhausted;"
                " use fewer workers and continue with --resume"
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
        initializer=_initialise_pooled_worker,
        initargs=(is_trusted(), initializer, initializer_arguments),
    )


class IsolatedProcessPool(Executor):
    """Executor whose processes fail independently of each other.

    If the system kills a process, only its task fails, with a `BrokenProcessPool`, and the process
    is replaced. Leaving a `with` block by an exception terminates all processes.

    Args:
        workers: number of processes, and of tasks that may run at the same time.
    """

    def __init__(self, workers: int) -> None:
        # one pool per process, because a killed process breaks its whole pool
        self._pools = [_make_pool(1) for _ in range(workers)]
        self._last_futures: list[Future[Any] | None] = [None] * workers

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Submit a task to an idle process."""
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
        """Stop the processes, after their tasks if `wait_for_work`."""
        for pool in self._pools:
            pool.shutdown(wait_for_work, cancel_futures=cancel_futures)

    def __exit__(self, error_type: Any, error: Any, traceback: Any) -> None:
        if error_type is not None:
            self.shutdown(wait_for_work=False, cancel_futures=True)
            for process in active_children():
                process.terminate()
        self.shutdown()


class InlineExecutor(Executor):
    """Executor that runs each task immediately in the calling process."""

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Run a task; return a completed future with its result or exception."""
        future: Future[Any] = Future()
        try:
            future.set_result(function(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def _initialise_pooled_worker(
    trust: bool,
    initializer: Callable[..., None] | None = None,
    initializer_arguments: tuple[Any, ...] = (),
) -> None:
    """Copy the permission of the parent to load untrusted code, then initialise the worker."""
    set_trusted(trust)
    initialise_worker(initializer, initializer_arguments)


def initialise_worker(
    initializer: Callable[..., None] | None = None, initializer_arguments: tuple[Any, ...] = ()
) -> None:
    """Ignore Ctrl-C in this worker process, and exit when the parent process ends.

    Ctrl-C reaches every process of a terminal, but the parent handles it. A parent that is killed
    cannot stop its children, therefore a thread watches it.
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

"""Runs of the command line in forks of this process, which has imported everything."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from residnet.__main__ import main as main_of_residnet

MEMORY = 6 * 2**30


@dataclass(frozen=True)
class Ending:
    """How an attempt ended.

    Attributes:
        code: exit code, negative for the signal that ended it.
        seconds: by the clock.
        processor: seconds of the processor.
        error: what stands on standard error.
    """

    code: int
    seconds: float
    processor: float
    error: str


def command(*words: object) -> Callable[[], None]:
    """Return what gives the command line some words."""

    def work() -> None:
        sys.argv = ["residnet", *map(str, words)]
        main_of_residnet()

    return work


def _forked(work: Callable[[], object], file: Path, limit: int | None) -> int:
    child = os.fork()
    if child:
        return child
    code = 1
    try:
        with file.open("w") as stream, Path(os.devnull).open("w") as nowhere:
            os.dup2(stream.fileno(), 2)
            os.dup2(nowhere.fileno(), 1)
        if limit is not None:
            resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 5))
            resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        work()
        code = 0
    except SystemExit as end:
        code = int(end.code or 0)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(code)


def _fresh(words: list[str], file: Path) -> int:
    with file.open("w") as stream:
        return subprocess.Popen(
            [sys.executable, "-m", "residnet", *words], stdout=subprocess.DEVNULL, stderr=stream
        ).pid


def attempt(
    work: Callable[[], object] | list[str],
    file: Path,
    limit: int | None = None,
    stop: tuple[float, int] | None = None,
) -> Ending:
    """Do some work in a fork of this process.

    Args:
        work: what is called; words of the command line are given to a fresh process.
        file: for standard error.
        limit: seconds of the processor after which the work is ended, and memory is limited too.
        stop: seconds after which a signal is sent, and its number.
    """
    started = time.monotonic()
    child = _fresh(work, file) if isinstance(work, list) else _forked(work, file, limit)
    after, number = stop or (600.0, signal.SIGKILL)
    while True:
        done, status, used = os.wait4(child, os.WNOHANG)
        if done:
            break
        if time.monotonic() > started + after:
            os.kill(child, number)
            # what does not end by the signal is killed
            after, number = after + 600.0, signal.SIGKILL
        time.sleep(0.002)
    return Ending(
        os.waitstatus_to_exitcode(status),
        time.monotonic() - started,
        used.ru_utime + used.ru_stime,
        file.read_text(errors="backslashreplace"),
    )

"""The door of the command line: whatever ends a command ends it in one line and an exit code.

Nothing heavy is imported here, so that an interruption is heard from the first moment on.
"""

from __future__ import annotations

import errno
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from residnet.core.errors import ResidnetError

INTERRUPTED = 130
"""Exit code after Ctrl-C."""
TERMINATED = 143
"""Exit code after SIGTERM."""
_OF_THE_SYSTEM = {
    errno.EACCES,
    errno.EDQUOT,
    errno.EFBIG,
    errno.EIO,
    errno.EMFILE,
    errno.ENAMETOOLONG,
    errno.ENFILE,
    errno.ENOMEM,
    errno.ENOSPC,
    errno.EPERM,
    errno.EROFS,
}
"""Faults that are the machine's: nothing in residnet could be repaired to avoid them."""


class Terminated(BaseException):
    """The signal SIGTERM, which asks a process to end; no `except Exception` holds it up."""


class _Signals:
    """Remembers that the user asked for the end, whatever a library makes of the exception."""

    def __init__(self) -> None:
        self.interrupted = False

    def interrupt(self, number: int, frame: FrameType | None) -> None:
        self.interrupted = True
        raise KeyboardInterrupt

    def terminate(self, number: int, frame: FrameType | None) -> None:
        raise Terminated

    @contextmanager
    def heard(self) -> Iterator[None]:
        """Hear the signals within the context; only a main thread can."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {
            signal.SIGINT: signal.signal(signal.SIGINT, self.interrupt),
            signal.SIGTERM: signal.signal(signal.SIGTERM, self.terminate),
        }
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def enter(command: Callable[[], object]) -> None:
    """Carry out a command; whatever goes wrong is told in one line on standard error.

    Args:
        command: what parses the arguments and does the work.

    Raises:
        SystemExit: with the exit code, where it is not 0.
    """
    signals = _Signals()
    try:
        with signals.heard():
            command()
    except SystemExit as end:
        if not signals.interrupted:
            raise
        _leave(_continue("interrupted"), INTERRUPTED, end)
    except KeyboardInterrupt as end:
        _leave(_continue("interrupted"), INTERRUPTED, end)
    except Terminated as end:
        _leave(_continue("terminated"), TERMINATED, end)
    except BrokenPipeError:
        # whoever read the output has seen enough
        sys.exit(0)
    except Exception as error:
        if signals.interrupted:
            # a library has turned the interruption into an error of its own
            _leave(_continue("interrupted"), INTERRUPTED, error)
        _leave(*_told(error), error)


def _told(error: Exception) -> tuple[str, int]:
    """Return the line about an error and the exit code."""
    if isinstance(error, ResidnetError):
        return str(error), error.exit_code
    # PyTorch has no error of its own for memory
    if isinstance(error, MemoryError) or "can't allocate memory" in str(error):
        return "the memory of this machine is used up; take fewer or shorter logs", 1
    if isinstance(error, OSError) and error.errno in _OF_THE_SYSTEM:
        place = "" if error.filename is None else f"{error.filename}: "
        return f"{place}{error.strerror}; make room or give another place", 2
    from residnet.crash import write_crash_file

    file = write_crash_file(error)
    first = next(iter(str(error).splitlines()), "")
    place = "it could not be described in a file" if file is None else f"attach {file} to an issue"
    return f"this is a defect of residnet, {type(error).__name__}: {first[:200]}; {place}", 1


def _continue(what: str) -> str:
    """Return the line of a command that was stopped from outside."""
    if "run" in sys.argv[1:2]:
        return f"{what}; continue the run with the same command and --resume"
    return f"{what}; nothing is left half written, give the same command again"


def _leave(line: str, code: int, cause: BaseException) -> None:
    # whatever the line quotes, it stays one line
    print(f"residnet: {ResidnetError(line)}", file=sys.stderr)
    raise SystemExit(code) from cause

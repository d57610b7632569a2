"""Run a command and turn every outcome into one line on standard error and an exit code.

Nothing heavy is imported here, so that signals are handled from the first moment on.
"""

from __future__ import annotations

import errno
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from residnet.core.errors import ResidnetError, Terminated

EXIT_INTERRUPTED = 130
"""Exit code after Ctrl-C."""
EXIT_TERMINATED = 143
"""Exit code after SIGTERM."""
_SYSTEM_ERRNOS = {
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
"""Faults of the machine, which no change of residnet could avoid."""
TRACEBACK_VARIABLE = "RESIDNET_TRACEBACK"
"""Environment variable; if it is not empty, the traceback of a defect is printed."""


class _SignalHandler:
    """Signal handlers that record an interruption even if a library replaces the exception."""

    def __init__(self) -> None:
        self.is_interrupted = False

    def interrupt(self, number: int, frame: FrameType | None) -> None:
        self.is_interrupted = True
        raise KeyboardInterrupt

    def terminate(self, number: int, frame: FrameType | None) -> None:
        raise Terminated

    @contextmanager
    def handle_signals(self) -> Iterator[None]:
        """Handle SIGINT and SIGTERM within the context, if this is the main thread."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        previous_handlers = {
            signal.SIGINT: signal.signal(signal.SIGINT, self.interrupt),
            signal.SIGTERM: signal.signal(signal.SIGTERM, self.terminate),
        }
        try:
            yield
        finally:
            for number, handler in previous_handlers.items():
                signal.signal(number, handler)


def run_cli(command: Callable[[], object]) -> None:
    """Run a command and report any error in one line on standard error.

    Args:
        command: function that parses the arguments and does the work.

    Raises:
        SystemExit: if the exit code is not 0.
    """
    signals = _SignalHandler()
    # a service may start a command with closed streams
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            # the stream stays open until the process ends
            stream = Path(os.devnull).open(mode, encoding="utf-8")  # noqa: SIM115
            setattr(sys, name, stream)
    try:
        with signals.handle_signals():
            command()
        _report_skipped_packages()
    except SystemExit as exception:
        if not signals.is_interrupted:
            _report_skipped_packages()
            raise
        _exit(_interruption_message("interrupted"), EXIT_INTERRUPTED, exception)
    except KeyboardInterrupt as exception:
        _exit(_interruption_message("interrupted"), EXIT_INTERRUPTED, exception)
    except Terminated as exception:
        _exit(_interruption_message("terminated"), EXIT_TERMINATED, exception)
    except BrokenPipeError:
        # the reader of the output closed the pipe, as `head` does
        sys.exit(0)
    except Exception as error:
        if signals.is_interrupted:
            # a library has replaced the interruption by another exception
            _exit(_interruption_message("interrupted"), EXIT_INTERRUPTED, error)
        _exit(*_error_message(error), error)


def _report_skipped_packages() -> None:
    """Print one line for each entry point of another package that could not be loaded."""
    # a command that uses no plug-ins never imports the registry
    registry = sys.modules.get("residnet.core.registry")
    for line in registry.list_load_faults() if registry is not None else ():
        print(f"residnet: warning: {ResidnetError(line)}", file=sys.stderr)


def _error_message(error: Exception) -> tuple[str, int]:
    """Return the message about an error, and the exit code."""
    if isinstance(error, ResidnetError):
        return str(error), error.exit_code
    # PyTorch raises a plain RuntimeError when memory is exhausted
    if isinstance(error, MemoryError) or "can't allocate memory" in str(error):
        return "the memory of this machine is exhausted; use fewer or shorter logs", 1
    if isinstance(error, OSError) and error.errno in _SYSTEM_ERRNOS:
        location = "" if error.filename is None else f"{error.filename}: "
        return f"{location}{error.strerror}; free space or choose another place", 2
    if isinstance(error, ModuleNotFoundError) and "residnet" not in str(error.name):
        problem = f"{sys.executable} has no package '{error.name}'"
        return f"{problem}; install residnet for this Python, or take that of its .venv", 2
    hint = f"for its traceback repeat the command with {TRACEBACK_VARIABLE}=1 in the environment"
    if os.environ.get(TRACEBACK_VARIABLE):
        import traceback

        traceback.print_exception(error)
        hint = "attach the traceback above to an issue"
    # a command that uses no plug-ins never imports the registry
    if "residnet.core.registry" in sys.modules:
        from residnet.core.external_parts import describe_external_error

        if message := describe_external_error(error):
            return f"{message}; {hint}", 1
    first_line = next(iter(str(error).splitlines()), "")
    return f"this is a defect of residnet, {type(error).__name__}: {first_line[:200]}; {hint}", 1


def _interruption_message(event: str) -> str:
    """Return the message of a command that was stopped by a signal."""
    if "run" in sys.argv[1:2]:
        return f"{event}; continue the run with the same command and --resume"
    return f"{event}; no file is half written; repeat the command"


def _exit(message: str, code: int, original_error: BaseException) -> None:
    # ResidnetError escapes line breaks, so that the message stays one line
    print(f"residnet: {ResidnetError(message)}", file=sys.stderr)
    raise SystemExit(code) from original_error

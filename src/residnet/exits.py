"""The end of a command: a one-line message, an exit code, and a crash file for a defect of residnet.

This module imports nothing heavy, so that signals are handled from the start.
"""

from __future__ import annotations

import errno
import os
import re
import signal
import sys
import threading
import time
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
"""Errors of the machine, such as a full disk, which are no defects of residnet."""


class _SignalHandler:
    """Signal handlers that remember an interruption, even if a library swallows the exception."""

    def __init__(self) -> None:
        self.is_interrupted = False

    def interrupt(self, number: int, frame: FrameType | None) -> None:
        self.is_interrupted = True
        raise KeyboardInterrupt

    def terminate(self, number: int, frame: FrameType | None) -> None:
        raise Terminated

    @contextmanager
    def handle_signals(self) -> Iterator[None]:
        """Install the handlers within the context; only the main thread can."""
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
    """Run a command; an error is reported in one line on standard error.

    Args:
        command: parses the arguments and does the work.

    Raises:
        SystemExit: with the exit code, if it is not 0.
    """
    signals = _SignalHandler()
    # a service may start a command with closed streams
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            stream = Path(os.devnull).open(mode, encoding="utf-8")  # noqa: SIM115 (to the end)
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
        # the reader of the output, such as `head`, has closed it
        sys.exit(0)
    except Exception as error:
        if signals.is_interrupted:
            # a library has converted the interruption into another exception
            _exit(_interruption_message("interrupted"), EXIT_INTERRUPTED, error)
        _exit(*_error_message(error), error)


def _report_skipped_packages() -> None:
    """Print one line for each entry point of another package that could not be loaded."""
    # a command that needs no parts of other packages never imports the registry
    registry = sys.modules.get("residnet.core.registry")
    for line in registry.load_faults() if registry is not None else ():
        print(f"residnet: warning: {ResidnetError(line)}", file=sys.stderr)


def _error_message(error: Exception) -> tuple[str, int]:
    """Return the message of an error and the exit code."""
    if isinstance(error, ResidnetError):
        return str(error), error.exit_code
    # PyTorch raises a plain RuntimeError if memory is exhausted
    if isinstance(error, MemoryError) or "can't allocate memory" in str(error):
        return "the memory of this machine is exhausted; use fewer or shorter logs", 1
    if isinstance(error, OSError) and error.errno in _SYSTEM_ERRNOS:
        location = "" if error.filename is None else f"{error.filename}: "
        return f"{location}{error.strerror}; free space or choose another place", 2
    if isinstance(error, ModuleNotFoundError) and "residnet" not in str(error.name):
        problem = f"{sys.executable} has no package '{error.name}'"
        return f"{problem}; install residnet for this Python, or use the Python of its .venv", 2
    file = write_crash_file(error)
    first_line = next(iter(str(error).splitlines()), "")
    location = (
        "the crash file could not be written" if file is None else f"attach {file} to an issue"
    )
    return (
        f"this is a defect of residnet, {type(error).__name__}: {first_line[:200]}; {location}",
        1,
    )


def _interruption_message(event: str) -> str:
    """Return the message of a command that was stopped by a signal."""
    if "run" in sys.argv[1:2]:
        return f"{event}; continue the run with the same command and --resume"
    return f"{event}; no file is incomplete; repeat the same command"


def _exit(message: str, code: int, original_error: BaseException) -> None:
    # ResidnetError replaces line breaks of quoted text
    print(f"residnet: {ResidnetError(message)}", file=sys.stderr)
    raise SystemExit(code) from original_error


_MAX_CONFIG_LENGTH = 100_000
"""Number of characters of a config in a crash file; larger than any usual config."""
_SECRET_PATTERN = re.compile(
    r"(?i)((?:[\w.-]*(?:password|passwd|secret|token|api[_-]?key|credential)[\w.-]*)"
    r"[\"']?\s*[:=]\s*)\S.*"
)
_ACCOUNT_PATTERN = re.compile(r"://[^/\s@]+@")


def write_crash_file(error: BaseException) -> Path | None:
    """Write versions, command, config and traceback to a crash file; returns the file.

    The file is written to the current folder, or to the folder for temporary files if that fails.
    Returns None if both fail. Passwords, tokens and the name of the user are removed, and
    environment variables are not included.
    """
    import platform
    import tempfile
    import traceback
    from importlib.metadata import PackageNotFoundError, requires, version

    from residnet.core.version import __version__

    package_versions = []
    for requirement in requires("residnet") or ():
        name = re.split(r"[^A-Za-z0-9._-]", requirement, maxsplit=1)[0]
        try:
            package_versions.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    parts = [
        f"residnet {__version__}, Python {platform.python_version()}, {platform.platform()}",
        "packages: " + ", ".join(sorted(set(package_versions))),
        f"command: residnet {' '.join(sys.argv[1:])}",
        "".join(traceback.format_exception(error)),
    ]
    config_texts = []
    for argument in sys.argv[1:]:
        try:
            file = Path(argument) / "resolved.yaml" if Path(argument).is_dir() else Path(argument)
            if file.suffix in (".yaml", ".yml") and file.is_file():
                text = file.read_text(encoding="utf-8", errors="backslashreplace")
                config_texts.append(f"{file}:\n{text[:_MAX_CONFIG_LENGTH]}")
        except (OSError, ValueError):
            # the argument is not a path, or the file cannot be read
            continue
    text = remove_secrets("\n\n".join([*parts, *config_texts]) + "\n")
    name = f"residnet-crash-{time.strftime('%Y%m%dT%H%M%S')}-{os.getpid()}.txt"
    for folder in (Path.cwd, lambda: Path(tempfile.gettempdir())):
        try:
            file = folder() / name
            file.write_text(text, encoding="utf-8", errors="backslashreplace")
        except OSError:
            continue
        return file
    return None


def remove_secrets(text: str) -> str:
    """Return text without passwords, tokens and the name of the home folder."""
    try:
        home = str(Path.home())
    except RuntimeError:
        home = ""
    if len(home) > 1:
        text = text.replace(home, "~")
    return _ACCOUNT_PATTERN.sub("://***@", _SECRET_PATTERN.sub(r"\1***", text))

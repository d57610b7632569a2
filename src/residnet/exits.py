"""How a command ends: in one line and an exit code, with a crash file where residnet is at fault.

Nothing heavy is imported here, so that an interruption is heard from the first moment on.
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
    # a service may start a command with closed streams
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            stream = Path(os.devnull).open(mode, encoding="utf-8")  # noqa: SIM115 (to the end)
            setattr(sys, name, stream)
    try:
        with signals.heard():
            command()
        _report_skipped_packages()
    except SystemExit as end:
        if not signals.interrupted:
            _report_skipped_packages()
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


def _report_skipped_packages() -> None:
    """Print one line for each entry point of another package that could not be loaded."""
    # a command that needs no parts of other packages never imports the registry
    registry = sys.modules.get("residnet.core.registry")
    for line in registry.load_faults() if registry is not None else ():
        print(f"residnet: warning: {ResidnetError(line)}", file=sys.stderr)


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
    if isinstance(error, ModuleNotFoundError) and "residnet" not in str(error.name):
        what = f"{sys.executable} has no package '{error.name}'"
        return f"{what}; install residnet for this Python, or take that of its .venv", 2
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


_LONGEST_CONFIG = 100_000
"""Letters of each config in a report of a defect; chosen by hand, above those of any config."""
_SECRET = re.compile(
    r"(?i)((?:[\w.-]*(?:password|passwd|secret|token|api[_-]?key|credential)[\w.-]*)"
    r"[\"']?\s*[:=]\s*)\S.*"
)
_ACCOUNT = re.compile(r"://[^/\s@]+@")


def write_crash_file(error: BaseException) -> Path | None:
    """Write versions, command, config and traceback to a file, and return the file.

    It stands in the current folder, or where that cannot be written in the folder for temporary
    files; None where neither can be. Passwords, tokens and the name of the user are left out, and
    the environment is not looked at.
    """
    import platform
    import tempfile
    import traceback
    from importlib.metadata import PackageNotFoundError, requires, version

    from residnet.core.version import __version__

    found = []
    for requirement in requires("residnet") or ():
        name = re.split(r"[^A-Za-z0-9._-]", requirement, maxsplit=1)[0]
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    parts = [
        f"residnet {__version__}, Python {platform.python_version()}, {platform.platform()}",
        "packages: " + ", ".join(sorted(set(found))),
        f"command: residnet {' '.join(sys.argv[1:])}",
        "".join(traceback.format_exception(error)),
    ]
    out = []
    for word in sys.argv[1:]:
        try:
            file = Path(word) / "resolved.yaml" if Path(word).is_dir() else Path(word)
            if file.suffix in (".yaml", ".yml") and file.is_file():
                text = file.read_text(encoding="utf-8", errors="backslashreplace")
                out.append(f"{file}:\n{text[:_LONGEST_CONFIG]}")
        except (OSError, ValueError):
            # a word that is no path, or a file that cannot be read
            continue
    text = without_secrets("\n\n".join([*parts, *out]) + "\n")
    name = f"residnet-crash-{time.strftime('%Y%m%dT%H%M%S')}-{os.getpid()}.txt"
    for folder in (Path.cwd, lambda: Path(tempfile.gettempdir())):
        try:
            file = folder() / name
            file.write_text(text, encoding="utf-8", errors="backslashreplace")
        except OSError:
            continue
        return file
    return None


def without_secrets(text: str) -> str:
    """Return text without passwords, tokens and the home folder's name."""
    try:
        home = str(Path.home())
    except RuntimeError:
        home = ""
    if len(home) > 1:
        text = text.replace(home, "~")
    return _ACCOUNT.sub("://***@", _SECRET.sub(r"\1***", text))

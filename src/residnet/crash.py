"""The crash file: what is needed to repair a defect, in one text file that may be made public."""

from __future__ import annotations

import os
import platform
import re
import sys
import tempfile
import time
import traceback
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path

from residnet.core.version import __version__

_LONGEST_CONFIG = 100_000
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
    text = without_secrets(_content(error))
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


def _content(error: BaseException) -> str:
    parts = [
        f"residnet {__version__}, Python {platform.python_version()}, {platform.platform()}",
        "packages: " + ", ".join(_versions()),
        f"command: residnet {' '.join(sys.argv[1:])}",
        "".join(traceback.format_exception(error)),
    ]
    return "\n\n".join([*parts, *_configs()]) + "\n"


def _versions() -> list[str]:
    """Versions of the packages that residnet needs, those of its extras where they are there."""
    found = []
    for requirement in requires("residnet") or ():
        name = re.split(r"[^A-Za-z0-9._-]", requirement, maxsplit=1)[0]
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    return sorted(set(found))


def _configs() -> list[str]:
    """Texts of the configs that the command names, by file or by run folder."""
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
    return out

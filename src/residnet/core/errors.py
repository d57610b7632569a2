"""The errors that a user can cause: every one is a `ResidnetError` and reads as one line.

A message says what is wrong, where (file, row, column, key), what was expected and what to do about
it. The command line prints the message without a traceback and exits with the class's `exit_code`.
"""

from __future__ import annotations

import importlib.util


class ResidnetError(Exception):
    """The base of all errors that residnet raises on purpose.

    Whatever a message quotes from a file, it stays one printable line.

    Attributes:
        exit_code: exit status of the command line.
    """

    exit_code: int = 1

    def __init__(self, message: str = "") -> None:
        super().__init__(
            "".join(
                character
                if character.isprintable()
                else " "
                if character.isspace()
                else f"\\x{ord(character):02x}"
                for character in message
            )
        )


class Terminated(BaseException):
    """The signal SIGTERM, which asks a process to end; no `except Exception` holds it up."""


class UsageError(ResidnetError):
    """The error of a wrong call, path or unit (exit code 2)."""

    exit_code = 2


class MissingPackageError(UsageError):
    """The error of an optional package that is not installed (exit code 2)."""


class ConfigError(UsageError):
    """The error of a wrong configuration key, value or combination (exit code 2)."""


class DataError(ResidnetError):
    """The error of a log whose contents cannot be used (exit code 1)."""


class FitError(ResidnetError):
    """The error of data that do not determine a model, or of an unusable model (exit code 1)."""


class ExportError(ResidnetError):
    """The error of an exported model that does not reproduce the original (exit code 1)."""


class WithheldError(ExportError):
    """The error of a model that is worse than doing without it (exit code 1).

    A run whose own exports meet it is complete.
    """


def require_package(package: str, feature: str, extra: str) -> None:
    """Refuse to go on without an optional package.

    Raises:
        MissingPackageError: where it is not installed.
    """
    if importlib.util.find_spec(package) is None:
        raise MissingPackageError(
            f"{feature} needs the package {package}, which is not installed; install it with:"
            f" pip install 'residnet[{extra}]'"
        )

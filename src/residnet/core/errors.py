"""Errors that a user can cause; each is a `ResidnetError` with a message of one line.

A message says what is wrong, where (file, row, column, key), what was expected and what to do about
it. The command line prints the message without a traceback and exits with the class's `exit_code`.
"""

from __future__ import annotations

import importlib.util


class ResidnetError(Exception):
    """Base class of all errors that residnet raises on purpose.

    Line breaks and control characters in a message are escaped, because a message may quote a file.

    Args:
        message: one line for the user.
        code: overrides the default code of the class.

    Attributes:
        exit_code: exit status of the command line.
        code: dotted identifier of the kind of error, for tests and programs; never shown.
    """

    exit_code: int = 1
    code: str = "error"

    def __init__(self, message: str = "", code: str | None = None) -> None:
        if code is not None:
            self.code = code
        super().__init__(
            "".join(
                (
                    character
                    if character.isprintable()
                    else " "
                    if character.isspace()
                    else f"\\x{ord(character):02x}"
                )
                for character in message
            )
        )


class Terminated(BaseException):
    """Request to end the process (signal SIGTERM); no `except Exception` catches it."""


class UsageError(ResidnetError):
    """Wrong call, path or unit (exit code 2)."""

    exit_code = 2
    code = "usage"


class MissingPackageError(UsageError):
    """Optional package that is not installed (exit code 2)."""

    code = "package.missing"


class ConfigError(UsageError):
    """Wrong key, value or combination in a config (exit code 2)."""

    code = "config.invalid"


class DataError(ResidnetError):
    """Log whose contents cannot be used (exit code 1)."""

    code = "data.unusable"


class FitError(ResidnetError):
    """Data that do not determine a model, or an unusable model (exit code 1)."""

    code = "fit.failed"


class ExportError(ResidnetError):
    """Exported model that does not reproduce the original (exit code 1)."""

    code = "export.mismatch"


class WithheldError(ExportError):
    """Export refused because the model is worse than the reference model (exit code 1).

    A run is complete even if its own exports are refused.
    """

    code = "export.withheld"


def require_package(package: str, feature: str, extra: str) -> None:
    """Raise an error if an optional package is not installed.

    Args:
        package: name of the package to import.
        feature: feature that needs the package, as the subject of the message.
        extra: extra of residnet that installs the package.

    Raises:
        MissingPackageError: if it is not installed.
    """
    if importlib.util.find_spec(package) is None:
        raise MissingPackageError(
            f"{feature} needs the package {package}, which is not installed; install it with:"
            f" pip install 'residnet[{extra}]'"
        )

"""The one way to fail: every error that a user can cause is a `ResidnetError` and reads as one
line.

A message says what is wrong, where (file, row, column, key), what was expected and what to do about
it. The command line prints the message without a traceback and exits with the class's `exit_code`.
"""

from __future__ import annotations


class ResidnetError(Exception):
    """Base of all errors that residnet raises on purpose; whatever a message quotes from a file, it
    stays one printable line.
    """

    exit_code: int = 1

    def __init__(self, message: str = "") -> None:
        super().__init__(
            "".join(
                char if char.isprintable() else " " if char.isspace() else f"\\x{ord(char):02x}"
                for char in message
            )
        )


class UsageError(ResidnetError):
    """The call, a path or a unit is wrong (exit code 2)."""

    exit_code = 2


class ConfigError(UsageError):
    """A configuration key, value or combination is wrong (exit code 2)."""


class DataError(ResidnetError):
    """The contents of a log cannot be used (exit code 1)."""


class FitError(ResidnetError):
    """The data do not determine a model, or the fitted model is not usable (exit code 1)."""


class ExportError(ResidnetError):
    """An exported model does not reproduce the model that it came from (exit code 1)."""

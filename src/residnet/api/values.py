"""Plain Python values turned into what a config holds, with the errors of the command line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from residnet.core.errors import UsageError
from residnet.core.progress import ProgressCallback, listen

PathGiven = str | PathLike[str]
"""A path, as text or as an object."""

PartGiven = str | Mapping[str, Any] | BaseModel
"""A part by its kind, by a mapping as YAML has it, or by its config object."""


def plain(value: Any) -> Any:
    """Return a value as YAML would hold it: configs, tuples, paths and arrays become plain."""
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json", by_alias=True)
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(item) for item in value]
    return str(value) if isinstance(value, PathLike) else value


def part(given: PartGiven, what: str, **settings: Any) -> dict[str, Any]:
    """Return the config of a part as a mapping with its kind.

    Args:
        given: the kind alone, a mapping, or a config object.
        what: the part, in words, for the error.
        settings: further keys.

    Raises:
        UsageError: where it is none of these.
    """
    if isinstance(given, str):
        return {"kind": given, **plain(settings)}
    if isinstance(given, Mapping | BaseModel):
        return {**plain(given), **plain(settings)}
    raise UsageError(
        f"{what}: expected its kind, a mapping or a config object, given {described(given)}"
    )


def named_parts(given: Any, what: str) -> dict[str, Any]:
    """Return parts by name, from a list of kinds or a mapping from names to parts.

    Raises:
        UsageError: where it is neither.
    """
    if isinstance(given, str):
        return {given: part(given, what)}
    if isinstance(given, Mapping) and "kind" not in given:
        return {str(name): part(entry, f"{what} '{name}'") for name, entry in given.items()}
    if isinstance(given, list | tuple) and all(isinstance(kind, str) for kind in given):
        return {kind: part(kind, what) for kind in given}
    raise UsageError(
        f"{what}s: expected kinds such as ['plsr', 'lstm'], or a mapping from names to settings,"
        f" given {described(given)}"
    )


def path(given: Any, what: str) -> Path:
    """Return the given value as a path, ~ expanded.

    Raises:
        UsageError: where it is none.
    """
    if isinstance(given, str | PathLike) and str(given):
        return Path(given).expanduser()
    raise UsageError(f"{what}: expected a path, given {described(given)}")


def described(value: Any) -> str:
    """Return what a wrong argument is, in a few words."""
    if value is None or isinstance(value, str | int | float | bool):
        return repr(value)
    if isinstance(value, Sequence) and not value:
        return "an empty list"
    name = type(value).__name__
    return f"{'an' if name[0] in 'AEIOUaeiou' else 'a'} {name}"


def hearing(progress: ProgressCallback | None) -> AbstractContextManager[None]:
    """Return a context that sends progress to a callback; without one, whoever listens goes on.

    Raises:
        UsageError: where it cannot be called.
    """
    if progress is None:
        return nullcontext()
    if not callable(progress):
        raise UsageError(f"progress: expected a function, given {described(progress)}")
    return listen(progress)

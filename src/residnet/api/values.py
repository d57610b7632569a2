"""Conversion of Python arguments to values of a config, with one-line errors."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypeGuard

import numpy as np
from pydantic import BaseModel

from residnet.core.errors import UsageError
from residnet.core.progress import ProgressCallback, on_progress
from residnet.core.registry import register_kind

if TYPE_CHECKING:
    from torch import nn

PathLikeArg = str | PathLike[str]
"""A path, as text or as an object."""

PartLike: TypeAlias = "str | Mapping[str, Any] | BaseModel | nn.Module"
"""A part, given as its kind, as a mapping like in YAML, as a config object, or as a module."""


def to_builtin(value: Any) -> Any:
    """Convert configs, tuples, paths and arrays to the types that YAML has."""
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json", by_alias=True)
    if isinstance(value, Mapping):
        return {str(key): to_builtin(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return to_builtin(value.tolist())
    if isinstance(value, list | tuple | set | frozenset):
        return [to_builtin(item) for item in value]
    return str(value) if isinstance(value, PathLike) else value


def parse_part(
    value: PartLike, description: str, union: Any = None, **settings: Any
) -> dict[str, Any]:
    """Return the config of a part as a mapping with its kind.

    Args:
        value: a kind, a mapping, a config object, or a `torch.nn.Module` for a head.
        description: name of the argument for the error message.
        union: annotated type of the kinds, such as `residnet.heads.HeadConfig`, to which the class
            of a config object is added for this process; None to accept listed kinds only.
        settings: further keys.

    Raises:
        UsageError: if the value has another type.
    """
    if isinstance(value, str):
        return {"kind": value, **to_builtin(settings)}
    if isinstance(value, BaseModel) and union is not None:
        register_kind(union, type(value))
    if description.startswith("head") and _is_torch_module(value):
        # imports torch, which the user's module has imported already
        from residnet.heads.module import register_module

        return {**register_module(value), **to_builtin(settings)}
    if isinstance(value, Mapping | BaseModel):
        return {**to_builtin(value), **to_builtin(settings)}
    raise UsageError(
        f"{description}: expected its kind, a mapping or a config object, given"
        f" {describe_type(value)}"
    )


def _is_torch_module(value: Any) -> TypeGuard[nn.Module]:
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(value, torch.nn.Module)


def parse_named_parts(value: Any, description: str, union: Any = None) -> dict[str, Any]:
    """Return parts by name, from a list of kinds or a mapping from names to parts.

    Args:
        value: the argument.
        description: name of the kind of part.
        union: see `parse_part`.

    Raises:
        UsageError: if the value has another type.
    """
    if isinstance(value, str):
        return {value: parse_part(value, description)}
    if isinstance(value, Mapping) and "kind" not in value:
        return {
            str(name): parse_part(entry, f"{description} '{name}'", union)
            for name, entry in value.items()
        }
    if isinstance(value, list | tuple) and all(isinstance(part_kind, str) for part_kind in value):
        return {part_kind: parse_part(part_kind, description) for part_kind in value}
    raise UsageError(
        f"{description}s: expected kinds such as ['plsr', 'lstm'], or a mapping from names to"
        f" settings,"
        f" given {describe_type(value)}"
    )


def parse_path(value: Any, description: str) -> Path:
    """Convert an argument to a path and expand `~`.

    Raises:
        UsageError: if it is not a path.
    """
    if isinstance(value, str | PathLike) and str(value):
        return Path(value).expanduser()
    raise UsageError(f"{description}: expected a path, given {describe_type(value)}")


def describe_type(value: Any) -> str:
    """Describe the type or value of a wrong argument for an error message."""
    if value is None or isinstance(value, str | int | float | bool):
        return repr(value)
    if isinstance(value, Sequence) and not value:
        return "an empty list"
    name = type(value).__name__
    return f"{'an' if name[0] in 'AEIOUaeiou' else 'a'} {name}"


def forward_progress(progress: ProgressCallback | None) -> AbstractContextManager[None]:
    """Return a context that sends progress to a callback; None keeps the present callback.

    Raises:
        UsageError: if the callback is not callable.
    """
    if progress is None:
        return nullcontext()
    if not callable(progress):
        raise UsageError(f"progress: expected a function, given {describe_type(progress)}")
    return on_progress(progress)

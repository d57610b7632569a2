"""Configs: frozen pydantic models that are read from YAML files and overrides.

A run is one YAML file plus overrides (`head.lstm.hidden_size=64`). Values are taken strictly: text
is no number, a boolean is no number, `64.0` is no count. Dimensional values are SI numbers or text
with a unit (`20 deg`). Every error is one line.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, overload

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError
from pydantic_core import PydanticSerializationError, to_json
from yaml.nodes import Node

from residnet.core.config_errors import describe
from residnet.core.config_overrides import Override, apply_override
from residnet.core.config_paths import BaseConfig, ConfigPath, ExistingPath
from residnet.core.config_yaml import KeyPath, dump, line_of, parse
from residnet.core.errors import ConfigError
from residnet.core.quantities import (
    Hertz,
    Kilograms,
    Metres,
    MetresPerSecond,
    NewtonMetres,
    Newtons,
    Quantity,
    Radians,
    RadiansPerSecond,
    RevRate,
    RevsPerSecond,
    Seconds,
    quantity,
)

__all__ = [
    "BaseConfig",
    "Config",
    "ConfigPath",
    "ExistingPath",
    "Hertz",
    "Kilograms",
    "Metres",
    "MetresPerSecond",
    "NewtonMetres",
    "Newtons",
    "Quantity",
    "Radians",
    "RadiansPerSecond",
    "RevRate",
    "RevsPerSecond",
    "Seconds",
    "dump_config",
    "load_config",
    "load_mapping",
    "quantity",
    "validate",
]

T = TypeVar("T")

_LONGEST_FILE = 2_000_000
_HUGE = 1e30


class Config(BaseModel):
    """The base of all configs: frozen, without unknown keys, finite numbers only.

    Defaults are checked as given values are.
    """

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        allow_inf_nan=False,
        validate_default=True,
        defer_build=True,
    )


@dataclass(frozen=True)
class _Origin:
    """The file and the overrides that a config's values come from, for error messages."""

    where: str
    root: Node | None = None
    overrides: tuple[Override, ...] = ()

    def source(self, path: KeyPath) -> str:
        """Return where the value at `path` was set: an override, or a line of the file.

        The last override that set the whole value counts; one that changed a part of it is named
        too.
        """
        inside = ""
        for override in reversed(self.overrides):
            if path[: len(override.path)] == override.path:
                return override.where + inside
            if override.path[: len(path)] == path:
                inside = inside or f" with {override.where}"
        line = "" if self.root is None else f":{line_of(self.root, path)}"
        return self.where + line + inside


def _read(path: Path) -> tuple[dict[str, Any], Node]:
    try:
        # a device has no end
        with path.open("rb") as file:
            content = file.read(_LONGEST_FILE + 1)
        if len(content) > _LONGEST_FILE:
            raise ConfigError(f"{path}: is longer than {_LONGEST_FILE / 1e6:.0f} MB; no config is")
        text = content.decode("utf-8-sig")
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: no such file") from error
    except IsADirectoryError as error:
        raise ConfigError(f"{path}: is a folder; give a YAML file") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not UTF-8 text (byte {error.start})") from error
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise ConfigError(f"{str(path)!r}: is no path ({error})") from error
    data, root = parse(text, str(path))
    if root is None or data is None:
        raise ConfigError(f"{path}: empty; expected a mapping of keys to values")
    if not isinstance(data, dict):
        kind = "a list" if isinstance(data, list) else f"the value {data!r}"
        raise ConfigError(f"{path}: expected a mapping of keys to values, found {kind}")
    return data, root


def load_mapping(path: Path) -> dict[str, Any]:
    """Read a YAML file as plain values, without validation; all keys are text.

    Raises:
        ConfigError: where the file is missing, a folder, not YAML, empty or not a mapping, or
            repeats a key.
    """
    return _read(Path(path))[0]


@overload
def load_config(path: Path, overrides: Sequence[str], model: type[T]) -> T:
    """Build a config of one class from a YAML file and overrides."""


@overload
def load_config(path: Path, overrides: Sequence[str], model: Any) -> Any:
    """Build a config of a union of classes from a YAML file and overrides."""


def load_config(path: Path, overrides: Sequence[str], model: Any) -> Any:
    """Build a config of type `model` from a YAML file and overrides.

    Args:
        path: YAML file.
        overrides: `dotted.key=value`, value in YAML, in order; an element of a list is addressed by
            its index. `~dotted.key` takes a key away.
        model: config class, or a union of them (`Annotated[A | B, Field(discriminator="kind")]`).

    Raises:
        ConfigError: one line: file (with line) or override, key path, what is wrong, what was
            given, the nearest valid name.
    """
    path = Path(path)
    data, root = _read(path)
    applied = tuple(apply_override(data, text) for text in overrides)
    return _validated(data, model, _Origin(str(path), root, applied), path.parent.absolute())


@overload
def validate(data: Any, model: type[T], where: str, folder: Path | None = None) -> T:
    """Build a config of one class from plain values."""


@overload
def validate(data: Any, model: Any, where: str, folder: Path | None = None) -> Any:
    """Build a config of a union of classes from plain values."""


def validate(data: Any, model: Any, where: str, folder: Path | None = None) -> Any:
    """Build a config of type `model` from plain values, under the rules of `load_config`.

    Args:
        data: what JSON can hold, for example a mapping from `load_mapping`.
        model: config class or union of them.
        where: what errors name as the source.
        folder: folder that relative paths are looked for in first.

    Raises:
        ConfigError: as `load_config`.
    """
    return _validated(data, model, _Origin(where), folder)


def _validated(data: Any, model: Any, origin: _Origin, folder: Path | None) -> Any:
    # what is computed, as in a model's description, may be as good as zero
    _require_usual(data, origin, 0.0 if origin.root is None else 1.0 / _HUGE)
    # pydantic is strict without refusing lists for tuples or text for enums and paths only when it
    # reads JSON
    try:
        return TypeAdapter(model).validate_json(
            to_json(data), strict=True, context={"folder": folder}
        )
    except ValidationError as error:
        raise ConfigError(describe(error, model, origin.source)) from error
    except PydanticSerializationError as error:
        raise ConfigError(f"{origin.where}: holds a value that YAML cannot ({error})") from error


def _require_usual(data: Any, origin: _Origin, least: float, path: KeyPath = ()) -> None:
    """Stop at numbers that no vessel has: they would overflow wherever they are first used.

    Raises:
        ConfigError: with the key of the number.
    """
    if isinstance(data, dict | list):
        items = data.items() if isinstance(data, dict) else enumerate(data)
        for key, value in items:
            _require_usual(value, origin, least, (*path, key))
    elif isinstance(data, int | float) and not _usual(data, least):
        key = ".".join(map(str, path))
        raise ConfigError(
            f"{origin.source(path)}: {key}: expected a number of usual size (given"
            f" {f'one of {data.bit_length()} bits' if isinstance(data, int) else data})"
        )


def _usual(number: float, least: float) -> bool:
    if number == 0 or isinstance(number, bool):
        return True
    if isinstance(number, int):
        return abs(number) < 2**63
    # that it is no number is said with what was expected
    return not math.isfinite(number) or least <= abs(number) <= _HUGE


def dump_config(config: BaseModel) -> str:
    """Write a config as YAML text that loads back to an equal config.

    Every key is there, numbers are SI and paths absolute.
    """
    return dump(config.model_dump(mode="json", by_alias=True))

"""Configs: frozen pydantic models read from YAML, with units at the door and errors that fit on one
line.

A run is one YAML file plus overrides (`head.lstm.hidden_size=64`). Values are taken strictly: text
is no number, a boolean is no number, `64.0` is no count. Dimensional values are SI numbers or text
with a unit (`20 deg`).
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar, overload

from pydantic import (
    BaseModel,
    ConfigDict,
    GetCoreSchemaHandler,
    TypeAdapter,
    ValidationError,
    ValidationInfo,
)
from pydantic_core import CoreSchema, PydanticSerializationError, core_schema, to_json
from yaml.nodes import Node

from residnet.core.config_errors import describe, given
from residnet.core.config_yaml import KeyPath, dump, line_of, parse
from residnet.core.errors import ConfigError, UsageError
from residnet.core.names import nearest, si_unit, to_si, units

T = TypeVar("T")


class Config(BaseModel):
    """Base of all configs: frozen, no unknown keys, finite numbers only, defaults checked as values
    are.
    """

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        allow_inf_nan=False,
        validate_default=True,
        defer_build=True,
    )


@dataclass(frozen=True)
class Quantity:
    """Marks a float that a config gives in SI or as text with a unit: `Annotated[float,
    Quantity("kg")]`.

    Attributes:
        si: SI unit of the dimension; the value that the config holds is in this unit.

    Raises:
        UsageError: where `si` is not the SI unit of a known dimension.
    """

    si: str

    def __post_init__(self) -> None:
        if si_unit(self.si) != self.si:
            raise UsageError(f"unit '{self.si}' is not SI; the SI unit is '{si_unit(self.si)}'")

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """The float's own schema, constraints included, behind the conversion."""
        return core_schema.no_info_before_validator_function(self.convert, handler(source))

    def convert(self, value: object) -> float:
        """Value in SI.

        Raises:
            ValueError: where the value is not a finite number or `<number> <unit>`, or the unit is
                unknown or of another dimension.
        """
        try:
            si = self._parsed(value)
        except OverflowError:
            si = math.inf
        if not math.isfinite(si):
            raise ValueError(f"must be a finite number {given(value)}")
        return si

    def _parsed(self, value: object) -> float:
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            return float(value)
        match = _QUANTITY.fullmatch(value) if isinstance(value, str) else None
        if match is None:
            example = next((unit for unit in self._fitting() if unit != self.si), self.si)
            raise ValueError(
                f"expected a number in {self.si} or text such as '1.5 {example}' {given(value)}"
            )
        number, unit = match.groups()
        if unit and unit not in units():
            raise ValueError(
                f"unknown unit '{unit}'{nearest(unit, self._fitting())} {given(value)}"
            )
        try:
            return float(number) * to_si(unit or self.si, self.si)
        except UsageError as error:
            raise ValueError(f"{error} {given(value)}") from error

    def _fitting(self) -> list[str]:
        return [unit for unit in units() if si_unit(unit) == self.si]


_QUANTITY = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*")


def quantity(si: str) -> Any:
    """Type of a float in `si`, for types that are put together at run time; in annotations write
    `Annotated[float, Quantity(si)]`.

    Raises:
        UsageError: where `si` is not the SI unit of a known dimension.
    """
    return Annotated[float, Quantity(si)]


Seconds = Annotated[float, Quantity("s")]
Metres = Annotated[float, Quantity("m")]
Kilograms = Annotated[float, Quantity("kg")]
MetresPerSecond = Annotated[float, Quantity("m/s")]
Radians = Annotated[float, Quantity("rad")]
RadiansPerSecond = Annotated[float, Quantity("rad/s")]
Hertz = Annotated[float, Quantity("1/s")]
RevsPerSecond = Annotated[float, Quantity("1/s")]
RevRate = Annotated[float, Quantity("1/s^2")]
Newtons = Annotated[float, Quantity("N")]
NewtonMetres = Annotated[float, Quantity("N m")]


@dataclass(frozen=True)
class _PathRule:
    must_exist: bool

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.with_info_plain_validator_function(
            self.resolve,
            serialization=core_schema.plain_serializer_function_ser_schema(str, when_used="json"),
        )

    def resolve(self, value: object, info: ValidationInfo) -> Path:
        if not isinstance(value, (str, Path)) or not str(value):
            raise ValueError(f"expected a path {given(value)}")
        path = _expanded(str(value))
        folder: Path | None = (info.context or {}).get("folder")
        places = [place / path for place in (folder, Path.cwd()) if place is not None]
        found = next((place for place in places if _exists(place)), None)
        if found is None and self.must_exist:
            raise ValueError(
                "no such file or folder:"
                f" {' or '.join(str(place) for place in dict.fromkeys(places))}"
            )
        return (found or places[-1]).absolute()


def _expanded(text: str) -> Path:
    def environment(match: re.Match[str]) -> str:
        # an empty variable would turn ${DATA}/logs into /logs
        if not (value := os.environ.get(match[1])):
            raise ValueError(
                f"environment variable '{match[1]}' is not set; set it (export {match[1]}=...) or"
                " write the path itself"
            )
        return value

    try:
        return Path(re.sub(r"\$\{([^}]*)\}", environment, text)).expanduser()
    except RuntimeError as error:
        raise ValueError(f"no home folder is known for '~' {given(text)}") from error


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


ConfigPath = Annotated[Path, _PathRule(must_exist=False)]
"""Absolute path; `${NAME}` and `~` expanded, a relative one taken from the config's folder if it
exists there, else from the current folder.
"""

ExistingPath = Annotated[Path, _PathRule(must_exist=True)]
"""As `ConfigPath`, and the file or folder exists."""


@dataclass(frozen=True)
class _Override:
    text: str
    path: KeyPath

    @property
    def where(self) -> str:
        return f"override '{self.text}'"


@dataclass(frozen=True)
class _Origin:
    """Which file, line or override a value comes from."""

    where: str
    root: Node | None = None
    overrides: tuple[_Override, ...] = ()

    def of(self, path: KeyPath) -> str:
        """Source of the value at `path`: the last override that set it, else the file; and the last
        one that changed a part of it.
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
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: no such file") from error
    except IsADirectoryError as error:
        raise ConfigError(f"{path}: is a folder; give a YAML file") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not UTF-8 text (byte {error.start})") from error
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from error
    data, root = parse(text, str(path))
    if root is None or data is None:
        raise ConfigError(f"{path}: empty; expected a mapping of keys to values")
    if not isinstance(data, dict):
        kind = "a list" if isinstance(data, list) else f"the value {data!r}"
        raise ConfigError(f"{path}: expected a mapping of keys to values, found {kind}")
    return data, root


def load_mapping(path: Path) -> dict[str, Any]:
    """Plain contents of a YAML file, unvalidated; all keys are text.

    Raises:
        ConfigError: where the file is missing, a folder, not YAML, empty or not a mapping, or
            repeats a key.
    """
    return _read(Path(path))[0]


@overload
def load_config(path: Path, overrides: Sequence[str], model: type[T]) -> T:
    """Of a class."""


@overload
def load_config(path: Path, overrides: Sequence[str], model: Any) -> Any:
    """Of a union."""


def load_config(path: Path, overrides: Sequence[str], model: Any) -> Any:
    """Config of type `model` from a YAML file and overrides.

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
    applied = tuple(_apply(data, text) for text in overrides)
    return _validated(data, model, _Origin(str(path), root, applied), path.parent.absolute())


@overload
def validate(data: Any, model: type[T], where: str, folder: Path | None = None) -> T:
    """Of a class."""


@overload
def validate(data: Any, model: Any, where: str, folder: Path | None = None) -> Any:
    """Of a union."""


def validate(data: Any, model: Any, where: str, folder: Path | None = None) -> Any:
    """Config of type `model` from plain values (what JSON can hold), under the rules of
    `load_config`.

    Args:
        data: for example a mapping from `load_mapping`.
        model: config class or union of them.
        where: what errors name as the source.
        folder: folder that relative paths are looked for in first.

    Raises:
        ConfigError: as `load_config`.
    """
    return _validated(data, model, _Origin(where), folder)


def _validated(data: Any, model: Any, origin: _Origin, folder: Path | None) -> Any:
    # pydantic is strict without refusing lists for tuples or text for enums and paths only when it
    # reads JSON
    try:
        return TypeAdapter(model).validate_json(
            to_json(data), strict=True, context={"folder": folder}
        )
    except ValidationError as error:
        raise ConfigError(describe(error, model, origin.of)) from error
    except PydanticSerializationError as error:
        raise ConfigError(f"{origin.where}: holds a value that YAML cannot ({error})") from error


def _apply(data: dict[str, Any], text: str) -> _Override:
    """Set the value of one override in `data`; keys on the way that the file leaves out are made.
    `~key` takes a key away.
    """
    if text.startswith("~"):
        return _remove(data, text)
    key, equals, value_text = text.partition("=")
    keys = key.strip().split(".")
    if not equals or not all(keys):
        raise ConfigError(
            f"override '{text}': expected key=value, for example head.lstm.hidden_size=64"
        )
    where = f"override '{text}'"
    value, _ = parse(value_text, where, located=False)
    path: KeyPath = ()
    here: Any = data
    for i, name in enumerate(keys):
        element = _element(here, name, where, path)
        path += (element,)
        if i == len(keys) - 1:
            here[element] = value
        elif isinstance(here, dict) and here.get(name) is None:
            here[element] = {}
        here = here[element]
    return _Override(text, path)


def _remove(data: dict[str, Any], text: str) -> _Override:
    where = f"override '{text}'"
    keys = text[1:].strip().split(".")
    here: Any = data
    path: KeyPath = ()
    for i, name in enumerate(keys):
        if not isinstance(here, dict) or name not in here:
            at = ".".join(keys[: i + 1])
            raise ConfigError(
                f"{where}: there is no '{at}' to take"
                f" away{nearest(name, here) if isinstance(here, dict) and here else ''}"
            )
        path += (name,)
        if i == len(keys) - 1:
            del here[name]
            break
        here = here[name]
    return _Override(text, path)


def _element(here: Any, name: str, where: str, path: KeyPath) -> str | int:
    """`name` as a key or index of `here`."""
    at = ".".join(str(element) for element in path)
    if isinstance(here, dict):
        return name
    if not isinstance(here, list):
        raise ConfigError(f"{where}: {at}: has no key '{name}' {given(here)}")
    if not name.isdecimal() or int(name) >= len(here):
        raise ConfigError(
            f"{where}: {at}: a list of {len(here)} items has no item '{name}'; the first is 0"
        )
    return int(name)


def dump_config(config: BaseModel) -> str:
    """YAML text of a resolved config: every key, SI numbers, absolute paths; it loads back to an
    equal config.
    """
    return dump(config.model_dump(mode="json", by_alias=True))

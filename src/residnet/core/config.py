"""Configs: frozen pydantic models that are read from YAML files and overrides.

A run is one YAML file plus overrides (`heads.lstm.hidden_size=64`). Values are taken strictly: text
is no number, a boolean is no number, `64.0` is no count. Dimensional values are SI numbers or text
with a unit (`20 deg`). Every error is one line.
"""

from __future__ import annotations

import copy
import math
import os
import re
import types
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, overload

from pydantic import BaseModel, ConfigDict, GetCoreSchemaHandler, ValidationError, ValidationInfo
from pydantic.fields import FieldInfo
from pydantic_core import CoreSchema, ErrorDetails, PydanticSerializationError, core_schema, to_json
from yaml.nodes import Node

from residnet.core.config_yaml import KeyPath, dump, line_of, parse
from residnet.core.errors import ConfigError, UsageError
from residnet.core.files import shipped_configs
from residnet.core.names import nearest, shown
from residnet.core.registry import Kinds, adapter
from residnet.core.units import si_unit, to_si, units

# Keys of the tables are ends of dotted key paths, `*` for any one key; a kind that was renamed has
# `=<old kind>` behind the path of its discriminator. Values are what to write instead.
RENAMED: dict[str, str] = {
    "recurrent": "policies",
    "policies.*.hidden": "units",
    "policies.*.observer": "start",
    "policies.*.imitate": "start",
    "policies.*.training.horizon": "duration",
    "policies.*.training.margin": "steady.overshoot",
    "policies.*.training.overshoot": "exact",
    "policies.*.training.sharp": "conditions.stated.band",
    "policies.*.training.slowest": "conditions.stated.time",
    "policies.*.training.smoothness": "calm",
    "spread": "conditions.stated",
    "test.bias_error": "conditions.stated",
    "test.overshoot": "conditions.stated.overshoot_weight",
    "tuning_points": "conditions.evolution",
}
"""For example `"free_run.lead": "warmup"`, `"baseline.kind=fossen": "hull"`."""


GONE: dict[str, str] = {
    "training.*.average": "learning rates that fall to a few percent average by themselves",
    "refit.*.folds": "the prior is fixed by the length of the logs",
    "refit_baseline": "refit the baseline before its networks, by `refit`",
    "begin_with": "a network begins from its baseline alone",
    "swaps": "the search keeps a beam of sets and trims them",
    "separate": "models of single phases are always fitted besides",
    "standard.bounds": "parameters are free, as in the document",
    "identify": "the first half identifies, as in the document",
    "spectrum.kind=ittc": "jonswap with gamma: 1 is the same",
    "encoder": "the memory of a measured past is that of the steps along it",
    "acceleration": "the derivative of the measured velocity is taken",
    "published_absolute": "its numbers are the last three of `published`",
}
"""Keys that nothing took the place of, and what holds instead."""
IDLE: dict[str, Any] = {
    **{"disturbance": None, "encoder": False, "intercept": False, "one": False},
    **{"always": False, "longest_gap": 1.0},
}
"""Keys that are gone, and the value with which they did nothing: runs of before hold them so."""


def renamed(path: tuple[str | int, ...], value: str | None = None) -> str:
    """Return `; it is 'new' now` for an old key or value, `; it is gone: ...`, or nothing."""
    written = ".".join(map(str, path)) + ("" if value is None else f"={value}")
    for old, new in RENAMED.items():
        if fnmatchcase(f".{written}", f"*.{old}"):
            return f"; it is '{new}' now"
    for old, instead in GONE.items():
        if fnmatchcase(f".{written}", f"*.{old}"):
            return f"; it is gone: {instead}"
    return ""


T = TypeVar("T")

_LONGEST_FILE = 2_000_000
"""Bytes; chosen by hand, far above any config."""
_HUGE = 1e30
"""Largest size of a number, its inverse the least; no vessel has it, and float32 ends at 3e38."""


class Config(BaseModel):
    """The base of all configs: frozen, without unknown keys, finite numbers only.

    Defaults are checked as given values are.
    """

    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, validate_default=True, defer_build=True
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
        return adapter(model).validate_json(to_json(data), strict=True, context={"folder": folder})
    except ValidationError as error:
        idle = {
            _locate(one["loc"], model)[0]
            for one in error.errors(include_url=False)
            if one["type"] == "extra_forbidden" and (one["loc"][-1], one["input"]) in IDLE.items()
        }
        if not idle:
            raise ConfigError(describe(error, model, origin.source)) from error
        return _validated(_without(data, idle), model, origin, folder)
    except PydanticSerializationError as error:
        raise ConfigError(f"{origin.where}: holds a value that YAML cannot ({error})") from error


def _without(data: Any, paths: Iterable[KeyPath]) -> Any:
    """Return plain values without the entries at some key paths."""
    out = copy.deepcopy(data)
    for *parents, key in paths:
        here = out
        for parent in parents:
            here = here[parent]
        del here[key]
    return out


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
    if isinstance(number, int):
        return abs(number) < 2**63
    # that it is no number is said with what was expected
    return number == 0 or not math.isfinite(number) or least <= abs(number) <= _HUGE


def dump_config(config: BaseModel) -> str:
    """Write a config as YAML text that loads back to an equal config.

    Every key is there, numbers are SI and paths absolute.
    """
    return dump(config.model_dump(mode="json", by_alias=True))


# overrides: `dotted.key=value` sets a value, `~dotted.key` takes a key away


@dataclass(frozen=True)
class Override:
    """An override as the user wrote it, and the key path that it set."""

    text: str
    path: KeyPath

    @property
    def where(self) -> str:
        """The override as error messages name it."""
        return f"override '{self.text}'"


def apply_override(data: dict[str, Any], text: str) -> Override:
    """Change `data` in place as one override says and return what was changed.

    Keys on the way that the file leaves out are made; `~key` takes a key away.

    Raises:
        ConfigError: where the text is no override, or names a key or item that cannot be there.
    """
    if text.startswith("~"):
        return _remove(data, text)
    key, equals, value_text = text.partition("=")
    keys = key.strip().split(".")
    if not equals or not all(keys):
        raise ConfigError(
            f"override '{text}': expected key=value, for example heads.lstm.hidden_size=64"
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
    return Override(text, path)


def _remove(data: dict[str, Any], text: str) -> Override:
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
    return Override(text, path)


def _element(here: Any, name: str, where: str, path: KeyPath) -> str | int:
    """Return `name` as a key or an index of `here`."""
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


@dataclass(frozen=True)
class Quantity:
    """The mark of a float that a config gives in SI or as text with a unit.

    Used in an annotation: `Annotated[float, Quantity("kg")]`.

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
        """Return the float's own schema, constraints included, behind the conversion."""
        return core_schema.no_info_before_validator_function(self.convert, handler(source))

    def convert(self, value: object) -> float:
        """Convert a number, or text such as `20 deg`, to SI.

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
        try:
            return float(number) * to_si(unit or self.si, self.si)
        except UsageError as error:
            raise ValueError(f"{error} {given(value)}") from error

    def _fitting(self) -> list[str]:
        return [unit for unit in units() if si_unit(unit) == self.si]


_QUANTITY = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*")


def quantity(si: str) -> Any:
    """Return the type of a float in `si`, for types that are put together at run time.

    In annotations write `Annotated[float, Quantity(si)]`.

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
    shipped: bool = False

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
            own = shipped_configs() if self.shipped and not path.suffix else {}
            if path.as_posix() in own:
                return own[path.as_posix()].absolute()
            looked = " or ".join(str(place) for place in dict.fromkeys(places))
            hint = f"; residnet has no config '{path}' either{nearest(str(path), own)}"
            raise ValueError(f"no such file or folder: {looked}{hint if own else ''}")
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

BaseConfig = Annotated[Path, _PathRule(must_exist=True, shipped=True)]
"""As `ExistingPath`; without an ending it may name a config that comes with residnet."""


# one line out of pydantic's validation errors

_EXPECTED = {
    **dict.fromkeys(("int_type", "int_from_float", "int_parsing"), "a whole number"),
    **dict.fromkeys(("float_type", "float_parsing"), "a number"),
    **dict.fromkeys(("bool_type", "bool_parsing"), "true or false"),
    **{"string_type": "text", "none_required": "null"},
    **dict.fromkeys(("list_type", "tuple_type", "set_type", "frozen_set_type"), "a list"),
    **dict.fromkeys(("dict_type", "model_type", "model_attributes_type"), "a mapping"),
}


@dataclass(frozen=True)
class _Fault:
    kind: str
    path: KeyPath
    text: str


def describe(error: ValidationError, model: Any, where: Callable[[KeyPath], str]) -> str:
    """Return the first fault of a validation error as one line.

    Args:
        where: file (with line) or override in which the value at a key path was set.
    """
    faults = [_fault(details, model) for details in error.errors(include_url=False)]
    # a mistyped key is also a missing one; the typo is what the user has to see
    first = next((fault for fault in faults if fault.kind == "extra_forbidden"), faults[0])
    # below a plain union, the member that got furthest into the value is the one that was meant
    first = max(
        (fault for fault in faults if fault.path[: len(first.path)] == first.path),
        key=lambda fault: len(fault.path),
    )
    text = _either([fault.text for fault in faults if fault.path == first.path])
    others = {fault.path for fault in faults if first.path[: len(fault.path)] != fault.path}
    more = f" (and {len(others)} more)" if others else ""
    key = ".".join(str(element) for element in first.path)
    return " ".join(f"{where(first.path)}: {key + ': ' if key else ''}{text}{more}".split())


def _either(texts: list[str]) -> str:
    """Join what the members of a union say about one value into one phrase."""
    texts = list(dict.fromkeys(texts))
    split = [re.fullmatch(r"expected (.*?)( \(given .*\))", text) for text in texts]
    if all(split):
        parts = [match for match in split if match]
        return "expected " + " or ".join(dict.fromkeys(match[1] for match in parts)) + parts[0][2]
    return "; or ".join(texts)


def _fault(details: ErrorDetails, model: Any) -> _Fault:
    path, parents, here = _locate(details["loc"], model)
    kind, context, value = details["type"], details.get("ctx", {}), details["input"]
    match kind:
        case "missing" if path and isinstance(path[-1], int):
            return _Fault(kind, path[:-1], f"item {path[-1]} is missing {given(value)}")
        case "missing":
            text = f"missing{_of_kind(parents)}"
        case "extra_forbidden":
            valid = [key for kind in parents if _is_model(kind) for key in _fields(kind)]
            hint = renamed(path) or nearest(str(path[-1]), valid)
            text = f"unknown key{hint}{_of_kind(parents)}"
        case "union_tag_invalid":
            path += _discriminator(context)
            tag = str(context["tag"])
            hint = renamed(path, tag) or nearest(tag, _quoted(context["expected_tags"]))
            text = f"unknown value '{shown(tag)}'{hint}"
        case "union_tag_not_found":
            path += _discriminator(context)
            text = f"missing{nearest('', _tags(here, path[-1]))}"
        case "literal_error" | "enum":
            valid = _quoted(context["expected"])
            unknown = isinstance(value, str) and bool(valid)
            text = (
                f"unknown value '{shown(value)}'{renamed(path, value) or nearest(value, valid)}"
                if unknown
                else f"expected {context['expected']} {given(value)}"
            )
        case "value_error" | "assertion_error":
            text = str(context["error"])
            # a validator of a whole section has said which of its keys it means; the section
            # itself would only fill the line
            scalar = isinstance(value, (str, int, float)) and "(given " not in text
            text = f"{text} {given(value)}" if scalar else text
        case _ if kind in _EXPECTED:
            text = f"expected {_EXPECTED[kind]} {given(value)}"
        case _:
            # a bound is told in the unit that it counts in, however deep it stands in the type
            fields = [kind.model_fields for kind in parents if _is_model(kind)]
            found = {
                f.alias or n: (f.annotation, f.metadata) for one in fields for n, f in one.items()
            }
            unit = re.search(r"Quantity\(si='(.+?)'\)", repr(found.get(path[-1] if path else "")))
            bound = details["msg"].replace("Input should", "must") + (f" {unit[1]}" if unit else "")
            text = f"{bound} {given(value)}"
    return _Fault(kind, path, text)


def given(value: Any) -> str:
    """Return `(given 'x')` for error messages: the value as YAML writes it, cut where long."""
    names = {None: "null", True: "true", False: "false"}
    text = names[value] if value is None or isinstance(value, bool) else repr(value)
    return f"(given {shown(text)})"


def _quoted(text: str) -> list[str]:
    return re.findall(r"'([^']*)'", text)


def _discriminator(context: dict[str, Any]) -> KeyPath:
    # pydantic quotes the name of a key; a callable discriminator has none
    return tuple(_quoted(context["discriminator"])[:1])


def _locate(
    loc: tuple[str | int, ...], model: Any
) -> tuple[KeyPath, tuple[Any, ...], tuple[Any, ...]]:
    """Return the key path that the user wrote, the types around its last key, and of its value.

    pydantic puts the chosen member of a union between the keys; only the types tell such a label
    from a key.
    """
    path: list[str | int] = []
    parents: tuple[Any, ...] = ()
    here: tuple[Any, ...] = (_plain(model),)
    for element in loc:
        if any(_is_union(kind) for kind in here):
            here = _chosen(here, str(element))
        elif element != "[key]":
            path.append(element)
            parents, here = here, tuple(inner for kind in here for inner in _inner(kind, element))
    return tuple(path), parents, here


def _plain(annotation: Any) -> Any:
    """Return the type without wrappers that leave an error's location alone (Annotated, None)."""
    while True:
        if get_origin(annotation) is Annotated:
            inside, *metadata = get_args(annotation)
            kinds = next((part for part in metadata if isinstance(part, Kinds)), None)
            if kinds is not None:
                return kinds
            annotation = inside
        elif _is_union(annotation) and len(_options(annotation)) == 1:
            annotation = _options(annotation)[0]
        else:
            return annotation


def _is_union(annotation: Any) -> bool:
    return isinstance(annotation, Kinds) or get_origin(annotation) in (Union, types.UnionType)


def _options(union: Any) -> list[Any]:
    return [member for member in get_args(union) if member is not type(None)]


def _chosen(kinds: tuple[Any, ...], label: str) -> tuple[Any, ...]:
    """Return the members of unions that pydantic's label stands for; all where none fits.

    A label is a discriminator's value or the name of a type.
    """
    named = [
        kind.find(label) for kind in kinds if isinstance(kind, Kinds) and label in kind.names()
    ]
    if named:
        return tuple(part for part in named if isinstance(part, type))
    options = [_plain(member) for kind in kinds if _is_union(kind) for member in _options(kind)]
    by_tag = [
        option
        for option in options
        if any(label in values for values in _literals(option).values())
    ]
    words = re.findall(r"\w+", label)
    by_name = [
        option
        for option in options
        if getattr(get_origin(option) or option, "__name__", "") in words
    ]
    return tuple(by_tag or by_name or options)


def _inner(kind: Any, element: str | int) -> list[Any]:
    """Return the types of what stands under `element` in a value of type `kind`."""
    if _is_model(kind):
        return [_plain(annotation) for key, annotation in _fields(kind).items() if key == element]
    arguments = get_args(kind)
    if get_origin(kind) is tuple and isinstance(element, int) and Ellipsis not in arguments:
        return [_plain(argument) for argument in arguments[element : element + 1]]
    # a mapping's values come last, a list's items first and last
    return [_plain(argument) for argument in arguments if argument is not Ellipsis][-1:]


def _is_model(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)


def _fields(model: type[BaseModel]) -> dict[str, Any]:
    return {field.alias or name: _marked(field) for name, field in model.model_fields.items()}


def _marked(field: FieldInfo) -> Any:
    """Return a field's annotation with the marker that pydantic has moved into its metadata."""
    kinds = next((part for part in field.metadata if isinstance(part, Kinds)), None)
    return field.annotation if kinds is None else Annotated[field.annotation, kinds]


def _literals(kind: Any) -> dict[str, tuple[Any, ...]]:
    """Return the fields of a model that take only fixed values, with these values."""
    if not _is_model(kind):
        return {}
    plain = {key: _plain(annotation) for key, annotation in _fields(kind).items()}
    return {
        key: get_args(annotation)
        for key, annotation in plain.items()
        if get_origin(annotation) is Literal
    }


def _of_kind(kinds: tuple[Any, ...]) -> str:
    # which keys a section has follows from its kind, and an override may have changed that
    fixed = [
        (key, values[0])
        for kind in kinds
        for key, values in _literals(kind).items()
        if len(values) == 1
    ]
    return f" ({fixed[0][0]} '{fixed[0][1]}')" if len(fixed) == 1 else ""


def _tags(kinds: tuple[Any, ...], key: str | int) -> list[str]:
    names = [name for kind in kinds if isinstance(kind, Kinds) for name in kind.names()]
    options = [_plain(member) for kind in kinds if _is_union(kind) for member in _options(kind)]
    return names + [str(tag) for option in options for tag in _literals(option).get(str(key), ())]

"""Read configs (frozen pydantic models) from YAML files and overrides.

A run is one YAML file plus overrides (`heads.lstm.hidden_size=64`). Validation is strict: neither
text nor a boolean is accepted as a number, and `64.0` is not accepted as an integer. Dimensional
values are SI numbers or text with a unit (`20 deg`). Every error is one line.
"""

from __future__ import annotations

import math
import os
import re
import types
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, overload

from pydantic import BaseModel, ConfigDict, GetCoreSchemaHandler, ValidationError, ValidationInfo
from pydantic.fields import FieldInfo
from pydantic_core import CoreSchema, ErrorDetails, PydanticSerializationError, core_schema, to_json
from yaml.nodes import Node

from residnet.core.config_yaml import KeyPath, dump_yaml, find_line, parse_yaml
from residnet.core.errors import ConfigError, UsageError
from residnet.core.files import find_shipped_configs
from residnet.core.names import suggest_name, truncate
from residnet.core.registry import PluginUnion, type_adapter
from residnet.core.units import si_unit, to_si, unit_names

RENAMED_KEYS: dict[str, str] = {}
"""Keys that this release renames -> what to write instead; emptied with the next release.

An entry is the last part of a dotted key path, in which `*` matches any key:
`"free_run.lead": "warmup"`. A renamed value is written after its key path and `=`:
`"baseline.kind=fossen": "hull"`.
"""


REPLACED_VALUES: dict[str, str] = {
    "task=actuators": "it is an example now: pip install ./examples/residnet_tasks",
    "task=study": "it is the task sweep with search: {kind: variants, variants: ..., seeds: ...}",
    "task=import": "it is an example now: pip install ./examples/residnet_tasks",
}
"""Values that this release removes, as in `RENAMED_KEYS` -> what to do; emptied with the next."""


def format_renaming_hint(path: tuple[str | int, ...], value: str | None = None) -> str:
    """Return a hint on the replacement of a renamed key or value; empty for other keys."""
    key_text = ".".join(map(str, path)) + ("" if value is None else f"={value}")
    for old_key, new_key in RENAMED_KEYS.items():
        if fnmatchcase(f".{key_text}", f"*.{old_key}"):
            return f"; it was renamed to '{new_key}'"
    for old_value, advice in REPLACED_VALUES.items():
        if fnmatchcase(f".{key_text}", f"*.{old_value}"):
            return f"; {advice}"
    return ""


T = TypeVar("T")

_MAX_FILE_BYTES = 2_000_000
"""Largest size of a config file in bytes; chosen by hand, far above any real config."""
_MAX_NUMBER = 1e30
"""Largest accepted absolute value, and inverse of the smallest: float32 overflows at 3e38."""


class Config(BaseModel):
    """Base class of all configs: immutable, without unknown keys, finite numbers only.

    Default values are validated like the values of a file.
    """

    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, validate_default=True, defer_build=True
    )


@dataclass(frozen=True)
class _ConfigOrigin:
    """File and overrides that set the values of a config, for error messages."""

    name: str
    root: Node | None = None
    overrides: tuple[Override, ...] = ()

    def locate_value(self, path: KeyPath) -> str:
        """Return which override or which line of the file set the value at `path`.

        The last override that set the complete value wins; the text also names an override that
        changed a part of it.
        """
        partial_override = ""
        for override in reversed(self.overrides):
            if path[: len(override.path)] == override.path:
                return override.label + partial_override
            if override.path[: len(path)] == path:
                partial_override = partial_override or f" with {override.label}"
        line = "" if self.root is None else f":{find_line(self.root, path)}"
        return self.name + line + partial_override


def _read_mapping(path: Path) -> tuple[dict[str, Any], Node]:
    """Read a YAML file; return its content, and its nodes with the lines of the keys.

    Raises:
        ConfigError: if the file cannot be read, or does not contain a mapping.
    """
    try:
        # a bounded read, because a device such as /dev/zero never ends
        with path.open("rb") as file:
            content = file.read(_MAX_FILE_BYTES + 1)
        if len(content) > _MAX_FILE_BYTES:
            raise ConfigError(
                f"{path}: is longer than {_MAX_FILE_BYTES / 1e6:.0f} MB; no config is so long",
                "config.file",
            )
        text = content.decode("utf-8-sig")
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: no such file", "config.file") from error
    except IsADirectoryError as error:
        raise ConfigError(f"{path}: is a folder; give a YAML file", "config.file") from error
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"{path}: not UTF-8 text (byte {error.start})", "config.not_yaml"
        ) from error
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})", "config.file") from error
    except ValueError as error:
        raise ConfigError(f"{str(path)!r}: is no path ({error})", "config.file") from error
    data, root = parse_yaml(text, str(path))
    if root is None or data is None:
        raise ConfigError(f"{path}: empty; expected a mapping of keys to values", "config.not_yaml")
    if not isinstance(data, dict):
        found_type = "a list" if isinstance(data, list) else f"the value {data!r}"
        raise ConfigError(
            f"{path}: expected a mapping of keys to values, found {found_type}", "config.not_yaml"
        )
    return data, root


def load_mapping(path: Path) -> dict[str, Any]:
    """Read a YAML file as plain values without validation; all keys are text.

    Raises:
        ConfigError: if the file is missing, a folder, not YAML, empty or not a mapping, or
            repeats a key.
    """
    return _read_mapping(Path(path))[0]


@overload
def load_config(path: Path, overrides: Sequence[str], model: type[T]) -> T:
    """Build a config of one class from a YAML file and overrides."""


@overload
def load_config(path: Path, overrides: Sequence[str], model: Any) -> Any:
    """Build a config of a union of classes from a YAML file and overrides."""


def load_config(path: Path, overrides: Sequence[str], model: Any) -> Any:
    """Build a config of type `model` from a YAML file and overrides.

    Args:
        path: YAML file; relative paths in the config are relative to its folder.
        overrides: overrides, applied in order. `dotted.key=value` sets a YAML value, an index
            addresses an item of a list, and `~dotted.key` removes a key.
        model: config class, or a union of them (`Annotated[A | B, Field(discriminator="kind")]`).

    Raises:
        ConfigError: if the config is not valid. The message has the file (and line) or override,
            the key path, the fault, the value and the nearest valid name.
    """
    path = Path(path)
    data, root = _read_mapping(path)
    applied_overrides = tuple(apply_override(data, text) for text in overrides)
    origin = _ConfigOrigin(str(path), root, applied_overrides)
    return _validate_data(data, model, origin, path.parent.absolute())


@overload
def validate_config(data: Any, model: type[T], where: str, folder: Path | None = None) -> T:
    """Build a config of one class from plain values."""


@overload
def validate_config(data: Any, model: Any, where: str, folder: Path | None = None) -> Any:
    """Build a config of a union of classes from plain values."""


def validate_config(data: Any, model: Any, where: str, folder: Path | None = None) -> Any:
    """Build a config of type `model` from plain values, under the rules of `load_config`.

    Args:
        data: values that JSON can represent, for example a mapping from `load_mapping`.
        model: config class, or a union of them.
        where: source of the data in error messages.
        folder: folder in which relative paths are searched first.

    Raises:
        ConfigError: if the data are not valid, see `load_config`.
    """
    return _validate_data(data, model, _ConfigOrigin(where), folder)


def _validate_data(data: Any, model: Any, origin: _ConfigOrigin, folder: Path | None) -> Any:
    # values that residnet computed itself (no YAML root) may be arbitrarily close to zero
    _require_plausible_numbers(data, origin, 0.0 if origin.root is None else 1.0 / _MAX_NUMBER)
    # in JSON the strict mode of pydantic accepts lists for tuples, and text for enums and paths
    try:
        return type_adapter(model).validate_json(
            to_json(data), strict=True, context={"folder": folder}
        )
    except ValidationError as error:
        fault = describe_error(error, model, origin.locate_value)
        raise ConfigError(fault.text, fault.code) from error
    except PydanticSerializationError as error:
        raise ConfigError(
            f"{origin.name}: holds a value that YAML cannot represent ({error})", "config.not_yaml"
        ) from error


def _require_plausible_numbers(
    data: Any, origin: _ConfigOrigin, min_size: float, path: KeyPath = ()
) -> None:
    """Reject numbers that are so large or small that later arithmetic would overflow.

    Raises:
        ConfigError: if a number is too large or too small; the message names its key.
    """
    if isinstance(data, dict | list):
        items = data.items() if isinstance(data, dict) else enumerate(data)
        for key, value in items:
            _require_plausible_numbers(value, origin, min_size, (*path, key))
    elif isinstance(data, int | float) and not _is_plausible_number(data, min_size):
        key = ".".join(map(str, path))
        raise ConfigError(
            f"{origin.locate_value(path)}: {key}: expected a number of usual size (given"
            f" {f'one of {data.bit_length()} bits' if isinstance(data, int) else data})",
            "config.out_of_range",
        )


def _is_plausible_number(number: float, min_size: float) -> bool:
    if isinstance(number, int):
        return abs(number) < 2**63
    # infinity and NaN pass: the validation reports them with the expected type
    return number == 0 or not math.isfinite(number) or min_size <= abs(number) <= _MAX_NUMBER


def dump_config(config: BaseModel) -> str:
    """Return a config as YAML text that loads back to an equal config.

    The text holds every key, numbers in SI units and absolute paths.
    """
    return dump_yaml(config.model_dump(mode="json", by_alias=True))


# overrides: `dotted.key=value` sets a value, `~dotted.key` removes a key


@dataclass(frozen=True)
class Override:
    """One override: the text of the user and the key path that it set."""

    text: str
    path: KeyPath

    @property
    def label(self) -> str:
        """Name of the override in error messages."""
        return f"override '{self.text}'"


def apply_override(data: dict[str, Any], text: str) -> Override:
    """Apply one override to `data` in place.

    Missing mappings along the key path are created.

    Args:
        data: plain values of a config.
        text: `dotted.key=value`, or `~dotted.key` to remove a key.

    Returns:
        The override with the key path that it set.

    Raises:
        ConfigError: if the text is not an override, or its key path does not fit the data.
    """
    if text.startswith("~"):
        return _apply_removal(data, text)
    key, equals, value_text = text.partition("=")
    keys = key.strip().split(".")
    if not equals or not all(keys):
        raise ConfigError(
            f"override '{text}': expected key=value, for example heads.lstm.hidden_size=64",
            "config.override",
        )
    label = f"override '{text}'"
    value, _ = parse_yaml(value_text, label, show_location=False)
    path: KeyPath = ()
    container: Any = data
    for i, name in enumerate(keys):
        resolved_key = _resolve_element(container, name, label, path)
        path += (resolved_key,)
        if i == len(keys) - 1:
            container[resolved_key] = value
        elif isinstance(container, dict) and container.get(name) is None:
            container[resolved_key] = {}
        container = container[resolved_key]
    return Override(text, path)


def _apply_removal(data: dict[str, Any], text: str) -> Override:
    label = f"override '{text}'"
    keys = text[1:].strip().split(".")
    container: Any = data
    path: KeyPath = ()
    for i, name in enumerate(keys):
        if not isinstance(container, dict) or name not in container:
            key_path = ".".join(keys[: i + 1])
            has_keys = isinstance(container, dict) and bool(container)
            hint = suggest_name(name, container) if has_keys else ""
            raise ConfigError(
                f"{label}: there is no '{key_path}' to remove{hint}", "config.override"
            )
        path += (name,)
        if i == len(keys) - 1:
            del container[name]
            break
        container = container[name]
    return Override(text, path)


def _resolve_element(container: Any, name: str, label: str, path: KeyPath) -> str | int:
    """Return `name` as a key of a mapping or as an index of a list."""
    key_path = ".".join(str(path_element) for path_element in path)
    if isinstance(container, dict):
        return name
    if not isinstance(container, list):
        raise ConfigError(
            f"{label}: {key_path}: has no key '{name}' {format_given(container)}", "config.override"
        )
    if not name.isdecimal() or int(name) >= len(container):
        raise ConfigError(
            f"{label}: {key_path}: a list of {len(container)} items has no item '{name}'; the first"
            " is 0",
            "config.override",
        )
    return int(name)


@dataclass(frozen=True)
class Quantity:
    """Marker of a float field that accepts an SI number or text with a unit.

    It is used in an annotation: `Annotated[float, Quantity("kg")]`.

    Attributes:
        si: SI unit of the dimension; the validated value is in this unit.

    Raises:
        UsageError: if `si` is not the SI unit of a known dimension.
    """

    si: str

    def __post_init__(self) -> None:
        if si_unit(self.si) != self.si:
            raise UsageError(f"unit '{self.si}' is not SI; the SI unit is '{si_unit(self.si)}'")

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Return the schema of the float with its constraints, preceded by the conversion."""
        return core_schema.no_info_before_validator_function(self.convert, handler(source))

    def convert(self, value: object) -> float:
        """Convert a number, or text such as `20 deg`, to SI.

        Raises:
            ValueError: if the value is not a finite number or `<number> <unit>`, or the unit is
                unknown or has another dimension.
        """
        try:
            si_value = self._parse_value(value)
        except OverflowError:
            si_value = math.inf
        if not math.isfinite(si_value):
            raise ValueError(f"must be a finite number {format_given(value)}")
        return si_value

    def _parse_value(self, value: object) -> float:
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            return float(value)
        match = _QUANTITY_PATTERN.fullmatch(value) if isinstance(value, str) else None
        if match is None:
            example = next((unit for unit in self._compatible_units() if unit != self.si), self.si)
            raise ValueError(
                f"expected a number in {self.si} or text such as '1.5 {example}'"
                f" {format_given(value)}"
            )
        number, unit = match.groups()
        try:
            return float(number) * to_si(unit or self.si, self.si)
        except UsageError as error:
            raise ValueError(f"{error} {format_given(value)}") from error

    def _compatible_units(self) -> list[str]:
        return [unit for unit in unit_names() if si_unit(unit) == self.si]


@dataclass(frozen=True)
class PolynomialOf:
    """Marker of the coefficients c_0, c_1, ... of a polynomial with dimensions.

    It is used in an annotation: `Annotated[tuple[float, float, float], PolynomialOf("N", "1/s")]`.

    Attributes:
        value: SI unit of the value of the polynomial.
        variable: SI unit of its variable.
    """

    value: str
    variable: str


_QUANTITY_PATTERN = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*")


def quantity_type(si: str) -> Any:
    """Return the type of a float with unit `si`, for types that are created at run time.

    In annotations write `Annotated[float, Quantity(si)]`.

    Raises:
        UsageError: if `si` is not the SI unit of a known dimension.
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
    """Marker of a path field: how a relative path is resolved, and whether it must exist."""

    must_exist: bool
    allows_shipped: bool = False

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.with_info_plain_validator_function(
            self.resolve,
            serialization=core_schema.plain_serializer_function_ser_schema(str, when_used="json"),
        )

    def resolve(self, value: object, info: ValidationInfo) -> Path:
        if not isinstance(value, (str, Path)) or not str(value):
            raise ValueError(f"expected a path {format_given(value)}")
        path = _expand_path(str(value))
        folder: Path | None = (info.context or {}).get("folder")
        candidates = [
            candidate / path for candidate in (folder, Path.cwd()) if candidate is not None
        ]
        existing = next((candidate for candidate in candidates if _path_exists(candidate)), None)
        if existing is None and self.must_exist:
            shipped = find_shipped_configs() if self.allows_shipped and not path.suffix else {}
            if path.as_posix() in shipped:
                return shipped[path.as_posix()].absolute()
            searched = " or ".join(str(candidate) for candidate in dict.fromkeys(candidates))
            hint = f"; residnet has no config named '{path}'{suggest_name(str(path), shipped)}"
            raise ValueError(f"no such file or folder: {searched}{hint if shipped else ''}")
        return (existing or candidates[-1]).absolute()


def _expand_path(text: str) -> Path:
    def expand_variable(match: re.Match[str]) -> str:
        # an empty variable would turn ${DATA}/logs into /logs
        if not (variable_value := os.environ.get(match[1])):
            raise ValueError(
                f"environment variable '{match[1]}' is not set; set it (export {match[1]}=...) or"
                " write the path itself"
            )
        return variable_value

    try:
        return Path(re.sub(r"\$\{([^}]*)\}", expand_variable, text)).expanduser()
    except RuntimeError as error:
        raise ValueError(f"the home folder for '~' is unknown {format_given(text)}") from error


def _path_exists(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


ConfigPath = Annotated[Path, _PathRule(must_exist=False)]
"""Absolute path with `${NAME}` and `~` expanded.

A relative path is searched in the folder of the config first, then in the current folder.
"""

ExistingPath = Annotated[Path, _PathRule(must_exist=True)]
"""`ConfigPath` of an existing file or folder."""

BaseConfig = Annotated[Path, _PathRule(must_exist=True, allows_shipped=True)]
"""`ExistingPath`; without a suffix it may name a config that is shipped with residnet."""


# conversion of pydantic's validation errors to one line

_EXPECTED_TYPES = {
    **dict.fromkeys(("int_type", "int_from_float", "int_parsing"), "a whole number"),
    **dict.fromkeys(("float_type", "float_parsing"), "a number"),
    **dict.fromkeys(("bool_type", "bool_parsing"), "true or false"),
    **{"string_type": "text", "none_required": "null"},
    **dict.fromkeys(("list_type", "tuple_type", "set_type", "frozen_set_type"), "a list"),
    **dict.fromkeys(("dict_type", "model_type", "model_attributes_type"), "a mapping"),
}


@dataclass(frozen=True)
class ConfigFault:
    """One fault of a config.

    Attributes:
        code: code of the `ConfigError`.
        path: key path of the value.
        text: description in one line.
    """

    code: str
    path: KeyPath
    text: str


_FAULT_CODES = {
    "missing": "config.missing_key",
    "extra_forbidden": "config.unknown_key",
    "union_tag_invalid": "config.unknown_value",
    "union_tag_not_found": "config.missing_key",
    "literal_error": "config.unknown_value",
    "enum": "config.unknown_value",
    "value_error": "config.invalid",
    "assertion_error": "config.invalid",
    **dict.fromkeys(_EXPECTED_TYPES, "config.wrong_type"),
}
"""Code of the fault by the kind of pydantic's error; any other kind is a violated bound."""


def describe_error(
    error: ValidationError, model: Any, locate: Callable[[KeyPath], str]
) -> ConfigFault:
    """Return the most specific fault of a validation error as one line.

    Args:
        error: validation error of pydantic.
        model: config class, or a union of them, that was validated.
        locate: returns the file (with line) or override that set the value at a key path.
    """
    faults = [_parse_fault(details, model) for details in error.errors(include_url=False)]
    # a mistyped key is reported as unknown and as missing; the user needs the first
    main_fault = next((fault for fault in faults if fault.code == "config.unknown_key"), faults[0])
    # in a union without discriminator the member with the deepest fault fits the value best
    main_fault = max(
        (fault for fault in faults if fault.path[: len(main_fault.path)] == main_fault.path),
        key=lambda fault: len(fault.path),
    )
    text = _join_alternatives([fault.text for fault in faults if fault.path == main_fault.path])
    other_paths = {
        fault.path for fault in faults if main_fault.path[: len(fault.path)] != fault.path
    }
    more_text = f" (and {len(other_paths)} more)" if other_paths else ""
    key = ".".join(str(element) for element in main_fault.path)
    line = f"{locate(main_fault.path)}: {key + ': ' if key else ''}{text}{more_text}"
    return ConfigFault(main_fault.code, main_fault.path, " ".join(line.split()))


def _join_alternatives(texts: list[str]) -> str:
    """Join the faults that the members of a union report on one value into one phrase."""
    texts = list(dict.fromkeys(texts))
    matches = [re.fullmatch(r"expected (.*?)( \(given .*\))", text) for text in texts]
    if all(matches):
        full_matches = [match for match in matches if match]
        return (
            "expected "
            + " or ".join(dict.fromkeys(match[1] for match in full_matches))
            + full_matches[0][2]
        )
    return "; or ".join(texts)


def _parse_fault(details: ErrorDetails, model: Any) -> ConfigFault:
    """Convert one error of pydantic to a fault with the key path of the user."""
    path, parents, value_types = _locate_key(details["loc"], model)
    error_type = details["type"]
    error_context = details.get("ctx", {})
    value = details["input"]
    match error_type:
        case "missing" if path and isinstance(path[-1], int):
            fault_text = f"item {path[-1]} is missing {format_given(value)}"
            return ConfigFault(_FAULT_CODES["missing"], path[:-1], fault_text)
        case "missing":
            fault_text = f"missing{_kind_suffix(parents)}"
        case "extra_forbidden":
            valid_names = [
                key
                for parent in parents
                if _is_model_class(parent)
                for key in _annotations_by_key(parent)
            ]
            hint = format_renaming_hint(path) or suggest_name(str(path[-1]), valid_names)
            fault_text = f"unknown key{hint}{_kind_suffix(parents)}"
        case "union_tag_invalid":
            path += _discriminator_path(error_context)
            tag = str(error_context["tag"])
            expected_tags = _find_quoted(error_context["expected_tags"])
            hint = format_renaming_hint(path, tag) or _suggest_kind(tag, expected_tags, value_types)
            fault_text = f"unknown value '{truncate(tag)}'{hint}"
        case "union_tag_not_found":
            path += _discriminator_path(error_context)
            fault_text = f"missing{suggest_name('', _discriminator_values(value_types, path[-1]))}"
        case "literal_error" | "enum":
            valid_names = _find_quoted(error_context["expected"])
            is_unknown_value = isinstance(value, str) and bool(valid_names)
            if is_unknown_value:
                hint = format_renaming_hint(path, value) or suggest_name(value, valid_names)
                fault_text = f"unknown value '{truncate(value)}'{hint}"
            else:
                fault_text = f"expected {error_context['expected']} {format_given(value)}"
        case "value_error" | "assertion_error":
            fault_text = str(error_context["error"])
            # the message of a section's validator names the key: the section is not printed
            is_scalar = isinstance(value, (str, int, float)) and "(given " not in fault_text
            fault_text = f"{fault_text} {format_given(value)}" if is_scalar else fault_text
        case _ if error_type in _EXPECTED_TYPES:
            fault_text = f"expected {_EXPECTED_TYPES[error_type]} {format_given(value)}"
        case _:
            # a violated bound; its unit is in the metadata of the field, or of a type inside it
            model_fields = [parent.model_fields for parent in parents if _is_model_class(parent)]
            field_types = {
                model_field.alias or field_name: (model_field.annotation, model_field.metadata)
                for fields_of_model in model_fields
                for field_name, model_field in fields_of_model.items()
            }
            unit = re.search(
                r"Quantity\(si='(.+?)'\)", repr(field_types.get(path[-1] if path else ""))
            )
            bound_text = details["msg"].replace("Input should", "must") + (
                f" {unit[1]}" if unit else ""
            )
            fault_text = f"{bound_text} {format_given(value)}"
    code = _FAULT_CODES.get(error_type, "config.out_of_range")
    return ConfigFault(code, path, fault_text)


def _suggest_kind(kind: str, valid_kinds: Sequence[str], value_types: tuple[Any, ...]) -> str:
    """Return a hint at a similar kind and, for parts of other packages, at their installation."""
    hint = suggest_name(kind, valid_kinds)
    if not any(isinstance(value_type, PluginUnion) for value_type in value_types):
        return hint
    return f"{hint}{'' if hint.endswith('?') else ';'} or install the package that registers it"


def format_given(value: Any) -> str:
    """Return `(given 'x')` for error messages: the value in YAML notation, truncated."""
    names = {None: "null", True: "true", False: "false"}
    text = names[value] if value is None or isinstance(value, bool) else repr(value)
    return f"(given {truncate(text)})"


def _find_quoted(text: str) -> list[str]:
    return re.findall(r"'([^']*)'", text)


def _discriminator_path(context: dict[str, Any]) -> KeyPath:
    # pydantic quotes the key of a discriminator; a callable discriminator has no key
    return tuple(_find_quoted(context["discriminator"])[:1])


def _locate_key(
    loc: tuple[str | int, ...], model: Any
) -> tuple[KeyPath, tuple[Any, ...], tuple[Any, ...]]:
    """Translate a location of pydantic to the key path of the user.

    pydantic inserts the chosen member of a union between the keys; only the types distinguish such
    a label from a key.

    Returns:
        The key path, the types that hold its last key, and the types of its value.
    """
    path: list[str | int] = []
    parents: tuple[Any, ...] = ()
    value_types: tuple[Any, ...] = (_unwrap_type(model),)
    for element in loc:
        if any(_is_union(value_type) for value_type in value_types):
            value_types = _select_union_members(value_types, str(element))
        elif element != "[key]":
            path.append(element)
            parents = value_types
            value_types = tuple(
                element_type
                for value_type in value_types
                for element_type in _element_types(value_type, element)
            )
    return tuple(path), parents, value_types


def _unwrap_type(annotation: Any) -> Any:
    """Return the type without wrappers that do not appear in a location (Annotated, None)."""
    while True:
        if get_origin(annotation) is Annotated:
            wrapped_type, *metadata = get_args(annotation)
            plugin_union = next(
                (marker for marker in metadata if isinstance(marker, PluginUnion)), None
            )
            if plugin_union is not None:
                return plugin_union
            annotation = wrapped_type
        elif _is_union(annotation) and len(_union_members(annotation)) == 1:
            annotation = _union_members(annotation)[0]
        else:
            return annotation


def _is_union(annotation: Any) -> bool:
    return isinstance(annotation, PluginUnion) or get_origin(annotation) in (Union, types.UnionType)


def _union_members(union: Any) -> list[Any]:
    return [member for member in get_args(union) if member is not type(None)]


def _select_union_members(union_types: tuple[Any, ...], label: str) -> tuple[Any, ...]:
    """Return the members of unions that a label of pydantic denotes; all if none matches.

    A label is the value of a discriminator or the name of a type.
    """
    named_kinds = [
        union_type.find_kind(label)
        for union_type in union_types
        if isinstance(union_type, PluginUnion) and label in union_type.kind_names()
    ]
    if named_kinds:
        return tuple(kind_class for kind_class in named_kinds if isinstance(kind_class, type))
    options = [
        _unwrap_type(member)
        for union_type in union_types
        if _is_union(union_type)
        for member in _union_members(union_type)
    ]
    options_by_tag = [
        option
        for option in options
        if any(label in values for values in _literal_fields(option).values())
    ]
    label_words = re.findall(r"\w+", label)
    options_by_name = [
        option
        for option in options
        if getattr(get_origin(option) or option, "__name__", "") in label_words
    ]
    return tuple(options_by_tag or options_by_name or options)


def _element_types(container_type: Any, element: str | int) -> list[Any]:
    """Return the possible types of the value under a key or index of a container type."""
    if _is_model_class(container_type):
        return [
            _unwrap_type(annotation)
            for key, annotation in _annotations_by_key(container_type).items()
            if key == element
        ]
    arguments = get_args(container_type)
    if (
        get_origin(container_type) is tuple
        and isinstance(element, int)
        and Ellipsis not in arguments
    ):
        return [_unwrap_type(argument) for argument in arguments[element : element + 1]]
    # the last type argument is that of the values of a mapping and of the items of a list
    return [_unwrap_type(argument) for argument in arguments if argument is not Ellipsis][-1:]


def _is_model_class(type_: Any) -> bool:
    return isinstance(type_, type) and issubclass(type_, BaseModel)


def _annotations_by_key(model: type[BaseModel]) -> dict[str, Any]:
    return {
        field.alias or name: _annotation_with_marker(field)
        for name, field in model.model_fields.items()
    }


def _annotation_with_marker(field: FieldInfo) -> Any:
    """Return the annotation of a field with the marker that pydantic moved to the metadata."""
    plugin_union = next(
        (marker for marker in field.metadata if isinstance(marker, PluginUnion)), None
    )
    return field.annotation if plugin_union is None else Annotated[field.annotation, plugin_union]


def _literal_fields(model: Any) -> dict[str, tuple[Any, ...]]:
    """Return the fields of a model whose type is a literal, with the allowed values."""
    if not _is_model_class(model):
        return {}
    unwrapped = {
        key: _unwrap_type(annotation) for key, annotation in _annotations_by_key(model).items()
    }
    return {
        key: get_args(annotation)
        for key, annotation in unwrapped.items()
        if get_origin(annotation) is Literal
    }


def _kind_suffix(section_types: tuple[Any, ...]) -> str:
    # the valid keys of a section depend on its kind, which an override may have changed
    single_literals = [
        (key, values[0])
        for section_type in section_types
        for key, values in _literal_fields(section_type).items()
        if len(values) == 1
    ]
    return (
        f" ({single_literals[0][0]} '{single_literals[0][1]}')" if len(single_literals) == 1 else ""
    )


def _discriminator_values(union_types: tuple[Any, ...], key: str | int) -> list[str]:
    names = [
        name
        for union_type in union_types
        if isinstance(union_type, PluginUnion)
        for name in union_type.kind_names()
    ]
    options = [
        _unwrap_type(member)
        for union_type in union_types
        if _is_union(union_type)
        for member in _union_members(union_type)
    ]
    return names + [
        str(tag) for option in options for tag in _literal_fields(option).get(str(key), ())
    ]

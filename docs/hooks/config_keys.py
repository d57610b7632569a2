"""Read the config classes for the reference of all config keys.

`python docs/hooks/config_keys.py` lists the keys that no docstring documents. The exit code is 1 if
there are any.
"""

from __future__ import annotations

import enum
import inspect
import sys
import types
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import griffe
from pydantic import BaseModel, JsonValue
from pydantic.fields import FieldInfo

from residnet.core.config import Quantity
from residnet.core.registry import PluginUnion, load_kinds
from residnet.physics.vessel import VesselConfig
from residnet.tasks.registry import TaskConfig

ROOTS = (TaskConfig, VesselConfig)
DISCRIMINATORS = ("task", "kind")
_BASIC_TYPES = {str: "text", int: "whole number", float: "number", bool: "`true` or `false`"}
_EXAMPLES = {"rad": "20 deg", "rad/s": "3 deg/s", "m/s": "6 kn", "1/s": "120 rpm", "kg": "1.8 t"}
_LIMITS = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}


@dataclass(frozen=True)
class Key:
    """One key of a config class.

    Attributes:
        name: name in YAML.
        type: accepted values as Markdown; `{module.Name}` is replaced by a link to a class.
        default: default value as Markdown; empty if the key is required.
        text: documentation of the key; None without one.
    """

    name: str
    type: str
    default: str
    text: str | None


def is_config(annotation: object) -> typing.TypeGuard[type[BaseModel]]:
    """Return whether an annotation is a config class."""
    return inspect.isclass(annotation) and issubclass(annotation, BaseModel)


def list_type_arguments(annotation: object) -> tuple[Any, ...]:
    """Return the types inside an annotation: members of a union, elements of a list and others."""
    if typing.get_origin(annotation) is Literal:
        return ()
    if typing.get_origin(annotation) is typing.Annotated and find_plugin_union(
        annotation.__metadata__
    ):
        return tuple(load_kinds(annotation).values())
    aliased = getattr(annotation, "__value__", None)
    return (aliased,) if aliased is not None else typing.get_args(annotation)


def find_plugin_union(metadata: typing.Sequence[object]) -> PluginUnion | None:
    """Return the registered kinds that an annotation accepts; None if it is no choice of kinds."""
    return next((item for item in metadata if isinstance(item, PluginUnion)), None)


def list_config_classes() -> list[type[BaseModel]]:
    """Return all config classes of the YAML files of runs and vessels, in order."""
    classes: dict[type[BaseModel], None] = {}

    def visit(annotation: object) -> None:
        if is_config(annotation):
            if annotation not in classes:
                classes[annotation] = None
                for field in annotation.model_fields.values():
                    union = find_plugin_union(field.metadata)
                    field_type = field.annotation
                    visit(field_type if union is None else typing.Annotated[field_type, union])
        else:
            for part in list_type_arguments(annotation):
                visit(part)

    for root in ROOTS:
        visit(root)
    return list(classes)


def collect_attribute_texts(config: type[BaseModel]) -> dict[str, str]:
    """Return the text of each key in the section `Attributes` of a class and its bases."""
    texts: dict[str, str] = {}
    for base in reversed(config.__mro__):
        for section in griffe.Docstring(inspect.cleandoc(base.__doc__ or "")).parse("google"):
            if section.kind is griffe.DocstringSectionKind.attributes:
                texts.update(
                    {entry.name: " ".join(entry.description.split()) for entry in section.value}
                )
    return texts


def read_summary(config: type[BaseModel]) -> str:
    """Return the docstring of a class without its sections."""
    sections = griffe.Docstring(inspect.cleandoc(config.__doc__ or "")).parse("google")
    texts = [s.value for s in sections if s.kind is griffe.DocstringSectionKind.text]
    return "\n\n".join(texts)


def format_selector(config: type[BaseModel]) -> str | None:
    """Return the key that selects this class, such as `kind: lstm`; None without such a key."""
    for name in DISCRIMINATORS:
        field = config.model_fields.get(name)
        if field is not None and typing.get_origin(field.annotation) is Literal:
            values = typing.get_args(field.annotation)
            if len(values) == 1:
                return f"{name}: {values[0]}"
    return None


def make_class_link(config: type[BaseModel]) -> str:
    """Return the placeholder of a link to a config class."""
    return "{" + f"{config.__module__}.{config.__qualname__}" + "}"


def describe_type(annotation: Any, metadata: typing.Sequence[object] = ()) -> str:
    """Return the accepted values of an annotation in words."""
    quantity = next((item for item in metadata if isinstance(item, Quantity)), None)
    if quantity is not None:
        example = _EXAMPLES.get(quantity.si, f"1.5 {quantity.si}")
        return f"number in {quantity.si}, or text such as `{example}`"
    origin = typing.get_origin(annotation)
    arguments = typing.get_args(annotation)
    if (aliased := getattr(annotation, "__value__", None)) is not None:
        return "any value" if annotation is JsonValue else describe_type(aliased)
    if (union := find_plugin_union(metadata)) is not None:
        classes_by_kind = load_kinds(typing.Annotated[annotation, union])
        return " or ".join(describe_type(member) for member in classes_by_kind.values())
    if origin is typing.Annotated:
        return describe_type(arguments[0], arguments[1:])
    if origin is Literal:
        return ", ".join(f"`{'null' if value is None else value}`" for value in arguments)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(dict.fromkeys(describe_type(part) for part in arguments))
    if origin is tuple and len(arguments) > 1 and arguments[1] is not Ellipsis:
        return "list of (" + "; ".join(describe_type(part) for part in arguments) + ")"
    if origin in (tuple, list, frozenset, set):
        return f"list of {describe_type(arguments[0])}"
    if inspect.isclass(origin) and issubclass(origin, Mapping):
        return f"mapping from {describe_type(arguments[0])} to {describe_type(arguments[1])}"
    return _describe_named_type(annotation)


def _describe_named_type(annotation: Any) -> str:
    if annotation is type(None):
        return "`null`"
    if is_config(annotation):
        return make_class_link(annotation)
    if inspect.isclass(annotation):
        if annotation in _BASIC_TYPES:
            return _BASIC_TYPES[annotation]
        if issubclass(annotation, Path):
            return "path"
        if issubclass(annotation, enum.Enum):
            return ", ".join(f"`{member.value}`" for member in annotation)
    return "any value" if annotation in (Any, object) else f"`{annotation}`"


def describe_limits(field: FieldInfo) -> str:
    """Return the bounds of a key, for example ` (≥ 0)`."""
    bounds = [
        f"{sign} {getattr(item, name):g}"
        for item in field.metadata
        for name, sign in _LIMITS.items()
        if getattr(item, name, None) is not None
    ]
    lengths = [
        f"at least {item.min_length} long"
        for item in field.metadata
        if getattr(item, "min_length", None)
    ]
    return f" ({', '.join(bounds + lengths)})" if bounds or lengths else ""


def to_yaml_value(value: object) -> object:
    """Return a default as a value of YAML."""
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json", exclude_defaults=True)
    if isinstance(value, Mapping):
        return {key: to_yaml_value(part) for key, part in value.items()}
    if isinstance(value, (tuple, list)):
        return [to_yaml_value(part) for part in value]
    return str(value) if isinstance(value, Path) else value


def describe_default(field: FieldInfo) -> str:
    """Return the default of a key as Markdown; empty if the key is required."""
    if field.is_required():
        return ""
    value = field.get_default(call_default_factory=True)
    if isinstance(value, BaseModel):
        selector = format_selector(type(value))
        return f"`{selector}`" if selector else f"{make_class_link(type(value))} with its defaults"
    value = to_yaml_value(value)
    if value is None:
        return "`null`"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if value == "":
        return "empty text"
    return f"`{value:g}`" if isinstance(value, float) else f"`{value}`"


def iterate_keys(config: type[BaseModel]) -> Iterator[Key]:
    """Yield the keys of a class except the one that selects the class."""
    texts = collect_attribute_texts(config)
    selecting_key = (format_selector(config) or "").partition(":")[0]
    for name, field in config.model_fields.items():
        if name != selecting_key:
            accepted = describe_type(field.annotation, field.metadata) + describe_limits(field)
            key = field.alias or name
            text = field.description or texts.get(key) or texts.get(name)
            yield Key(key, accepted, describe_default(field), text)


def list_undocumented_keys() -> list[str]:
    """Return `module: Class.key` of every key that no docstring documents."""
    return sorted(
        f"{config.__module__}: {config.__name__}.{key.name}"
        for config in list_config_classes()
        for key in iterate_keys(config)
        if not key.text
    )


if __name__ == "__main__":
    undocumented_keys = list_undocumented_keys()
    print("\n".join(undocumented_keys))
    sys.exit(bool(undocumented_keys))

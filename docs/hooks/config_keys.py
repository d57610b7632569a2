"""Reads the config classes for the reference of every config key.

`python docs/hooks/config_keys.py` lists the keys that no docstring documents and exits with 1
where there are any.
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
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from residnet.core.config import Quantity
from residnet.core.registry import PluginUnion, load_kinds
from residnet.physics.vessel import VesselConfig
from residnet.tasks.registry import TaskConfig

ROOTS = (TaskConfig, VesselConfig)
DISCRIMINATORS = ("task", "kind")
_PLAIN = {str: "text", int: "whole number", float: "number", bool: "`true` or `false`"}
_EXAMPLES = {"rad": "20 deg", "rad/s": "3 deg/s", "m/s": "6 kn", "1/s": "120 rpm", "kg": "1.8 t"}
_LIMITS = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}


@dataclass(frozen=True)
class Key:
    """One key of a config class.

    Attributes:
        name: as it is written in YAML.
        type: what the key takes, as Markdown; `{module.Name}` stands for a link to a class.
        default: as Markdown; empty where the key is required.
        text: the documentation, None where there is none.
    """

    name: str
    type: str
    default: str
    text: str | None


def is_config(annotation: object) -> typing.TypeGuard[type[BaseModel]]:
    """Tell whether an annotation is a config class."""
    return inspect.isclass(annotation) and issubclass(annotation, BaseModel)


def parts(annotation: object) -> tuple[Any, ...]:
    """Return what an annotation is made of: members of a union, elements of a list, and so on."""
    if typing.get_origin(annotation) is Literal:
        return ()
    if typing.get_origin(annotation) is typing.Annotated and marked(annotation.__metadata__):
        return tuple(load_kinds(annotation).values())
    aliased = getattr(annotation, "__value__", None)
    return (aliased,) if aliased is not None else typing.get_args(annotation)


def marked(metadata: typing.Sequence[object]) -> PluginUnion | None:
    """Return the kinds that an annotation takes; None where it is no choice of kinds."""
    return next((item for item in metadata if isinstance(item, PluginUnion)), None)


def config_classes() -> list[type[BaseModel]]:
    """Return every config class that a run's or a vessel's YAML file can reach, in their order."""
    found: dict[type[BaseModel], None] = {}

    def visit(annotation: object) -> None:
        if is_config(annotation):
            if annotation not in found:
                found[annotation] = None
                for field in annotation.model_fields.values():
                    mark = marked(field.metadata)
                    kind = field.annotation
                    visit(kind if mark is None else typing.Annotated[kind, mark])
        else:
            for part in parts(annotation):
                visit(part)

    for root in ROOTS:
        visit(root)
    return list(found)


def documented(config: type[BaseModel]) -> dict[str, str]:
    """Return the text of each key under `Attributes:` of a class and its bases."""
    texts: dict[str, str] = {}
    for base in reversed(config.__mro__):
        for section in griffe.Docstring(inspect.cleandoc(base.__doc__ or "")).parse("google"):
            if section.kind is griffe.DocstringSectionKind.attributes:
                texts.update(
                    {entry.name: " ".join(entry.description.split()) for entry in section.value}
                )
    return texts


def summary(config: type[BaseModel]) -> str:
    """Return the docstring of a class without its sections."""
    sections = griffe.Docstring(inspect.cleandoc(config.__doc__ or "")).parse("google")
    texts = [s.value for s in sections if s.kind is griffe.DocstringSectionKind.text]
    return "\n\n".join(texts)


def selector(config: type[BaseModel]) -> str | None:
    """Return the key that selects this class, such as `kind: lstm`; None where there is none."""
    for name in DISCRIMINATORS:
        field = config.model_fields.get(name)
        if field is not None and typing.get_origin(field.annotation) is Literal:
            values = typing.get_args(field.annotation)
            if len(values) == 1:
                return f"{name}: {values[0]}"
    return None


def reference(config: type[BaseModel]) -> str:
    """Return what stands for a link to a config class."""
    return "{" + f"{config.__module__}.{config.__qualname__}" + "}"


def described_type(annotation: Any, metadata: typing.Sequence[object] = ()) -> str:
    """Return what an annotation takes, in words."""
    quantity = next((item for item in metadata if isinstance(item, Quantity)), None)
    if quantity is not None:
        example = _EXAMPLES.get(quantity.si, f"1.5 {quantity.si}")
        return f"number in {quantity.si}, or text such as `{example}`"
    origin = typing.get_origin(annotation)
    arguments = typing.get_args(annotation)
    if (aliased := getattr(annotation, "__value__", None)) is not None:
        return described_type(aliased)
    if (mark := marked(metadata)) is not None:
        of_kind = load_kinds(typing.Annotated[annotation, mark])
        return " or ".join(described_type(member) for member in of_kind.values())
    if origin is typing.Annotated:
        return described_type(arguments[0], arguments[1:])
    if origin is Literal:
        return ", ".join(f"`{'null' if value is None else value}`" for value in arguments)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(dict.fromkeys(described_type(part) for part in arguments))
    if origin is tuple and len(arguments) > 1 and arguments[1] is not Ellipsis:
        return "list of (" + "; ".join(described_type(part) for part in arguments) + ")"
    if origin in (tuple, list, frozenset, set):
        return f"list of {described_type(arguments[0])}"
    if inspect.isclass(origin) and issubclass(origin, Mapping):
        return f"mapping from {described_type(arguments[0])} to {described_type(arguments[1])}"
    return _named_type(annotation)


def _named_type(annotation: Any) -> str:
    if annotation is type(None):
        return "`null`"
    if is_config(annotation):
        return reference(annotation)
    if inspect.isclass(annotation):
        if annotation in _PLAIN:
            return _PLAIN[annotation]
        if issubclass(annotation, Path):
            return "path"
        if issubclass(annotation, enum.Enum):
            return ", ".join(f"`{member.value}`" for member in annotation)
    return "any value" if annotation in (Any, object) else f"`{annotation}`"


def limits(field: FieldInfo) -> str:
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


def plain(value: object) -> object:
    """Return a default as it would stand in YAML."""
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json", exclude_defaults=True)
    if isinstance(value, Mapping):
        return {key: plain(part) for key, part in value.items()}
    if isinstance(value, (tuple, list)):
        return [plain(part) for part in value]
    return str(value) if isinstance(value, Path) else value


def default(field: FieldInfo) -> str:
    """Return the default of a key as Markdown; empty where the key is required."""
    if field.is_required():
        return ""
    value = field.get_default(call_default_factory=True)
    if isinstance(value, BaseModel):
        chosen = selector(type(value))
        return f"`{chosen}`" if chosen else f"{reference(type(value))} with its defaults"
    value = plain(value)
    if value is None:
        return "`null`"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if value == "":
        return "empty text"
    return f"`{value:g}`" if isinstance(value, float) else f"`{value}`"


def keys(config: type[BaseModel]) -> Iterator[Key]:
    """Yield the keys of a class, the one that selects the class left out."""
    texts = documented(config)
    chosen = (selector(config) or "").partition(":")[0]
    for name, field in config.model_fields.items():
        if name != chosen:
            kind = described_type(field.annotation, field.metadata) + limits(field)
            key = field.alias or name
            text = field.description or texts.get(key) or texts.get(name)
            yield Key(key, kind, default(field), text)


def undocumented() -> list[str]:
    """Return `module: Class.key` of every key that no docstring documents."""
    return sorted(
        f"{config.__module__}: {config.__name__}.{key.name}"
        for config in config_classes()
        for key in keys(config)
        if not key.text
    )


if __name__ == "__main__":
    missing = undocumented()
    print("\n".join(missing))
    sys.exit(bool(missing))

"""One line out of pydantic's validation errors.

The line says which key, what is wrong, what was given, and the nearest valid name.
"""

from __future__ import annotations

import re
import types
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from residnet.core.config_yaml import KeyPath
from residnet.core.names import nearest, shown
from residnet.core.registry import Kinds

_EXPECTED = {
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "int_parsing": "a whole number",
    "float_type": "a number",
    "float_parsing": "a number",
    "string_type": "text",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "none_required": "null",
    "list_type": "a list",
    "tuple_type": "a list",
    "set_type": "a list",
    "frozen_set_type": "a list",
    "dict_type": "a mapping",
    "model_type": "a mapping",
    "model_attributes_type": "a mapping",
}


@dataclass(frozen=True)
class _Fault:
    kind: str
    path: KeyPath
    text: str


def describe(error: ValidationError, model: Any, where: Callable[[KeyPath], str]) -> str:
    """Return the first fault of a validation error as one line.

    Args:
        error: what pydantic raised.
        model: the type that was validated against.
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
            text = f"unknown key{nearest(str(path[-1]), _keys(parents))}{_of_kind(parents)}"
        case "union_tag_invalid":
            path += _discriminator(context)
            tag = str(context["tag"])
            text = f"unknown value '{shown(tag)}'{nearest(tag, _quoted(context['expected_tags']))}"
        case "union_tag_not_found":
            path += _discriminator(context)
            text = f"missing{nearest('', _tags(here, path[-1]))}"
        case "literal_error" | "enum":
            valid = _quoted(context["expected"])
            unknown = isinstance(value, str) and bool(valid)
            text = (
                f"unknown value '{shown(value)}'{nearest(value, valid)}"
                if unknown
                else f"expected {context['expected']} {given(value)}"
            )
        case "value_error" | "assertion_error":
            text = _own_text(str(context["error"]), value)
        case _ if kind in _EXPECTED:
            text = f"expected {_EXPECTED[kind]} {given(value)}"
        case _:
            text = f"{details['msg'].replace('Input should', 'must')} {given(value)}"
    return _Fault(kind, path, text)


def _own_text(text: str, value: Any) -> str:
    # a validator of a whole section has said which of its keys it means; the section itself would
    # only fill the line
    scalar = isinstance(value, (str, int, float)) and "(given " not in text
    return f"{text} {given(value)}" if scalar else text


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
    here = _members(model)
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
            # the kinds of other packages are no part of the annotation itself
            annotation = inside if kinds is None else get_args(kinds.union(inside))[0]
        elif _is_union(annotation) and len(_options(annotation)) == 1:
            annotation = _options(annotation)[0]
        else:
            return annotation


def _is_union(annotation: Any) -> bool:
    return get_origin(annotation) in (Union, types.UnionType)


def _options(union: Any) -> list[Any]:
    return [member for member in get_args(union) if member is not type(None)]


def _members(annotation: Any) -> tuple[Any, ...]:
    return (_plain(annotation),)


def _chosen(kinds: tuple[Any, ...], label: str) -> tuple[Any, ...]:
    """Return the members of unions that pydantic's label stands for; all where none fits.

    A label is a discriminator's value or the name of a type.
    """
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


def _keys(kinds: tuple[Any, ...]) -> list[str]:
    return [key for kind in kinds if _is_model(kind) for key in _fields(kind)]


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
    options = [_plain(member) for kind in kinds if _is_union(kind) for member in _options(kind)]
    return [str(tag) for option in options for tag in _literals(option).get(str(key), ())]

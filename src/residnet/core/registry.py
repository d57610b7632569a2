"""Kinds of parts by name: built-in ones, and those of other installed packages by entry points.

A package declares its part in its own pyproject.toml, for example

    [project.entry-points."residnet.heads"]
    tide = "my_package.heads:TideConfig"

and `kind: tide` works in YAML, in Python and in `residnet list heads`. A part that cannot be loaded
is kept with its fault: it says so where it is used, and disturbs nothing else. A kind is imported
when a config names it.
"""

from __future__ import annotations

import ast
import functools
import importlib
import importlib.metadata
import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel, GetCoreSchemaHandler, ValidationInfo
from pydantic_core import CoreSchema, core_schema, to_json

import residnet
from residnet.core.errors import ConfigError, UsageError
from residnet.core.names import nearest

GROUPS = (
    "residnet.heads",
    "residnet.baselines",
    "residnet.readers",
    "residnet.manoeuvres",
    "residnet.vessels",
    "residnet.tasks",
    "residnet.exporters",
)
"""Groups of entry points that residnet reads."""


@dataclass(frozen=True)
class ThirdParty:
    """An entry point of another package.

    Attributes:
        name: the name that YAML and `residnet list` know it by.
        package: name and version of the package that it comes from.
        part: what the entry point leads to; None where it is broken.
        fault: why it cannot be used, one line; empty where it can.
    """

    name: str
    package: str
    part: Any = None
    fault: str = ""

    @property
    def complaint(self) -> str:
        """One line that says which part of which package cannot be used, and why."""
        return (
            f"'{self.name}' of the package {self.package} cannot be used: {self.fault}; repair or"
            " uninstall that package"
        )

    def checked(self, check: Callable[[], str]) -> ThirdParty:
        """Return the entry point, with a fault instead of its part where `check` returns one."""
        fault = self.fault or check()
        return ThirdParty(self.name, self.package, None, fault) if fault else self


_loading: list[str] = []


@functools.cache
def third_party(group: str) -> tuple[ThirdParty, ...]:
    """Return the entry points of one group, loaded once, sorted by name.

    Args:
        group: one of `GROUPS`.

    Raises:
        UsageError: where a part is needed while it is itself being imported.
    """
    if group in _loading:
        raise UsageError(
            f"a package with entry points in {group} builds residnet configs while it is imported;"
            " build them inside a function"
        )
    _loading.append(group)
    try:
        points = importlib.metadata.entry_points(group=group)
        return tuple(_loaded(point) for point in sorted(points, key=lambda point: point.name))
    finally:
        _loading.remove(group)


def _loaded(point: importlib.metadata.EntryPoint) -> ThirdParty:
    package = "unknown" if point.dist is None else f"{point.dist.name} {point.dist.version}"
    try:
        return ThirdParty(point.name, package, point.load())
    except Exception as error:  # whatever a foreign package does wrong must not stop all others
        lines = str(error).splitlines() or [""]
        return ThirdParty(point.name, package, None, f"{type(error).__name__}: {lines[0]}")


def forget() -> None:
    """Read the entry points anew when they are next needed, for tests that install packages."""
    third_party.cache_clear()


@dataclass(frozen=True, eq=False)
class Kinds:
    """Marks a config field that takes one of several kinds, those of other packages included.

    `TaskConfig = Annotated[Task, Kinds("residnet.tasks", Task, {"fit": "residnet.tasks.fit:Fit"},
    key="task")]`. A kind's module is imported when a config names the kind.

    Attributes:
        group: of the entry points.
        base: class that the configs of other packages must extend.
        builtin: residnet's own kinds, each as `module:Class`; where there are none, the annotation
            is a union of their classes.
        key: field that tells the kinds apart.
    """

    group: str
    base: type[BaseModel]
    builtin: Mapping[str, Any] = field(default_factory=dict)
    key: str = "kind"

    def of(self, annotation: Any) -> Kinds:
        """Return the same kinds with the built-in ones of the annotation that is marked."""
        if self.builtin:
            return self
        members = (annotation,) if inspect.isclass(annotation) else get_args(annotation)
        return replace(self, builtin={str(kind_of(member, self.key)): member for member in members})

    def others(self) -> list[ThirdParty]:
        """Return the kinds of other packages, each checked against what a kind has to be."""
        taken = dict.fromkeys(self.builtin, "residnet")
        out = []
        for found in third_party(self.group):
            out.append(found.checked(functools.partial(self._fault, found, taken.get(found.name))))
            taken.setdefault(found.name, found.package)
        return out

    def _fault(self, found: ThirdParty, taken_by: str | None) -> str:
        if taken_by is not None:
            return f"{taken_by} has a {self.key} of that name already"
        fault = _no_subclass(found.part, self.base)
        if not fault and kind_of(found.part, self.key) != found.name:
            return f"{found.part.__name__} has no field `{self.key}: Literal['{found.name}']`"
        return fault

    def names(self) -> list[str]:
        """Return the names of all kinds, broken ones included."""
        return list(dict.fromkeys([*self.builtin, *(part.name for part in self.others())]))

    def find(self, name: str) -> type[Any] | ThirdParty:
        """Return the config class of one kind; a broken one of another package as it is kept."""
        if name in self.builtin:
            found: type[Any] = _imported(self.builtin[name])
            return found
        # a second part of the same name could never be told from the first
        other = next(part for part in self.others() if part.name == name)
        return other if other.fault else other.part

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Return the schema of a union that is told apart by `key` and imports what is named."""
        kinds = self.of(source)
        return core_schema.tagged_union_schema(
            {
                name: core_schema.with_info_plain_validator_function(
                    functools.partial(kinds._validated, name)
                )
                for name in kinds.names()
            },
            discriminator=self.key,
            from_attributes=True,
        )

    def _validated(self, name: str, value: Any, info: ValidationInfo) -> Any:
        found = self.find(name)
        if isinstance(found, ThirdParty):
            raise ValueError(found.complaint)
        if isinstance(value, found):
            return value
        if info.mode == "json":
            # what is strict in JSON is stricter in Python: no list is a tuple there
            return found.model_validate_json(to_json(value), strict=True, context=info.context)
        return found.model_validate(value, context=info.context)


def _imported(place: Any) -> Any:
    if not isinstance(place, str):
        return place
    module, _, name = place.partition(":")
    return getattr(importlib.import_module(module), name)


def kind_of(config: type[BaseModel], key: str = "kind") -> str | None:
    """Return the value of the field that tells a config class from others; None without one."""
    found = config.model_fields.get(key)
    if found is None or get_origin(found.annotation) is not Literal:
        return None
    return str(get_args(found.annotation)[0])


def marker(union: Any) -> Kinds:
    """Return the kinds that a field of this type takes.

    Raises:
        UsageError: where other packages cannot add to the union.
    """
    found = next((part for part in get_args(union)[1:] if isinstance(part, Kinds)), None)
    if found is None:
        raise UsageError(f"{union} is no union of kinds that other packages may add to")
    return found.of(get_args(union)[0])


def kinds(union: Any) -> dict[str, Any]:
    """Return the config classes by kind, all imported: built-in ones, then those of other packages.

    Args:
        union: for example `residnet.heads.HeadConfig`.
    """
    mark = marker(union)
    found = {name: mark.find(name) for name in mark.names()}
    return {name: part for name, part in found.items() if not isinstance(part, ThirdParty)}


def listed(union: Any) -> list[tuple[str, str]]:
    """Return name and first line of every kind; residnet's own ones are read, not imported."""
    mark = marker(union)
    out = [(name, _first_line(place)) for name, place in mark.builtin.items()]
    return out + [
        (part.name, broken_line(part) if part.fault else _first_line(part.part))
        for part in mark.others()
    ]


def broken_line(part: ThirdParty) -> str:
    """Return what a list says about a part that cannot be used."""
    return f"(cannot be used: {part.fault}; from {part.package})"


def _first_line(place: Any) -> str:
    if not isinstance(place, str):
        return (place.__doc__ or "").strip().splitlines()[0]
    module, _, name = place.partition(":")
    at = Path(residnet.__file__).parent.joinpath(*module.split(".")[1:])
    file = at / "__init__.py" if at.is_dir() else at.with_suffix(".py")
    for node in ast.parse(file.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ClassDef) and node.name == name:
            return (ast.get_docstring(node) or "").partition("\n")[0]
    return _first_line(_imported(place))


def objects(group: str, builtin: Mapping[str, Any], base: type[Any]) -> dict[str, Any]:
    """Return parts that are no configs, built-in and third-party ones, by name.

    Args:
        group: of the entry points; each leads to a subclass of `base` that takes no arguments.
        builtin: the parts of residnet.
        base: class of the parts; its attribute `name` must be that of the entry point.

    Returns:
        The parts; for a broken one its `ThirdParty`, which says what is wrong with it.
    """
    out: dict[str, Any] = dict(builtin)
    for found in third_party(group):
        if found.name not in out:
            checked = found.checked(functools.partial(_object_fault, found, base))
            out[found.name] = checked if checked.fault else found.part()
    return out


def _object_fault(found: ThirdParty, base: type[Any]) -> str:
    fault = _no_subclass(found.part, base)
    if not fault and found.part.__dict__.get("name") != found.name:
        return f"{found.part.__name__} has no attribute `name = '{found.name}'`"
    return fault


def _no_subclass(part: Any, base: type[Any]) -> str:
    abstract: frozenset[str] = getattr(part, "__abstractmethods__", frozenset())
    if not (inspect.isclass(part) and issubclass(part, base)):
        return f"its entry point is no subclass of {base.__module__}.{base.__name__}"
    if abstract:
        return f"{part.__name__} lacks {', '.join(sorted(abstract))}"
    return ""


def usable(parts: Mapping[str, Any], name: str, what: str) -> Any:
    """Return the part of that name.

    Raises:
        ConfigError: where there is none, or it is broken.
    """
    if name not in parts:
        raise ConfigError(f"no {what} '{name}'{nearest(name, parts)}")
    if isinstance(parts[name], ThirdParty):
        raise ConfigError(f"{what} {parts[name].complaint}")
    return parts[name]


def folders(group: str) -> dict[str, Path | ThirdParty]:
    """Return the folders that packages offer in a group, by entry point; a broken one is kept.

    An entry point of such a group names a package (a folder with an `__init__.py`); what it offers
    lies beside that file.
    """
    out: dict[str, Path | ThirdParty] = {}
    for found in third_party(group):
        file = getattr(found.part, "__file__", None)
        if found.fault:
            out[found.name] = found
        elif not inspect.ismodule(found.part) or file is None:
            fault = "its entry point is no package with files beside it"
            out[found.name] = replace(found, part=None, fault=fault)
        else:
            out[found.name] = Path(file).parent
    return out

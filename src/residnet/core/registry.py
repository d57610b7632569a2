"""Parts of other installed packages: found through entry points, used by name as the built-in ones.

A package declares its part in its own pyproject.toml, for example

    [project.entry-points."residnet.heads"]
    tide = "my_package.heads:TideConfig"

and `kind: tide` works in YAML, in Python and in `residnet list heads`. A part that cannot be loaded
is kept with its fault: it says so where it is used, and disturbs nothing else.
"""

from __future__ import annotations

import functools
import importlib.metadata
import inspect
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    create_model,
    model_validator,
)
from pydantic_core import CoreSchema

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

    def broken(self, fault: str) -> ThirdParty:
        """Return the same entry point with a fault instead of its part."""
        return ThirdParty(self.name, self.package, None, fault)

    @property
    def complaint(self) -> str:
        """One line that says which part of which package cannot be used, and why."""
        return (
            f"'{self.name}' of the package {self.package} cannot be used: {self.fault}; repair or"
            " uninstall that package"
        )


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


@dataclass(frozen=True)
class Kinds:
    """Marks a union of configs that other packages may add kinds to.

    `HeadConfig = Annotated[PlsrConfig | LstmConfig, Kinds("residnet.heads", FeatureConfig)]` takes
    the built-in kinds and those of the entry points; the entry points are read when the first
    config is validated.

    Attributes:
        group: of the entry points.
        base: class that the configs of other packages must extend.
        key: field that tells the kinds apart.
    """

    group: str
    base: type[BaseModel]
    key: str = "kind"

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Return the schema of the built-in kinds and those of the entry points."""
        return handler.generate_schema(self.union(source))

    def union(self, builtin: Any) -> Any:
        """Return the discriminated union of all kinds; a broken one raises its fault when used."""
        every = {str(kind_of(member, self.key)): member for member in _members(builtin)}
        for part in self.others(builtin):
            # a second part of the same name could never be told from the first
            every.setdefault(part.name, _stand_in(part, self.key) if part.fault else part.part)
        # a union that is put together at run time has no other spelling
        return Annotated[Union[tuple(every.values())], Field(discriminator=self.key)]  # noqa: UP007

    def others(self, builtin: Any) -> list[ThirdParty]:
        """Return the kinds of other packages, each checked against what a kind has to be."""
        taken = {str(kind_of(member, self.key)): "residnet" for member in _members(builtin)}
        out = []
        for found in third_party(self.group):
            fault = found.fault or self._fault(found, taken)
            out.append(found.broken(fault) if fault else found)
            taken.setdefault(found.name, found.package)
        return out

    def _fault(self, found: ThirdParty, taken: Mapping[str, str]) -> str:
        part = found.part
        if found.name in taken:
            return f"{taken[found.name]} has a {self.key} of that name already"
        if not (inspect.isclass(part) and issubclass(part, self.base)):
            return f"its entry point is no subclass of {self.base.__module__}.{self.base.__name__}"
        if inspect.isabstract(part):
            return f"{part.__name__} lacks {_missing(part)}"
        if kind_of(part, self.key) != found.name:
            return f"{part.__name__} has no field `{self.key}: Literal['{found.name}']`"
        return ""


def _members(union: Any) -> tuple[Any, ...]:
    return (union,) if inspect.isclass(union) else get_args(union)


def kind_of(config: type[BaseModel], key: str = "kind") -> str | None:
    """Return the value of the field that tells a config class from others; None without one."""
    field = config.model_fields.get(key)
    if field is None or get_origin(field.annotation) is not Literal:
        return None
    return str(get_args(field.annotation)[0])


def _stand_in(part: ThirdParty, key: str) -> type[BaseModel]:
    """Return a config class that answers for a broken part: it refuses with the part's fault."""

    def refuse(cls: type[BaseModel], data: Any) -> Any:
        raise ValueError(part.complaint)

    fields: dict[str, Any] = {key: (Literal[part.name], part.name)}
    validators: dict[str, Any] = {"refuse": model_validator(mode="before")(refuse)}
    made: type[BaseModel] = create_model(
        "Broken",
        __config__=ConfigDict(extra="allow"),
        __validators__=validators,
        **fields,
    )
    return made


def marker(union: Any) -> Kinds:
    """Return the marker of a union of kinds.

    Raises:
        UsageError: where other packages cannot add to the union.
    """
    found = next((part for part in get_args(union)[1:] if isinstance(part, Kinds)), None)
    if found is None:
        raise UsageError(f"{union} is no union of kinds that other packages may add to")
    return found


def kinds(union: Any) -> dict[str, Any]:
    """Return the config classes of a union by kind: built-in ones, then those of other packages.

    Args:
        union: for example `residnet.heads.HeadConfig`.
    """
    mark, builtin = marker(union), _members(get_args(union)[0])
    found = {str(kind_of(member, mark.key)): member for member in builtin}
    others = mark.others(get_args(union)[0])
    return found | {part.name: part.part for part in others if not part.fault}


def broken_kinds(union: Any) -> dict[str, ThirdParty]:
    """Return the parts of other packages that cannot be used, by name."""
    mark = marker(union)
    return {part.name: part for part in mark.others(get_args(union)[0]) if part.fault}


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
        fault = found.fault or _object_fault(found, base)
        if found.name not in out:
            out[found.name] = found.broken(fault) if fault else found.part()
    return out


def _object_fault(found: ThirdParty, base: type[Any]) -> str:
    part = found.part
    if not (inspect.isclass(part) and issubclass(part, base)):
        return f"its entry point is no subclass of {base.__module__}.{base.__name__}"
    if inspect.isabstract(part):
        return f"{part.__name__} lacks {_missing(part)}"
    if part.__dict__.get("name") != found.name:
        return f"{part.__name__} has no attribute `name = '{found.name}'`"
    return ""


def _missing(part: Any) -> str:
    return ", ".join(sorted(part.__abstractmethods__))


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
            out[found.name] = found.broken("its entry point is no package with files beside it")
        else:
            out[found.name] = Path(file).parent
    return out

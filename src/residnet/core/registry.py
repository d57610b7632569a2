"""Kinds of parts by name: built-in ones, and those of other installed packages by entry points.

A package declares its part in its own pyproject.toml, for example

    [project.entry-points."residnet.heads"]
    tide = "my_package.heads:TideConfig"

and `kind: tide` works in YAML, in Python and in `residnet list heads`. A part that cannot be loaded
is kept with its fault: it says so where it is used, and disturbs nothing else.

residnet's own kinds stand in a table by name and `module:Class`. A kind is imported when a config
names it, and `residnet list` reads its first line from the source: neither waits for PyTorch.
"""

from __future__ import annotations

import ast
import functools
import importlib
import importlib.metadata
import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel, GetCoreSchemaHandler, TypeAdapter, ValidationInfo
from pydantic_core import CoreSchema, core_schema, to_json

import residnet
from residnet.core.errors import Terminated, UsageError
from residnet.core.files import config_folder


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
_broken: dict[tuple[str, str, str], ThirdParty] = {}
"""Entry points that raised while they were loaded, by group, name and package."""


@functools.cache
def third_party(group: str) -> tuple[ThirdParty, ...]:
    """Return the entry points of one group, loaded once, sorted by name.

    Args:
        group: of entry points, such as `residnet.heads`.

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
    except (KeyboardInterrupt, Terminated):
        raise
    # a foreign package that raises anything at all, SystemExit included, must not stop the others
    except BaseException as error:
        lines = str(error).splitlines() or [""]
        broken = ThirdParty(point.name, package, None, f"{type(error).__name__}: {lines[0]}")
        _broken.setdefault((point.group, point.name, package), broken)
        return broken


def load_faults() -> list[str]:
    """Return one line for each entry point that could not be loaded so far and was skipped."""
    return [
        f"entry point '{name}' in {group} of the package {package} was skipped ({part.fault});"
        " repair or uninstall that package"
        for (group, name, package), part in sorted(_broken.items())
    ]


@functools.cache
def adapter(model: Any) -> TypeAdapter[Any]:
    """Return what reads a type; for a union of vessels pydantic takes 35 ms to make it."""
    return TypeAdapter(model)


def forget() -> None:
    """Read the entry points anew when they are next needed, for tests that install packages."""
    third_party.cache_clear()
    _broken.clear()
    adapter.cache_clear()


@dataclass(frozen=True, eq=False)
class Kinds:
    """Marks a config field that takes one of several kinds, those of other packages included.

    Parts that are no configs, such as formats of exports, are kinds told apart by an attribute.
    `HeadConfig = Annotated[Any, Kinds("residnet.heads", "residnet.heads.base:HeadKind",
    {"lstm": "residnet.heads.lstm:LstmConfig"})]`.

    Attributes:
        group: of the entry points; one that nobody names is closed to other packages.
        base: `module:Class` that the configs of other packages must extend.
        builtin: residnet's own kinds, each as `module:Class`.
        key: field that tells the kinds apart.
    """

    group: str
    base: str
    builtin: Mapping[str, str]
    key: str = "kind"

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
        fault = _no_subclass(found.part, imported(self.base))
        if fault or kind_of(found.part, self.key) == found.name:
            return fault
        name = found.part.__name__
        if issubclass(found.part, BaseModel):
            return f"{name} has no field `{self.key}: Literal['{found.name}']`"
        return f"{name} has no attribute `{self.key} = '{found.name}'`"

    def names(self) -> list[str]:
        """Return the names of all kinds, broken ones included."""
        return list(dict.fromkeys([*self.builtin, *(part.name for part in self.others())]))

    def find(self, name: str) -> type[Any] | ThirdParty:
        """Return the class of one kind; a broken one of another package as it is kept."""
        if name in self.builtin:
            found: type[Any] = imported(self.builtin[name])
            return found
        # a second part of the same name could never be told from the first
        other = next(part for part in self.others() if part.name == name)
        return other if other.fault else other.part

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Return the schema of a union that is told apart by `key` and imports what is named."""
        return core_schema.tagged_union_schema(
            {
                name: core_schema.with_info_plain_validator_function(
                    functools.partial(self._validated, name)
                )
                for name in self.names()
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


def imported(place: str) -> Any:
    """Return what stands at `module:name`."""
    module, _, name = place.partition(":")
    return getattr(importlib.import_module(module), name)


def deferred(package: str, homes: Mapping[str, str]) -> Callable[[str], Any]:
    """Return the `__getattr__` of a package whose names are loaded when they are first used.

    Args:
        package: its `__name__`.
        homes: module within the package, by the name that it offers.
    """

    def load(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        return imported(f"{package}.{homes[name]}:{name}")

    return load


def kind_of(config: type[Any], key: str = "kind") -> str | None:
    """Return the value of the field that tells a class from others; None without one."""
    if not issubclass(config, BaseModel):
        return config.__dict__.get(key)
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
    return found


def kinds(union: Any) -> dict[str, Any]:
    """Return the config classes by kind, all imported: built-in ones, then those of other packages.

    Args:
        union: for example `residnet.heads.HeadConfig`.
    """
    mark = marker(union)
    found = {name: mark.find(name) for name in mark.names()}
    return {name: part for name, part in found.items() if not isinstance(part, ThirdParty)}


def listed(union: Any) -> list[tuple[str, str]]:
    """Return name and first line of every part; residnet's own ones are read, not imported.

    Args:
        union: for example `residnet.heads.HeadConfig`.
    """
    mark = union if isinstance(union, Kinds) else marker(union)
    out = [(name, _first_line(place)) for name, place in mark.builtin.items()]
    return out + [
        (part.name, broken_line(part) if part.fault else _first_line(part.part))
        for part in mark.others()
    ]


def broken_line(part: ThirdParty) -> str:
    """Return what a list says about a part that cannot be used."""
    return f"(cannot be used: {part.fault}; from {part.package})"


def _first_line(place: Any) -> str:
    """Return `about` of a class where it has one, else the first line of its docstring."""
    if not isinstance(place, str):
        about: str = getattr(place, "about", "") or (place.__doc__ or "").strip().splitlines()[0]
        return about
    module, _, name = place.partition(":")
    at = Path(residnet.__file__).parent.joinpath(*module.split(".")[1:])
    file = at / "__init__.py" if at.is_dir() else at.with_suffix(".py")
    for node in ast.parse(file.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ClassDef) and node.name == name:
            for line in node.body:
                if isinstance(line, ast.AnnAssign) and ast.unparse(line.target) == "about":
                    return str(ast.literal_eval(line.value)) if line.value else ""
            return (ast.get_docstring(node) or "").partition("\n")[0]
    return _first_line(imported(place))


def _no_subclass(part: Any, base: type[Any]) -> str:
    abstract: frozenset[str] = getattr(part, "__abstractmethods__", frozenset())
    if not (inspect.isclass(part) and issubclass(part, base)):
        return f"its entry point is no subclass of {base.__module__}.{base.__name__}"
    if abstract:
        return f"{part.__name__} lacks {', '.join(sorted(abstract))}"
    return ""


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


def vessel_files() -> dict[str, Path]:
    """Return names and files of the vessels of residnet, then those of other packages."""
    found = {path.stem: path for path in sorted((config_folder() / "vessels").glob("*.yaml"))}
    for folder in folders("residnet.vessels").values():
        if isinstance(folder, Path):
            for path in sorted(folder.glob("*.yaml")):
                found.setdefault(path.stem, path)
    return found


def broken_vessels() -> list[ThirdParty]:
    """Return entry points of vessels that lead to no folder, and vessels whose name is taken."""
    files, out = vessel_files(), []
    for name, folder in folders("residnet.vessels").items():
        if isinstance(folder, ThirdParty):
            out.append(folder)
            continue
        for path in sorted(folder.glob("*.yaml")):
            if files[path.stem] != path:
                taken = f"{files[path.stem]} is the vessel of that name"
                out.append(ThirdParty(path.stem, f"of the entry point {name}", fault=taken))
    return out

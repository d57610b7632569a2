"""Registry of plug-in parts by kind: built-in parts and entry points of installed packages.

A package declares its part in its own pyproject.toml, for example

    [project.entry-points."residnet.heads"]
    tide = "my_package.heads:TideConfig"

and `kind: tide` works in YAML, in Python and in `residnet list heads`. A part that cannot be loaded
is listed with its fault and raises an error only if it is used.

Parts of the core are listed as `module:Class`. A wing of residnet (a package that the core never
imports, such as `residnet.autopilot`) declares its parts in the same form in its file
entry_points.toml. A config class is imported when a config names its kind, and `residnet list`
reads summaries from the source text, so that neither reading a config nor listing parts imports
PyTorch.
"""

from __future__ import annotations

import ast
import functools
import importlib
import importlib.metadata
import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel, GetCoreSchemaHandler, TypeAdapter, ValidationInfo
from pydantic_core import CoreSchema, core_schema, to_json

import residnet
from residnet.core.errors import Terminated, UsageError
from residnet.core.files import find_config_folder
from residnet.core.wings import read_wing_entry_points


@dataclass(frozen=True)
class EntryPointPart:
    """An entry point of another package.

    Attributes:
        name: name in YAML and in `residnet list`.
        package: name and version of the package.
        part: loaded object; None if it is broken.
        fault: one line why it cannot be used; empty if it can.
    """

    name: str
    package: str
    part: Any = None
    fault: str = ""

    @property
    def error_message(self) -> str:
        """Message that names the part, its package and its fault."""
        return (
            f"'{self.name}' of the package {self.package} cannot be used: {self.fault}; repair or"
            " uninstall that package"
        )

    def with_check(self, find_fault: Callable[[], str]) -> EntryPointPart:
        """Return the entry point, without its part if `find_fault` returns a fault."""
        fault = self.fault or find_fault()
        return EntryPointPart(self.name, self.package, None, fault) if fault else self


_loading_groups: list[str] = []
_broken: dict[tuple[str, str, str], EntryPointPart] = {}
"""Entry points that raised an error on loading, by group, name and package."""
_package_of_class: dict[type[Any], str] = {}
"""Name and version of the package that registered a class by an entry point."""


@functools.cache
def _installed_entry_points() -> Any:
    """Return the `EntryPoints` of all installed packages, whose metadata are read once."""
    return importlib.metadata.entry_points()


@functools.cache
def load_entry_points(group: str) -> tuple[EntryPointPart, ...]:
    """Load the entry points of one group, once, sorted by name.

    Args:
        group: entry-point group, for example `residnet.heads`.

    Raises:
        UsageError: if a package needs the group while it is itself being imported.
    """
    if group in _loading_groups:
        raise UsageError(
            f"a package with entry points in {group} builds residnet configs while it is imported;"
            " build them inside a function"
        )
    _loading_groups.append(group)
    try:
        entry_points = _installed_entry_points().select(group=group)
        return tuple(
            _load_entry_point(entry_point)
            for entry_point in sorted(entry_points, key=lambda point: point.name)
        )
    finally:
        _loading_groups.remove(group)


def _load_entry_point(entry_point: importlib.metadata.EntryPoint) -> EntryPointPart:
    package = (
        "unknown"
        if entry_point.dist is None
        else f"{entry_point.dist.name} {entry_point.dist.version}"
    )
    try:
        part = entry_point.load()
        if inspect.isclass(part):
            _package_of_class[part] = package
        return EntryPointPart(entry_point.name, package, part)
    except (KeyboardInterrupt, Terminated):
        raise
    # a third-party package may raise anything, SystemExit included, and must not stop the others
    except BaseException as error:
        lines = str(error).splitlines() or [""]
        broken = EntryPointPart(
            entry_point.name, package, None, f"{type(error).__name__}: {lines[0]}"
        )
        _broken.setdefault((entry_point.group, entry_point.name, package), broken)
        return broken


def list_load_faults() -> list[str]:
    """Return one line for each entry point that was skipped because it could not be loaded."""
    return [
        f"entry point '{name}' in {group} of the package {package} was skipped ({part.fault});"
        " repair or uninstall that package"
        for (group, name, package), part in sorted(_broken.items())
    ]


def get_part_package(part_class: type[Any]) -> str | None:
    """Return name and version of the package that registered a class; None without one."""
    return _package_of_class.get(part_class)


def find_registered_package(module_name: str) -> str | None:
    """Return the package that registered a class in the same top-level module; None without one."""
    for part_class, package in _package_of_class.items():
        if part_class.__module__.partition(".")[0] == module_name.partition(".")[0]:
            return package
    return None


def find_part_packages(config: Any) -> dict[str, str]:
    """Return the version of each package that registered a part of a config, by its name.

    Args:
        config: config, or a mapping or sequence of configs, which is searched recursively.
    """
    versions: dict[str, str] = {}
    for part in iterate_configs(config):
        if (package := get_part_package(type(part))) is not None:
            name, _, version = package.rpartition(" ")
            versions[name] = version
    return dict(sorted(versions.items()))


def iterate_configs(config: Any) -> Iterator[BaseModel]:
    """Yield all configs within a config, itself included.

    Args:
        config: config, or a mapping or sequence of configs, which is searched recursively.
    """
    pending_values = [config]
    while pending_values:
        value = pending_values.pop()
        if isinstance(value, BaseModel):
            yield value
            pending_values += [getattr(value, name) for name in type(value).model_fields]
        elif isinstance(value, Mapping):
            pending_values += value.values()
        elif isinstance(value, list | tuple):
            pending_values += value


@functools.cache
def type_adapter(model: Any) -> TypeAdapter[Any]:
    """Return a cached pydantic adapter: building one for the union of vessels takes 35 ms."""
    return TypeAdapter(model)


def clear_caches() -> None:
    """Clear the cached entry points, for tests that install packages."""
    _installed_entry_points.cache_clear()
    load_entry_points.cache_clear()
    _broken.clear()
    _package_of_class.clear()
    type_adapter.cache_clear()


@dataclass(frozen=True, eq=False)
class PluginUnion:
    """Marker of a config field that accepts one of several kinds, from any installed package.

    For example `HeadConfig = Annotated[Any, PluginUnion("residnet.heads",
    "residnet.heads.config:BaseHeadConfig", {"lstm": "residnet.heads.lstm_config:LstmConfig"})]`.
    Parts that are not configs, such as export formats, have the kind as a class attribute.

    Attributes:
        group: entry-point group of the kinds of other packages.
        base: `module:Class` that the kinds of other packages must extend.
        core_kinds: built-in kinds, name -> `module:Class`.
        key: discriminator field.
        python_kinds: kinds that cannot be written in YAML, because they hold a Python object;
            lists omit them. Name -> `module:Class`.
    """

    group: str
    base: str
    core_kinds: Mapping[str, str]
    key: str = "kind"
    python_kinds: Mapping[str, str] = field(default_factory=dict)

    @functools.cached_property
    def builtin(self) -> Mapping[str, str]:
        """The kinds that come with residnet, the core first, each as `module:Class`."""
        return {**self.core_kinds, **read_wing_entry_points().get(self.group, {})}

    def entry_point_parts(self) -> list[EntryPointPart]:
        """Return the kinds of other packages, each with a fault if it violates the interface."""
        package_of_name = dict.fromkeys(self.builtin, "residnet")
        checked_parts = []
        for entry_point in load_entry_points(self.group):
            checked_parts.append(
                entry_point.with_check(
                    functools.partial(
                        self._find_fault, entry_point, package_of_name.get(entry_point.name)
                    )
                )
            )
            package_of_name.setdefault(entry_point.name, entry_point.package)
        return checked_parts

    def _find_fault(self, entry_point: EntryPointPart, owner: str | None) -> str:
        if owner is not None:
            return f"{owner} has a {self.key} of that name already"
        fault = _subclass_fault(entry_point.part, import_object(self.base))
        if fault or get_kind(entry_point.part, self.key) == entry_point.name:
            return fault
        name = entry_point.part.__name__
        if issubclass(entry_point.part, BaseModel):
            return f"{name} has no field `{self.key}: Literal['{entry_point.name}']`"
        return f"{name} has no attribute `{self.key} = '{entry_point.name}'`"

    def kind_names(self) -> list[str]:
        """Return the names of all kinds, broken ones included."""
        return list(
            dict.fromkeys([*self.builtin, *(part.name for part in self.entry_point_parts())])
        )

    def find_kind(self, name: str) -> type[Any] | EntryPointPart:
        """Return the class of one kind, or the broken entry point of another package."""
        if name in self.builtin:
            kind_class: type[Any] = import_object(self.builtin[name])
            return kind_class
        # of two packages with the same name, the first one is taken; the second one has a fault
        entry_point = next(part for part in self.entry_point_parts() if part.name == name)
        return entry_point if entry_point.fault else entry_point.part

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Return the schema of a tagged union that imports a kind when it is named."""
        listed_kinds = core_schema.tagged_union_schema(
            {
                name: core_schema.with_info_plain_validator_function(
                    functools.partial(self._validate_kind, name)
                )
                for name in self.kind_names()
            },
            discriminator=self.key,
            from_attributes=True,
        )
        return core_schema.with_info_wrap_validator_function(
            self._validate_python_kind,
            listed_kinds,
            # by the class of the value, which may not be among the listed kinds
            serialization=core_schema.plain_serializer_function_ser_schema(
                _return_unchanged, return_schema=core_schema.any_schema()
            ),
        )

    def _validate_python_kind(
        self, value: Any, handler: Callable[[Any], Any], info: ValidationInfo
    ) -> Any:
        """Validate a kind that was registered in this process, any other kind by `handler`."""
        name = value.get(self.key) if isinstance(value, Mapping) else None
        kind_class = _registered_kinds.get((self.group, str(name)))
        if kind_class is None and str(name) in self.python_kinds:
            kind_class = import_object(self.python_kinds[str(name)])
        if kind_class is None:
            return handler(value)
        return self._validate_class(kind_class, value, info)

    def _validate_kind(self, name: str, value: Any, info: ValidationInfo) -> Any:
        kind_class = self.find_kind(name)
        if isinstance(kind_class, EntryPointPart):
            raise ValueError(kind_class.error_message)
        return self._validate_class(kind_class, value, info)

    def _validate_class(self, kind_class: type[Any], value: Any, info: ValidationInfo) -> Any:
        if isinstance(value, kind_class):
            return value
        if info.mode == "json":
            # the Python mode of pydantic does not accept lists for tuples, the JSON mode does
            return kind_class.model_validate_json(to_json(value), strict=True, context=info.context)
        return kind_class.model_validate(value, context=info.context)


def is_python_part(config: BaseModel) -> bool:
    """Return whether the class of a config is registered in this process only.

    Such a class was passed to the Python interface, and other processes cannot build it.
    """
    return type(config) in _registered_kinds.values() or bool(
        getattr(config, "is_process_local", False)
    )


def _return_unchanged(value: Any) -> Any:
    return value


_registered_kinds: dict[tuple[str, str], type[BaseModel]] = {}
"""Config classes of Python arguments by entry-point group and kind, in this process."""


def register_kind(union: Any, config_class: type[BaseModel]) -> None:
    """Register a config class for this process, as an entry point would for every process.

    A class with the kind of a part that is listed, or the same class again, changes nothing.

    Args:
        union: for example `residnet.heads.HeadConfig`.
        config_class: class with a field `kind: Literal["name"] = "name"`.

    Raises:
        UsageError: if the class does not extend the base class of the union, or has no kind.
    """
    plugin_union = get_plugin_union(union)
    name = get_kind(config_class, plugin_union.key)
    if name is not None and (
        name in plugin_union.kind_names() or name in plugin_union.python_kinds
    ):
        return
    fault = _subclass_fault(config_class, import_object(plugin_union.base)).replace(
        "its entry point", config_class.__name__
    )
    if not fault and name is None:
        fault = f"it has no field `{plugin_union.key}: Literal['name'] = 'name'`"
    if fault or name is None:
        raise UsageError(f"the config class {config_class.__name__} cannot be used: {fault}")
    _registered_kinds[plugin_union.group, name] = config_class


def list_external_classes(union: Any) -> list[Any]:
    """Return the usable classes of entry points and of Python arguments, without built-in ones.

    Args:
        union: for example `residnet.io.readers.ReaderConfig`.
    """
    plugin_union = get_plugin_union(union)
    installed_classes = [part.part for part in plugin_union.entry_point_parts() if not part.fault]
    python_classes = [
        config_class
        for (group, _), config_class in _registered_kinds.items()
        if group == plugin_union.group
    ]
    return [*installed_classes, *python_classes]


def import_object(object_path: str) -> Any:
    """Import and return the object at `module:name`."""
    module, _, name = object_path.partition(":")
    return getattr(importlib.import_module(module), name)


def make_lazy_getattr(package: str, module_of_name: Mapping[str, str]) -> Callable[[str], Any]:
    """Create a module-level `__getattr__` that imports names of a package on first use.

    Args:
        package: `__name__` of the package.
        module_of_name: public name -> module within the package.
    """

    def load(name: str) -> Any:
        if name not in module_of_name:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        return import_object(f"{package}.{module_of_name[name]}:{name}")

    return load


def get_kind(config: type[Any], key: str = "kind") -> str | None:
    """Return the value of the discriminator field of a class; None without one."""
    if not issubclass(config, BaseModel):
        return config.__dict__.get(key)
    kind_field = config.model_fields.get(key)
    if kind_field is None or get_origin(kind_field.annotation) is not Literal:
        return None
    return str(get_args(kind_field.annotation)[0])


def get_plugin_union(union: Any) -> PluginUnion:
    """Return the plug-in marker of an annotated type.

    Raises:
        UsageError: if the type has no such marker.
    """
    plugin_union = next(
        (metadata for metadata in get_args(union)[1:] if isinstance(metadata, PluginUnion)), None
    )
    if plugin_union is None:
        raise UsageError(f"{union} is not a union that other packages can extend")
    return plugin_union


def load_kinds(union: Any) -> dict[str, Any]:
    """Import all classes of a union, by kind: built-in ones first.

    Args:
        union: for example `residnet.heads.HeadConfig`.
    """
    plugin_union = get_plugin_union(union)
    classes = {name: plugin_union.find_kind(name) for name in plugin_union.kind_names()}
    return {
        name: kind_class
        for name, kind_class in classes.items()
        if not isinstance(kind_class, EntryPointPart)
    }


def list_parts(union: Any) -> list[tuple[str, str]]:
    """Return name and summary of every part; built-in parts are read without import.

    Args:
        union: for example `residnet.heads.HeadConfig`.
    """
    plugin_union = union if isinstance(union, PluginUnion) else get_plugin_union(union)
    names_and_summaries = [
        (name, _summary_line(object_path)) for name, object_path in plugin_union.builtin.items()
    ]
    return names_and_summaries + [
        (part.name, describe_broken_part(part) if part.fault else _summary_line(part.part))
        for part in plugin_union.entry_point_parts()
    ]


def describe_broken_part(part: EntryPointPart) -> str:
    """Return the entry of a list for a part that cannot be used."""
    return f"(cannot be used: {part.fault}; from {part.package})"


def _summary_line(object_or_path: Any) -> str:
    """Return the attribute `about` of a class if it has one, else the first docstring line."""
    if not isinstance(object_or_path, str):
        # the docstring of the class itself: an inherited one describes the base class
        docstring = (object_or_path.__doc__ or "").strip()
        summary: str = getattr(object_or_path, "about", "") or docstring.partition("\n")[0]
        return summary or "(no description)"
    module, _, name = object_or_path.partition(":")
    module_path = Path(residnet.__file__).parent.joinpath(*module.split(".")[1:])
    file = module_path / "__init__.py" if module_path.is_dir() else module_path.with_suffix(".py")
    for node in ast.parse(file.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ClassDef) and node.name == name:
            for line in node.body:
                if isinstance(line, ast.AnnAssign) and ast.unparse(line.target) == "about":
                    return str(ast.literal_eval(line.value)) if line.value else ""
            return (ast.get_docstring(node) or "").partition("\n")[0]
    return _summary_line(import_object(object_or_path))


def _subclass_fault(part: Any, base: type[Any]) -> str:
    abstract_methods: frozenset[str] = getattr(part, "__abstractmethods__", frozenset())
    if not (inspect.isclass(part) and issubclass(part, base)):
        return f"its entry point is not a subclass of {base.__module__}.{base.__name__}"
    if abstract_methods:
        return f"{part.__name__} lacks {', '.join(sorted(abstract_methods))}"
    return ""


def entry_point_folders(group: str) -> dict[str, Path | EntryPointPart]:
    """Return the folders of the packages in an entry-point group, by entry point.

    An entry point of such a group names a package (a folder with an `__init__.py`) that contains
    data files. A broken entry point is returned itself.
    """
    folder_of_name: dict[str, Path | EntryPointPart] = {}
    for entry_point in load_entry_points(group):
        file = getattr(entry_point.part, "__file__", None)
        if entry_point.fault:
            folder_of_name[entry_point.name] = entry_point
        elif not inspect.ismodule(entry_point.part) or file is None:
            fault = "its entry point is not a package with data files"
            folder_of_name[entry_point.name] = replace(entry_point, part=None, fault=fault)
        else:
            folder_of_name[entry_point.name] = Path(file).parent
    return folder_of_name


def find_vessel_files() -> dict[str, Path]:
    """Return the vessel files by name: of residnet, then of other packages."""
    file_of_vessel = {
        path.stem: path for path in sorted((find_config_folder() / "vessels").glob("*.yaml"))
    }
    for folder in entry_point_folders("residnet.vessels").values():
        if isinstance(folder, Path):
            for path in sorted(folder.glob("*.yaml")):
                file_of_vessel.setdefault(path.stem, path)
    return file_of_vessel


def find_broken_vessels() -> list[EntryPointPart]:
    """Return broken entry points of vessels, and vessels whose name is already in use."""
    files = find_vessel_files()
    broken_parts = []
    for name, folder in entry_point_folders("residnet.vessels").items():
        if isinstance(folder, EntryPointPart):
            broken_parts.append(folder)
            continue
        for path in sorted(folder.glob("*.yaml")):
            if files[path.stem] != path:
                fault_text = f"{files[path.stem]} is the vessel of that name"
                broken_parts.append(
                    EntryPointPart(path.stem, f"with the entry point '{name}'", fault=fault_text)
                )
    return broken_parts

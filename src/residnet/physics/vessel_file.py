"""Common part of all vessel files, and the merging of a file with its `base`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import ValidationInfo, model_validator

from residnet.core.config import Config, load_mapping
from residnet.core.errors import ConfigError
from residnet.core.names import suggest_name
from residnet.core.registry import find_vessel_files
from residnet.physics.actuators.config import ServoSpec
from residnet.physics.parameters import Length, Positive
from residnet.physics.plant_channels import PlantChannels

if TYPE_CHECKING:
    from residnet.physics.plant import Plant


class VesselFile(Config, ABC):
    """Configuration of a vessel of any kind.

    A file can refer to another one of its kind as `base` and contain the differences only.

    Attributes:
        name: name of the vessel, equal to the name of the file.
        description: one line for `residnet list vessels`.
        length: length of the hull, the unit of manoeuvring indices.
    """

    name: str
    description: str
    length: Annotated[Length, Positive]

    @model_validator(mode="before")
    @classmethod
    def _apply_base(cls, data: Any, info: ValidationInfo) -> Any:
        return merge_with_base(data, (info.context or {}).get("folder"))

    @abstractmethod
    def plant_channels(self) -> PlantChannels:
        """Return the states and inputs of the plant."""

    @abstractmethod
    def servo_specs(self) -> tuple[ServoSpec, ...]:
        """Return limits and dynamics of every servo, in the order of the actuator states."""

    def check_parameters(self) -> None:
        """Check that the plant can be built.

        Raises:
            ConfigError: if the parameters are invalid, for example a singular mass matrix.
        """

    @abstractmethod
    def build(self) -> Plant:
        """Build the plant of this vessel.

        Raises:
            ConfigError: if the parameters are invalid, for example a singular mass matrix.
        """


def merge_with_base(data: Any, folder: Path | None) -> Any:
    """Merge the content of a vessel file with the content of its `base`.

    Sections are merged key by key; a section of another `kind` replaces the section of the base.
    `base` is the name of a file in `configs/vessels`, or the path of a YAML file, which is first
    searched relative to the folder of the file.

    Raises:
        ValueError: if the base does not exist, cannot be read, or bases form a cycle.
    """
    visited: list[Path] = []
    # from the file down to the last base, which has no base itself
    layers = [_lists_to_tuples(data)]
    while isinstance(layers[-1], dict) and "base" in layers[-1]:
        path = _resolve_base_path(layers[-1]["base"], folder)
        if path in visited:
            raise ValueError(
                f"base: {' and '.join(p.name for p in visited)} refer to each other in a cycle"
            )
        visited.append(path)
        folder = path.parent
        try:
            layers.append(_lists_to_tuples(load_mapping(path)))
        except ConfigError as error:
            raise ValueError(f"base: {error}") from None
    merged = layers[-1]
    # files override their bases, so that they are applied last
    for layer in reversed(layers[:-1]):
        merged = _merge_sections(
            {key: value for key, value in layer.items() if key != "base"}, merged
        )
    return merged


def _resolve_base_path(name: object, folder: Path | None) -> Path:
    files = find_vessel_files()
    if not isinstance(name, str):
        raise ValueError(f"base: expected the name of a vessel or of its YAML file, got {name!r}")
    if name in files:
        return files[name].resolve()
    path = Path(name)
    relative_path = (folder / path) if folder is not None else path
    for candidate in (relative_path, path):
        if candidate.suffix in {".yaml", ".yml"} and candidate.is_file():
            return candidate.resolve()
    raise ValueError(
        f"base: no vessel '{name}'{suggest_name(name, files)}; give a name or the"
        " path of a YAML file"
    )


def _lists_to_tuples(data: Any) -> Any:
    """Return the content with tuples instead of lists.

    pydantic validates the output of a model validator in strict mode, which rejects lists.
    """
    if isinstance(data, dict):
        return {key: _lists_to_tuples(value) for key, value in data.items()}
    return tuple(_lists_to_tuples(value) for value in data) if isinstance(data, list) else data


def _merge_sections(override: dict[str, Any], base: dict[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in override.items():
        # sections of different kinds have different keys and cannot be merged
        base_value = base.get(key)
        if (
            isinstance(value, dict)
            and isinstance(base_value, dict)
            and value.get("kind", base_value.get("kind")) == base_value.get("kind")
        ):
            value = _merge_sections(value, base_value)
        merged[key] = value
    return merged

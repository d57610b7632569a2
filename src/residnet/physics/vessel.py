"""Vessel files (`configs/vessels/*.yaml`): every kind of plant, its SI parameters with sources."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Field

from residnet.core.config import load_config
from residnet.core.errors import ConfigError
from residnet.core.names import nearest
from residnet.core.registry import vessel_files
from residnet.physics.abkowitz import AbkowitzConfig
from residnet.physics.hull import (
    FossenConfig,
    MassMatrixConfig,
    OdinConfig,
    PatrolConfig,
    SubmergedConfig,
)
from residnet.physics.nomoto import NomotoConfig, SecondOrderNomotoConfig, SideslipNomotoConfig

__all__ = ["AnyVessel", "VesselConfig", "VesselName", "load_vessel", "vessel_files"]

AnyVessel = (
    FossenConfig
    | MassMatrixConfig
    | AbkowitzConfig
    | OdinConfig
    | PatrolConfig
    | SubmergedConfig
    | NomotoConfig
    | SecondOrderNomotoConfig
    | SideslipNomotoConfig
)
VesselConfig = Annotated[AnyVessel, Field(discriminator="kind")]


def load_vessel(name: str) -> AnyVessel:
    """Read a vessel by the name of a file in `configs/vessels` or by the path of a YAML file.

    Raises:
        ConfigError: where there is no such vessel or its file is wrong.
    """
    files = vessel_files()
    if name in files:
        path = files[name]
    else:
        path = Path(name)
        if path.suffix not in {".yaml", ".yml"}:
            raise ConfigError(
                f"no vessel '{name}'{nearest(name, files)};"
                " or give the path of a vessel's yaml file"
            )
    vessel: AnyVessel = load_config(path, [], VesselConfig)
    return vessel


def _loadable(name: str) -> str:
    try:
        load_vessel(name)
    except ConfigError as error:
        raise ValueError(str(error)) from None
    return name


VesselName = Annotated[str, AfterValidator(_loadable)]
"""In a config: name or path of a vessel file, read once to see that it is right."""

"""Reading of vessel files (`configs/vessels/*.yaml`) of all kinds of plants."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Field

from residnet.core.config import load_config
from residnet.core.errors import ConfigError
from residnet.core.names import suggest_name
from residnet.core.registry import find_vessel_files
from residnet.physics.abkowitz_config import AbkowitzConfig
from residnet.physics.hull import (
    AccelerationHullConfig,
    FossenConfig,
    MassMatrixConfig,
    RollingHullConfig,
    SubmergedHullConfig,
)
from residnet.physics.nomoto_config import (
    NomotoConfig,
    SecondOrderNomotoConfig,
    SideslipNomotoConfig,
)

__all__ = ["AnyVessel", "VesselConfig", "VesselName", "find_vessel_files", "load_vessel"]

AnyVessel = (
    FossenConfig
    | MassMatrixConfig
    | AbkowitzConfig
    | AccelerationHullConfig
    | RollingHullConfig
    | SubmergedHullConfig
    | NomotoConfig
    | SecondOrderNomotoConfig
    | SideslipNomotoConfig
)
VesselConfig = Annotated[AnyVessel, Field(discriminator="kind")]


def load_vessel(name: str) -> AnyVessel:
    """Read a vessel by the name of a file in `configs/vessels` or by the path of a YAML file.

    Raises:
        ConfigError: if the vessel does not exist or its file is invalid.
    """
    files = find_vessel_files()
    if name in files:
        path = files[name]
    else:
        path = Path(name)
        if path.suffix not in {".yaml", ".yml"}:
            raise ConfigError(
                f"no vessel '{name}'{suggest_name(name, files)};"
                " give a name or the path of a YAML file"
            )
    vessel: AnyVessel = load_config(path, [], VesselConfig)
    return vessel


def _validate_vessel_name(name: str) -> str:
    try:
        load_vessel(name)
    except ConfigError as error:
        raise ValueError(str(error)) from None
    return name


VesselName = Annotated[str, AfterValidator(_validate_vessel_name)]
"""Name or path of a vessel file in a config; validation reads the file."""

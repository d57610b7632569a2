"""Actuators of vessels; `ActuatorsConfig` lists all kinds."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from residnet.physics.actuators.config import ActuatorConfig
from residnet.physics.actuators.rudders import (
    FoilRuddersConfig,
    LinearRuddersConfig,
    RudderPropellerConfig,
    TorpedoFinsConfig,
    WaterJetsConfig,
)
from residnet.physics.actuators.thrusters_config import (
    AzimuthThrustersConfig,
    DifferentialThrustConfig,
    ForceCommandsConfig,
    ThrustersConfig,
    VectoredThrustersConfig,
)

ActuatorsConfig = Annotated[
    AzimuthThrustersConfig
    | DifferentialThrustConfig
    | ForceCommandsConfig
    | RudderPropellerConfig
    | ThrustersConfig
    | WaterJetsConfig,
    Field(discriminator="kind"),
]
RollingActuatorsConfig = Annotated[
    FoilRuddersConfig | LinearRuddersConfig, Field(discriminator="kind")
]
"""Actuators of a vessel with roll, which also produce a roll moment."""
SubmergedActuatorsConfig = Annotated[
    TorpedoFinsConfig | VectoredThrustersConfig, Field(discriminator="kind")
]
"""Actuators of an underwater vessel, which produce all six forces and moments."""

__all__ = [
    "ActuatorConfig",
    "ActuatorsConfig",
    "AzimuthThrustersConfig",
    "DifferentialThrustConfig",
    "ForceCommandsConfig",
    "RollingActuatorsConfig",
    "SubmergedActuatorsConfig",
    "ThrustersConfig",
]

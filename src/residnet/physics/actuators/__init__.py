"""Actuators: what a vessel is driven and steered by, listed once in `ActuatorsConfig`."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from residnet.physics.actuators.base import ActuatorConfig, ActuatorSystem, ForceActuators
from residnet.physics.actuators.rudders import (
    FoilRuddersConfig,
    LinearRuddersConfig,
    RudderPropellerConfig,
    TorpedoFinsConfig,
    WaterJetsConfig,
)
from residnet.physics.actuators.thrusters import (
    AzimuthThrusters,
    AzimuthThrustersConfig,
    DifferentialThrustConfig,
    ForceCommands,
    ForceCommandsConfig,
    Thrusters,
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
"""Of a vessel that rolls: they make a roll moment too."""
SubmergedActuatorsConfig = Annotated[
    TorpedoFinsConfig | VectoredThrustersConfig, Field(discriminator="kind")
]
"""Of a vessel under water: they make all six forces and moments."""

__all__ = [
    "ActuatorConfig",
    "ActuatorSystem",
    "ActuatorsConfig",
    "AzimuthThrusters",
    "AzimuthThrustersConfig",
    "DifferentialThrustConfig",
    "ForceActuators",
    "ForceCommands",
    "ForceCommandsConfig",
    "RollingActuatorsConfig",
    "SubmergedActuatorsConfig",
    "Thrusters",
    "ThrustersConfig",
]

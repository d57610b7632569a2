"""Actuators: what a vessel is driven and steered by, listed once in `ActuatorsConfig`."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from residnet.physics.actuators.base import ActuatorConfig, Actuators, ForceActuators
from residnet.physics.actuators.rudders import (
    FoilRuddersConfig,
    LinearRuddersConfig,
    RudderPropellerConfig,
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

__all__ = [
    "ActuatorConfig",
    "Actuators",
    "ActuatorsConfig",
    "AzimuthThrusters",
    "AzimuthThrustersConfig",
    "DifferentialThrustConfig",
    "ForceActuators",
    "ForceCommands",
    "ForceCommandsConfig",
    "RollingActuatorsConfig",
    "Thrusters",
    "ThrustersConfig",
]

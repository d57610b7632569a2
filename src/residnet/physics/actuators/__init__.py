"""Actuators: one file per kind, listed once in `ActuatorsConfig`."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from residnet.physics.actuators.azimuth import AzimuthThrusters, AzimuthThrustersConfig
from residnet.physics.actuators.base import ActuatorConfig, Actuators, ForceActuators
from residnet.physics.actuators.differential_thrust import (
    DifferentialThrust,
    DifferentialThrustConfig,
)
from residnet.physics.actuators.forces import ForceCommands, ForceCommandsConfig
from residnet.physics.actuators.rudder_propeller import RudderPropeller, RudderPropellerConfig
from residnet.physics.actuators.thrusters import Thrusters, ThrustersConfig
from residnet.physics.actuators.waterjet import WaterJets, WaterJetsConfig

ActuatorsConfig = Annotated[
    AzimuthThrustersConfig
    | DifferentialThrustConfig
    | ForceCommandsConfig
    | RudderPropellerConfig
    | ThrustersConfig
    | WaterJetsConfig,
    Field(discriminator="kind"),
]

__all__ = [
    "ActuatorConfig",
    "Actuators",
    "ActuatorsConfig",
    "AzimuthThrusters",
    "AzimuthThrustersConfig",
    "DifferentialThrust",
    "DifferentialThrustConfig",
    "ForceActuators",
    "ForceCommands",
    "ForceCommandsConfig",
    "RudderPropeller",
    "RudderPropellerConfig",
    "Thrusters",
    "ThrustersConfig",
    "WaterJets",
    "WaterJetsConfig",
]

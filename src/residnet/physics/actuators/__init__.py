"""Actuators: one file per kind, listed once in `ActuatorsConfig`."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from residnet.physics.actuators.base import ActuatorConfig, Actuators
from residnet.physics.actuators.differential_thrust import DifferentialThrust, DifferentialThrustConfig
from residnet.physics.actuators.forces import ForceCommands, ForceCommandsConfig
from residnet.physics.actuators.rudder_propeller import RudderPropeller, RudderPropellerConfig
from residnet.physics.actuators.thrusters import Thrusters, ThrustersConfig

ActuatorsConfig = Annotated[
    DifferentialThrustConfig | ForceCommandsConfig | RudderPropellerConfig | ThrustersConfig,
    Field(discriminator="kind"),
]

__all__ = [
    "ActuatorConfig",
    "Actuators",
    "ActuatorsConfig",
    "DifferentialThrust",
    "DifferentialThrustConfig",
    "ForceCommands",
    "ForceCommandsConfig",
    "RudderPropeller",
    "RudderPropellerConfig",
    "Thrusters",
    "ThrustersConfig",
]

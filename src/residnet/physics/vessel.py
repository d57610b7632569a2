"""Vessel files: SI parameters of one vessel, each with its unit and source (`configs/vessels/*.yaml`)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Field, field_validator

from residnet.core.config import Config, load_config
from residnet.core.errors import ConfigError, UsageError
from residnet.core.names import nearest, to_si
from residnet.core.resources import config_folder
from residnet.physics.actuators import DifferentialThrustConfig


class Parameter(Config):
    """A number, its unit and where it comes from."""

    value: float
    unit: str
    source: str

    @field_validator("source")
    @classmethod
    def _source(cls, source: str) -> str:
        if not source.strip():
            raise ValueError("a parameter needs its source (a document and equation, or 'measured by ...')")
        return source


def _in(unit: str) -> Callable[[Parameter], Parameter]:
    """Validator of a parameter whose unit must measure `unit`; the value is converted to it."""

    def convert(parameter: Parameter) -> Parameter:
        try:
            factor = to_si(parameter.unit, unit)
        except UsageError as error:
            raise ValueError(str(error)) from None
        return Parameter(value=parameter.value * factor, unit=unit, source=parameter.source)

    return convert


Mass = Annotated[Parameter, AfterValidator(_in("kg"))]
MassArm = Annotated[Parameter, AfterValidator(_in("kg m"))]
Inertia = Annotated[Parameter, AfterValidator(_in("kg m^2"))]
Length = Annotated[Parameter, AfterValidator(_in("m"))]


class RigidBody(Config):
    """Mass, yaw inertia about the body origin and longitudinal centre of gravity."""

    m: Mass
    I_z: Inertia
    x_G: Length

    @field_validator("m", "I_z")
    @classmethod
    def _positive(cls, parameter: Parameter) -> Parameter:
        if not parameter.value > 0:
            raise ValueError(f"must be positive, given {parameter.value:g}")
        return parameter


class AddedMass(Config):
    """Hydrodynamic derivatives with respect to accelerations (SNAME: negative for a normal hull)."""

    X_udot: Mass
    Y_vdot: Mass
    Y_rdot: MassArm
    N_vdot: MassArm
    N_rdot: Inertia


class Damping(Config):
    """Damping force of each axis as terms of (u, v, r), positive = damping, e.g. `X: {u: ..., "u|u|": ...}`."""

    X: dict[str, Parameter] = Field(default_factory=dict)
    Y: dict[str, Parameter] = Field(default_factory=dict)
    N: dict[str, Parameter] = Field(default_factory=dict)


class VesselConfig(Config):
    """One vessel: everything that a 3-DOF Fossen plant needs."""

    name: str
    description: str
    length: Length
    rigid_body: RigidBody
    added_mass: AddedMass
    damping: Damping
    actuators: DifferentialThrustConfig


def vessel_files() -> dict[str, Path]:
    """Names and files of the vessels that come with residnet."""
    return {path.stem: path for path in sorted((config_folder() / "vessels").glob("*.yaml"))}


def load_vessel(name: str) -> VesselConfig:
    """Read a vessel by the name of a file in `configs/vessels` or by the path of a YAML file.

    Raises:
        ConfigError: where there is no such vessel or its file is wrong.
    """
    files = vessel_files()
    if name in files:
        return load_config(files[name], [], VesselConfig)
    path = Path(name)
    if path.suffix in {".yaml", ".yml"}:
        return load_config(path, [], VesselConfig)
    raise ConfigError(f"no vessel '{name}'{nearest(name, files)}; or give the path of a vessel's yaml file")

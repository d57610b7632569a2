"""Vessel files: SI parameters of one vessel, each with its unit and source (`configs/vessels/*.yaml`)."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Field, field_validator, model_validator

from residnet.core.config import Config, load_config
from residnet.core.errors import ConfigError, UsageError
from residnet.core.names import VELOCITY, nearest, to_si
from residnet.core.resources import config_folder
from residnet.physics.actuators import DifferentialThrustConfig
from residnet.physics.terms import parse_term


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


def _above_zero(parameter: Parameter) -> Parameter:
    if not parameter.value > 0:
        raise ValueError(f"must be positive, given {parameter.value:g}")
    return parameter


_BASE = {"kg": (0, 0), "m": (1, 0), "s": (0, 1), "rad": (0, 0), "N": (1, -2)}


def _dimension(unit: str) -> tuple[int, int] | None:
    """Powers of metre and second in an SI unit of mass times these, for example (2, -1) for `kg m^2/s` or `N m s/rad`; None for any other."""
    metres = seconds = masses = 0
    for sign, name, power in re.findall(r"([/ ]?)([^/ ^]*)(?:\^([1-9]))?", unit.strip()):
        if not name:
            continue
        if name not in _BASE:
            return None
        count = int(power or 1) * (-1 if sign == "/" else 1)
        metres, seconds = metres + count * _BASE[name][0], seconds + count * _BASE[name][1]
        masses += count * (name in ("kg", "N"))
    return (metres, seconds) if masses == 1 else None


def _unit(metres: int, seconds: int) -> str:
    def powers(sign: int) -> list[str]:
        return [name + (f"^{sign * p}" if sign * p > 1 else "") for name, p in (("m", metres), ("s", seconds)) if sign * p > 0]

    return " ".join(["kg", *powers(1)]) + "".join(f"/{name}" for name in powers(-1))


class RigidBody(Config):
    """Mass, yaw inertia about the body origin and longitudinal centre of gravity."""

    m: Mass
    I_z: Inertia
    x_G: Length

    _positive = field_validator("m", "I_z")(_above_zero)


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

    @model_validator(mode="after")
    def _units(self) -> Damping:
        for axis, row, force in (("X", self.X, (1, -2)), ("Y", self.Y, (1, -2)), ("N", self.N, (2, -2))):
            for term, parameter in row.items():
                try:
                    metres, seconds = force
                    for factor in parse_term(term, VELOCITY):
                        if factor.power < 0:
                            raise ConfigError(f"term '{term}' is infinite at rest")
                        metres -= factor.power * (factor.name != "r")
                        seconds += factor.power
                except ConfigError as error:
                    raise ValueError(f"{axis}: {error}") from None
                if _dimension(parameter.unit) != (metres, seconds):
                    raise ValueError(f"{axis}.{term}: its unit must be {_unit(metres, seconds)}, given '{parameter.unit}'")
        return self


class VesselConfig(Config):
    """One vessel: everything that a 3-DOF Fossen plant needs."""

    name: str
    description: str
    length: Length
    rigid_body: RigidBody
    added_mass: AddedMass
    damping: Damping
    actuators: DifferentialThrustConfig

    _positive = field_validator("length")(_above_zero)


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

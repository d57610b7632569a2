"""Parameters of vessel files with unit and source, converted to SI on reading."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Annotated

from pydantic import AfterValidator, field_validator

from residnet.core.config import Config, Quantity
from residnet.core.errors import UsageError
from residnet.core.names import to_si

SquareMetres = Annotated[float, Quantity("m^2")]
Density = Annotated[float, Quantity("kg/m^3")]


class Parameter(Config):
    """Parameter with unit and source.

    Attributes:
        value: value in `unit`.
        unit: unit; the value is converted to SI when the file is read.
        source: reference of the value.
    """

    value: float
    unit: str
    source: str

    @field_validator("source")
    @classmethod
    def _validate_source(cls, source: str) -> str:
        if not source.strip():
            raise ValueError(
                "a parameter needs its source (a document and equation, or 'measured by ...')"
            )
        return source


def convert_to_unit(unit: str) -> Callable[[Parameter], Parameter]:
    """Return a validator that converts a parameter to `unit` and rejects other dimensions."""

    def convert(parameter: Parameter) -> Parameter:
        try:
            factor = to_si(parameter.unit, unit)
        except UsageError as error:
            raise ValueError(str(error)) from None
        return Parameter(value=parameter.value * factor, unit=unit, source=parameter.source)

    return convert


Mass = Annotated[Parameter, AfterValidator(convert_to_unit("kg"))]
MassArm = Annotated[Parameter, AfterValidator(convert_to_unit("kg m"))]
Inertia = Annotated[Parameter, AfterValidator(convert_to_unit("kg m^2"))]
Length = Annotated[Parameter, AfterValidator(convert_to_unit("m"))]
Volume = Annotated[Parameter, AfterValidator(convert_to_unit("m^3"))]
MassDensity = Annotated[Parameter, AfterValidator(convert_to_unit("kg/m^3"))]


def require_positive(parameter: Parameter) -> Parameter:
    """Return a parameter; a ValueError says that it is not positive."""
    if not parameter.value > 0:
        raise ValueError(f"must be positive, got {parameter.value:g}")
    return parameter


Positive = AfterValidator(require_positive)
# exponents of metre and second; the exponent of kilogram is counted separately
_BASE_DIMENSIONS = {
    "kg": (0, 0),
    "m": (1, 0),
    "s": (0, 1),
    "rad": (0, 0),
    "N": (1, -2),
    "1": (0, 0),
    "-": (0, 0),
}


def parse_dimension(unit: str, mass: int = 1) -> tuple[int, int] | None:
    """Return the exponents of metre and second in an SI unit whose exponent of kilogram is `mass`.

    For example, the result is (2, -1) for `kg m^2/s` or `N m s/rad`. It is None for any other
    unit.
    """
    metre_power = second_power = mass_power = 0
    # factors are separated by a space (multiplied) or a slash (divided), such as `kg m^2/s`
    for sign, name, power in re.findall(r"([/ ]?)([^/ ^]*)(?:\^([1-9]))?", unit.strip()):
        if not name:
            continue
        if name not in _BASE_DIMENSIONS:
            return None
        exponent = int(power or 1) * (-1 if sign == "/" else 1)
        metre_power = metre_power + exponent * _BASE_DIMENSIONS[name][0]
        second_power = second_power + exponent * _BASE_DIMENSIONS[name][1]
        # a newton contains one kilogram
        mass_power += exponent * (name in ("kg", "N"))
    return (metre_power, second_power) if mass_power == mass else None


def require_dimension(mass: int, metres: int, seconds: int) -> Callable[[Parameter], Parameter]:
    """Return a validator of a parameter with these exponents of kilogram, metre and second."""

    def check(parameter: Parameter) -> Parameter:
        if parse_dimension(parameter.unit, mass) != (metres, seconds):
            raise ValueError(
                f"expected the unit {format_unit(metres, seconds, mass)}, got '{parameter.unit}'"
            )
        return parameter

    return check


def format_unit(metres: int, seconds: int, mass: int = 1) -> str:
    """Format an SI unit `kg^c m^a s^b`."""

    def format_powers(sign: int) -> list[str]:
        dimensions = (("kg", mass), ("m", metres), ("s", seconds))
        return [
            name + (f"^{sign * exponent}" if sign * exponent > 1 else "")
            for name, exponent in dimensions
            if sign * exponent > 0
        ]

    numerator = format_powers(1) or (["1"] if format_powers(-1) else ["-"])
    return " ".join(numerator) + "".join(f"/{name}" for name in format_powers(-1))


GRAVITY = 9.81
"""Acceleration of gravity in m/s^2."""

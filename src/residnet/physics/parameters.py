"""Numbers of vessel files: each with its unit and source, converted to SI once, when read."""

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
    """A number with its unit and source.

    Attributes:
        value: the number, in `unit`.
        unit: its unit; the value is converted to SI when the file is read.
        source: where it comes from.
    """

    value: float
    unit: str
    source: str

    @field_validator("source")
    @classmethod
    def _source(cls, source: str) -> str:
        if not source.strip():
            raise ValueError(
                "a parameter needs its source (a document and equation, or 'measured by ...')"
            )
        return source


def measured_in(unit: str) -> Callable[[Parameter], Parameter]:
    """Return a validator of a parameter whose unit must measure `unit`.

    The validator converts the value to `unit`.
    """

    def convert(parameter: Parameter) -> Parameter:
        try:
            factor = to_si(parameter.unit, unit)
        except UsageError as error:
            raise ValueError(str(error)) from None
        return Parameter(value=parameter.value * factor, unit=unit, source=parameter.source)

    return convert


Mass = Annotated[Parameter, AfterValidator(measured_in("kg"))]
MassArm = Annotated[Parameter, AfterValidator(measured_in("kg m"))]
Inertia = Annotated[Parameter, AfterValidator(measured_in("kg m^2"))]
Length = Annotated[Parameter, AfterValidator(measured_in("m"))]
Volume = Annotated[Parameter, AfterValidator(measured_in("m^3"))]
MassDensity = Annotated[Parameter, AfterValidator(measured_in("kg/m^3"))]


def above_zero(parameter: Parameter) -> Parameter:
    """Return a validator of a parameter that must be positive."""
    if not parameter.value > 0:
        raise ValueError(f"must be positive, given {parameter.value:g}")
    return parameter


Positive = AfterValidator(above_zero)
_BASE = {
    "kg": (0, 0),
    "m": (1, 0),
    "s": (0, 1),
    "rad": (0, 0),
    "N": (1, -2),
    "1": (0, 0),
    "-": (0, 0),
}


def dimension(unit: str, mass: int = 1) -> tuple[int, int] | None:
    """Return the powers of metre and second in an SI unit with `mass` times mass.

    For example (2, -1) for `kg m^2/s` or `N m s/rad`; None for any other unit.
    """
    metres = seconds = masses = 0
    for sign, name, power in re.findall(r"([/ ]?)([^/ ^]*)(?:\^([1-9]))?", unit.strip()):
        if not name:
            continue
        if name not in _BASE:
            return None
        count = int(power or 1) * (-1 if sign == "/" else 1)
        metres, seconds = metres + count * _BASE[name][0], seconds + count * _BASE[name][1]
        masses += count * (name in ("kg", "N"))
    return (metres, seconds) if masses == mass else None


def of_dimension(mass: int, metres: int, seconds: int) -> Callable[[Parameter], Parameter]:
    """Return a validator of a parameter in kilogram, metre and second to these powers."""

    def check(parameter: Parameter) -> Parameter:
        if dimension(parameter.unit, mass) != (metres, seconds):
            raise ValueError(
                f"its unit must be {unit_text(metres, seconds, mass)}, given '{parameter.unit}'"
            )
        return parameter

    return check


def unit_text(metres: int, seconds: int, mass: int = 1) -> str:
    """Return SI unit `kg^c m^a s^b` as text."""

    def powers(sign: int) -> list[str]:
        dimensions = (("kg", mass), ("m", metres), ("s", seconds))
        return [
            name + (f"^{sign * p}" if sign * p > 1 else "")
            for name, p in dimensions
            if sign * p > 0
        ]

    above = powers(1) or (["1"] if powers(-1) else ["-"])
    return " ".join(above) + "".join(f"/{name}" for name in powers(-1))

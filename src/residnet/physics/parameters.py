"""Numbers of vessel files: SI parameters, each with its unit and source, converted once when the file is read."""

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


def measured_in(unit: str) -> Callable[[Parameter], Parameter]:
    """Validator of a parameter whose unit must measure `unit`; the value is converted to it."""

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
    """Validator of a parameter that must be positive."""
    if not parameter.value > 0:
        raise ValueError(f"must be positive, given {parameter.value:g}")
    return parameter


_BASE = {"kg": (0, 0), "m": (1, 0), "s": (0, 1), "rad": (0, 0), "N": (1, -2)}


def dimension(unit: str) -> tuple[int, int] | None:
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


def unit_text(metres: int, seconds: int) -> str:
    """SI unit `kg m^a s^b` as text."""

    def powers(sign: int) -> list[str]:
        return [name + (f"^{sign * p}" if sign * p > 1 else "") for name, p in (("m", metres), ("s", seconds)) if sign * p > 0]

    return " ".join(["kg", *powers(1)]) + "".join(f"/{name}" for name in powers(-1))

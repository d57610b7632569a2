"""Numbers with a unit in configs: SI numbers, or text such as `20 deg`, that become SI numbers."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import GetCoreSchemaHandler
from pydantic_core import CoreSchema, core_schema

from residnet.core.config_errors import given
from residnet.core.errors import UsageError
from residnet.core.units import si_unit, to_si, units


@dataclass(frozen=True)
class Quantity:
    """The mark of a float that a config gives in SI or as text with a unit.

    Used in an annotation: `Annotated[float, Quantity("kg")]`.

    Attributes:
        si: SI unit of the dimension; the value that the config holds is in this unit.

    Raises:
        UsageError: where `si` is not the SI unit of a known dimension.
    """

    si: str

    def __post_init__(self) -> None:
        if si_unit(self.si) != self.si:
            raise UsageError(f"unit '{self.si}' is not SI; the SI unit is '{si_unit(self.si)}'")

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Return the float's own schema, constraints included, behind the conversion."""
        return core_schema.no_info_before_validator_function(self.convert, handler(source))

    def convert(self, value: object) -> float:
        """Convert a number, or text such as `20 deg`, to SI.

        Raises:
            ValueError: where the value is not a finite number or `<number> <unit>`, or the unit is
                unknown or of another dimension.
        """
        try:
            si = self._parsed(value)
        except OverflowError:
            si = math.inf
        if not math.isfinite(si):
            raise ValueError(f"must be a finite number {given(value)}")
        return si

    def _parsed(self, value: object) -> float:
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            return float(value)
        match = _QUANTITY.fullmatch(value) if isinstance(value, str) else None
        if match is None:
            example = next((unit for unit in self._fitting() if unit != self.si), self.si)
            raise ValueError(
                f"expected a number in {self.si} or text such as '1.5 {example}' {given(value)}"
            )
        number, unit = match.groups()
        try:
            return float(number) * to_si(unit or self.si, self.si)
        except UsageError as error:
            raise ValueError(f"{error} {given(value)}") from error

    def _fitting(self) -> list[str]:
        return [unit for unit in units() if si_unit(unit) == self.si]


_QUANTITY = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*")


def quantity(si: str) -> Any:
    """Return the type of a float in `si`, for types that are put together at run time.

    In annotations write `Annotated[float, Quantity(si)]`.

    Raises:
        UsageError: where `si` is not the SI unit of a known dimension.
    """
    return Annotated[float, Quantity(si)]


Seconds = Annotated[float, Quantity("s")]
Metres = Annotated[float, Quantity("m")]
Kilograms = Annotated[float, Quantity("kg")]
MetresPerSecond = Annotated[float, Quantity("m/s")]
Radians = Annotated[float, Quantity("rad")]
RadiansPerSecond = Annotated[float, Quantity("rad/s")]
Hertz = Annotated[float, Quantity("1/s")]
RevsPerSecond = Annotated[float, Quantity("1/s")]
RevRate = Annotated[float, Quantity("1/s^2")]
Newtons = Annotated[float, Quantity("N")]
NewtonMetres = Annotated[float, Quantity("N m")]

"""Names and units: factors against their definitions, and errors that name what fits."""

from __future__ import annotations

import math

import pytest

from residnet.core.errors import UsageError
from residnet.core.names import ACCELERATION, CHANNEL_UNITS, STATE, nearest, si_unit, to_si, units


@pytest.mark.parametrize(
    ("unit", "si", "factor"),
    [
        ("deg", "rad", math.pi / 180),
        ("deg/s", "rad/s", math.pi / 180),
        ("kn", "m/s", 1852 / 3600),
        ("km/h", "m/s", 1000 / 3600),
        ("nmi", "m", 1852.0),
        ("ft", "m", 12 * 0.0254),
        ("g", "m/s^2", 9.80665),
        ("rpm", "1/s", 1 / 60),
        ("rpm/s", "1/s^2", 1 / 60),
        ("Hz", "1/s", 1.0),
        ("min", "s", 60.0),
        ("ms", "s", 0.001),
        ("kN m", "N m", 1000.0),
        ("t", "kg", 1000.0),
        ("%", "-", 0.01),
    ],
)
def test_factor(unit: str, si: str, factor: float) -> None:
    assert si_unit(unit) == si
    assert to_si(unit) == to_si(unit, si) == pytest.approx(factor, rel=1e-15)


def test_si_units_convert_to_themselves() -> None:
    for unit in units():
        assert si_unit(si_unit(unit)) == si_unit(unit)
        assert to_si(si_unit(unit)) == 1.0
        assert to_si(unit) > 0


def test_channels_are_si() -> None:
    for name, unit in CHANNEL_UNITS.items():
        assert si_unit(unit) == unit, name
    assert set(STATE) | set(ACCELERATION) <= set(CHANNEL_UNITS)


def test_unknown_unit_names_the_nearest() -> None:
    with pytest.raises(UsageError, match=r"unknown unit 'dge'; did you mean 'deg'\?$"):
        to_si("dge")
    with pytest.raises(UsageError, match="unknown unit 'furlong'; valid: %, "):
        si_unit("furlong")


def test_wrong_dimension_names_the_units_that_fit() -> None:
    with pytest.raises(
        UsageError, match=r"unit 'kn' does not measure \[rad\]; units that do: rad, deg, cdeg, gon$"
    ):
        to_si("kn", "rad")
    with pytest.raises(UsageError, match=r"units that do: none$"):
        to_si("kn", "cd")


def test_nearest() -> None:
    assert nearest("hiden", ["hidden", "kind"]) == "; did you mean 'hidden'?"
    assert nearest("zzz", ["b", "a", "b"]) == "; valid: a, b"
    many = nearest("zzz", [f"key{i:02d}" for i in range(30)])
    assert many.endswith("key23, ...")
    assert "key24" not in many

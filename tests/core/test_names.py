"""Names and units: factors against their definitions, and errors that name what fits."""

from __future__ import annotations

import math

import pytest

from residnet.core.errors import UsageError
from residnet.core.names import CHANNEL_UNITS, si_unit, suggest_name, to_si, unit_names


@pytest.mark.parametrize(
    ("unit", "si", "factor"),
    [
        ("deg", "rad", math.pi / 180),
        ("km/h", "m/s", 1000 / 3600),
        ("ft", "m", 12 * 0.0254),
        ("g", "m/s^2", 9.80665),
    ],
)
def test_to_si_factor(unit: str, si: str, factor: float) -> None:
    assert si_unit(unit) == si
    assert to_si(unit) == to_si(unit, si) == pytest.approx(factor, rel=1e-15)


def test_to_si_of_si_units_is_one() -> None:
    for unit in (*map(si_unit, unit_names()), *CHANNEL_UNITS.values()):
        assert si_unit(unit) == unit
        assert to_si(unit) == 1.0


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (("dge",), r"unknown unit 'dge'; did you mean 'deg'\?$"),
        (("furlong",), "unknown unit 'furlong'; valid: %, "),
        (("kn", "rad"), r"'kn' does not measure \[rad\]; units that do: rad, deg, cdeg, gon$"),
        (("kn", "cd"), "units that do: none$"),
    ],
)
def test_to_si_with_a_wrong_unit_suggests_valid_ones(given: tuple[str, ...], told: str) -> None:
    with pytest.raises(UsageError, match=told):
        to_si(*given)


def test_suggest_name() -> None:
    assert suggest_name("hiden", ["hidden", "kind"]) == "; did you mean 'hidden'?"
    assert suggest_name("zzz", ["b", "a", "b"]) == "; valid: a, b"
    many = suggest_name("zzz", [f"key{i:02d}" for i in range(30)])
    assert many.endswith("key23, ...")
    assert "key24" not in many

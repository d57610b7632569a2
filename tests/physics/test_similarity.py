"""Dimensions of terms, non-dimensional systems, Froude scaling and estimates from particulars."""

from __future__ import annotations

import math

import pytest

from residnet.core.config import validate_config
from residnet.core.errors import ConfigError, UsageError
from residnet.physics.similarity import (
    Dimension,
    Particulars,
    dimension_of_term,
    dimension_of_unit,
    estimate_added_mass,
    estimate_linear_derivatives,
    froude_factor,
)
from residnet.physics.terms import parse_term

UNITS = {"u": "m/s", "v": "m/s", "r": "rad/s", "n": "1/s", "delta": "rad", "tau_n": "N m", "p": "V"}
# the Mariner class: length, mean draught and beam, and published derivatives in the prime I system
# (Stroem-Tejsen 1965, as in Fossen 2011, section 13.2)
MARINER = {"length": 160.93, "draught": 7.47, "beam": 23.17, "speed": 7.72, "density": 1025.0}
MARINER_MASS = 798e-5
MARINER_ADDED = {"surge": 42e-5, "sway": 748e-5, "yaw": 43.8e-5}


def mariner() -> Particulars:
    mass = MARINER_MASS * 0.5 * MARINER["density"] * MARINER["length"] ** 3
    return Particulars(**MARINER, mass=mass, centre_of_gravity=-0.023 * MARINER["length"])


@pytest.mark.parametrize(
    ("term", "dimension"),
    [
        ("u|u|", Dimension(0, 2, -2)),
        ("v r", Dimension(0, 1, -2)),
        ("n^2 sin(delta)", Dimension(0, 0, -2)),
        ("tau_n", Dimension(1, 2, -2)),
        ("v inv(u)", Dimension(0, 0, 0)),
        ("sqrt(u)", Dimension(0, 0.5, -0.5)),
        ("1", Dimension(0, 0, 0)),
    ],
)
def test_dimension_of_term_follows_factors(term: str, dimension: Dimension) -> None:
    assert dimension_of_term(parse_term(term, tuple(UNITS)), UNITS) == dimension


@pytest.mark.parametrize("term", ["p", "sin(u)"])
def test_dimension_of_term_without_mechanical_meaning_is_none(term: str) -> None:
    assert dimension_of_term(parse_term(term, tuple(UNITS)), UNITS) is None


def test_prime_systems_have_the_units_of_sname() -> None:
    ship = mariner()
    force = dimension_of_unit("N")
    assert force is not None
    length = ship.length
    speed = ship.speed
    density = ship.density
    prime_i = ship.reference_scales("prime_i")
    prime_ii = ship.reference_scales("prime_ii")
    bis = ship.reference_scales("bis")
    assert prime_i is not None
    assert prime_ii is not None
    assert bis is not None
    assert prime_i.factor(force) == pytest.approx(0.5 * density * length**2 * speed**2)
    assert prime_ii.factor(force) == pytest.approx(0.5 * density * length * 7.47 * speed**2)
    assert bis.factor(force) == pytest.approx(ship.mass * 9.81)


def test_reference_scales_without_draught_or_mass_are_none() -> None:
    boat = Particulars(length=5.0, speed=1.0)
    assert boat.reference_scales("prime_i") is not None
    assert boat.reference_scales("prime_ii") is None
    assert boat.reference_scales("bis") is None


@pytest.mark.parametrize(
    ("unit", "exponent"), [("m/s", 0.5), ("rad/s", -0.5), ("N", 3.0), ("N m", 4.0), ("m/s^2", 0.0)]
)
def test_froude_factor_has_the_exponent_of_the_quantity(unit: str, exponent: float) -> None:
    dimension = dimension_of_unit(unit)
    assert dimension is not None
    assert froude_factor(dimension, 50.0) == pytest.approx(50.0**exponent)
    there_and_back = froude_factor(dimension, 50.0, 1.025) * froude_factor(
        dimension, 1 / 50.0, 1 / 1.025
    )
    assert there_and_back == pytest.approx(1.0, rel=1e-12)


def test_scaled_particulars_keep_froude_number_and_prime_mass() -> None:
    model = mariner().scaled(1 / 50.0, 1000.0 / 1025.0)
    assert model.froude_number == pytest.approx(mariner().froude_number)
    assert model.mass == pytest.approx(MARINER_MASS * 0.5 * 1000.0 * model.length**3)


def test_added_mass_of_the_mariner_is_near_the_published_one() -> None:
    ship = mariner()
    added = estimate_added_mass(ship)
    assert added is not None
    unit = 0.5 * ship.density * ship.length**3
    assert added.sway / unit == pytest.approx(MARINER_ADDED["sway"], rel=0.15)
    assert added.yaw / (unit * ship.length**2) == pytest.approx(MARINER_ADDED["yaw"], rel=0.15)
    assert added.surge / unit == pytest.approx(MARINER_ADDED["surge"], rel=0.35)


def test_linear_derivatives_of_a_hull_have_the_signs_of_damping() -> None:
    derivatives = estimate_linear_derivatives(mariner())
    assert derivatives is not None
    assert derivatives["Y_v"] < 0
    assert derivatives["N_v"] < 0
    assert derivatives["N_r"] < 0
    assert derivatives["N_v"] == pytest.approx(-264e-5, rel=0.75)
    assert derivatives["N_r"] == pytest.approx(-166e-5, rel=0.35)


def test_mass_above_the_displaced_box_is_refused() -> None:
    boat = Particulars(length=5.0, speed=1.0, beam=1.0, draught=0.2, mass=1200.0)
    with pytest.raises(UsageError, match=r"1200 kg"):
        estimate_added_mass(boat)


def test_particulars_take_units_and_name_the_wrong_key() -> None:
    boat = validate_config({"length": "500 cm", "speed": "2 kn"}, Particulars, "particulars")
    assert boat.length == pytest.approx(5.0)
    assert boat.speed == pytest.approx(2 * 1852 / 3600)
    with pytest.raises(ConfigError, match="draught"):
        validate_config({"length": 5, "speed": 1, "draught": -1}, Particulars, "particulars")
    assert math.isclose(boat.froude_number, boat.speed / math.sqrt(9.81 * 5.0))

"""The regressors of the standard recipe's linear model and hull, as far as logs excite them."""

from __future__ import annotations

from collections.abc import Sequence

from residnet.core.names import VELOCITY
from residnet.identification.standard.facts import Facts
from residnet.physics.signals import FORCE_CHANNELS
from residnet.physics.symmetry import wrong_parity

_HULL = ("u v", "u r", "v r", "u|u|", "v|v|", "r|r|", "v|r|", "r|v|")
_WIND = (
    "wind_u",
    "wind_v",
    "wind_u wind_mag",
    "wind_v wind_mag",
    "wind_u wind_v",
    "wind_u wind_v^2 wind_mag^-1",
    "wind_v wind_u^2 wind_mag^-1",
)
_FURTHER = ("u^2 v", "u^2 r", "v^2", "r^2")
"""Terms that only long logs determine."""
_LONG = 1200.0
"""Length of the training logs in s from which they are taken in."""
_MANY = 3
"""Propellers from which a rudder is not told by the race of each."""


def linear_terms(facts: Facts) -> list[str]:
    """Return the terms of a model that is linear in velocities, inputs and wind."""
    wind = ["wind_u", "wind_v"] if facts.wind else []
    return ["1", *VELOCITY, *facts.inputs, *wind]


def hull_terms(facts: Facts) -> list[str] | dict[str, list[str]]:
    """Return the terms of a manoeuvring model: hull, propellers, rudders and wind.

    A rudder is known by its name. Every other input is taken for a propeller: a force that is
    linear and quadratic in it and falls with the inflow. Forces act as they are.

    Short logs give each axis the terms that a mirror-symmetric vessel has there, and what a lone
    propeller adds to them: half as many coefficients as all terms in all axes.
    """
    terms = _terms(facts)
    if long(facts):
        return terms
    kept = ("1", *(f"{name}|{name}|" for name in facts.inputs))
    return {
        axis: [t for t in terms if t in kept or not wrong_parity(t, number, facts.names)]
        for number, axis in enumerate(VELOCITY)
    }


def full_hull_terms(facts: Facts) -> list[str]:
    """Return the terms of a hull with all that long logs determine."""
    _, turning, driving = _acting(facts)
    more = ["wind_mag r", "wind_u r"] if facts.wind else []
    more += [*_FURTHER, *(term for n in driving for term in (f"{n} v", f"{n} r"))]
    return [*_terms(facts), *more, *(t for n in turning for t in _large_angles(n, driving))]


def long(facts: Facts) -> bool:
    """Return whether the training logs are long enough for a hull of many terms."""
    return facts.samples * facts.step >= _LONG


def _acting(facts: Facts) -> tuple[list[str], list[str], list[str]]:
    """Return the inputs that are forces, that turn the flow, and that drive."""
    forces = [name for name in facts.inputs if name in FORCE_CHANNELS]
    acting = [name for name in facts.inputs if name not in forces]
    turning = [name for name in acting if _turns(name)]
    return forces, turning, [name for name in acting if name not in turning]


def _terms(facts: Facts) -> list[str]:
    """Return the terms of all axes together."""
    forces, turning, driving = _acting(facts)
    return [
        *("1", *VELOCITY, *_HULL, *forces),
        *(term for name in driving for term in _propeller(name, name in facts.astern)),
        *(term for name in turning for term in _rudder(name, driving, facts.astern)),
        *(_WIND if facts.wind else ()),
    ]


def _turns(name: str) -> bool:
    plain = name.removeprefix("cmd_")
    return plain.startswith(("delta", "rudder", "azimuth"))


def _propeller(name: str, astern: bool) -> list[str]:
    """Return the thrust of a propeller; one that turns astern differs from one ahead."""
    back = [f"{name}^2", f"{name} u"] if astern else []
    return [name, f"{name}|{name}|", f"|{name}| u", *back]


def _rudder(name: str, driving: Sequence[str], astern: Sequence[str]) -> list[str]:
    """Return the lift of a rudder in the inflow from speed and propellers."""
    if len(driving) >= _MANY:
        return [name, f"u|u| {name}"]
    race = [f"{n}|{n}| {name}" for n in driving] + [f"u {n} {name}" for n in driving]
    return [f"u|u| {name}", *race, *(f"{n}^2 {name}" for n in driving if n in astern)]


def _large_angles(name: str, driving: Sequence[str]) -> list[str]:
    """Return how the lift of a rudder flattens, and its drag."""
    if len(driving) != 1:
        return [name, f"u|u| {name}|{name}|", f"u|u| |{name}|"]
    race = (f"{driving[0]}|{driving[0]}|", f"u {driving[0]}")
    return [
        name,
        *(f"{flow} {name}|{name}|" for flow in race),
        *(f"{flow} |{name}|" for flow in race),
    ]

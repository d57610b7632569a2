"""Named sets of regressors, written out for the channels that a model has."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations, combinations_with_replacement
from typing import Literal, NamedTuple

from residnet.core.errors import ConfigError
from residnet.core.names import VELOCITY, nearest
from residnet.physics.signals import FORCE_CHANNELS, WIND_CHANNELS
from residnet.physics.symmetry import live_of, meaning
from residnet.physics.terms import Factor, polynomial_terms

SetName = Literal["linear", "fossen", "abkowitz", "astern", "wind", "polynomial_1", "polynomial_2"]

# thrusters act through forces where the model makes them; two fixed thrusters make no sway force
_DRIVES = ("n", "tau_x")
_STEERS = ("delta", "delta_s", "tau_n")


class Roles(NamedTuple):
    """The roles of a model's channels.

    Attributes:
        moving: velocities, and the angles that forces depend on; in six degrees of freedom those
            that live.
        drives: those that push.
        steers: those that turn.
        others: inputs of which neither is known.
        wind: whether there is wind.
    """

    moving: tuple[str, ...]
    drives: tuple[str, ...]
    steers: tuple[str, ...]
    others: tuple[str, ...]
    wind: bool

    @classmethod
    def of(
        cls, names: Sequence[str], drive: Sequence[str] = (), steer: Sequence[str] = ()
    ) -> Roles:
        """Return the roles by name, or as given.

        Raises:
            ConfigError: where a given channel does not exist.
        """
        for name in (*drive, *steer):
            if name not in names:
                raise ConfigError(f"sets: no channel '{name}'{nearest(name, names)}")
        forces = "tau_x" in names
        acting = [
            name
            for name in names
            if name not in (*live_of(names).moving, *WIND_CHANNELS)
            and (not forces or name in FORCE_CHANNELS)
        ]
        drives = tuple(drive) or tuple(name for name in acting if name in _DRIVES)
        steers = tuple(steer) or tuple(name for name in acting if name in _STEERS)
        others = tuple(name for name in acting if name not in (*drives, *steers) and not forces)
        live = live_of(names)
        moving = live.channels if live.spatial else live.moving
        return cls(moving, drives, steers, others, "wind_u" in names)

    def known(self, who: str) -> Roles:
        """Return the same, where every input has a role.

        Raises:
            ConfigError: where one has none.
        """
        if self.others:
            raise ConfigError(
                f"set '{who}' must know whether '{self.others[0]}' pushes or turns; name it in"
                " `drive` or `steer`"
            )
        if not self.drives or not self.steers:
            raise ConfigError(
                f"set '{who}' needs a channel that pushes and one that turns (name them in `drive`"
                " and `steer`)"
            )
        return self


def is_force(name: str) -> bool:
    """Return whether a channel is a force that acts as it is: tau_x, or a thruster's thrust."""
    plain = name.removeprefix("cmd_")
    return name in FORCE_CHANNELS or plain == "thrust" or plain.startswith("thrust_")


def _linear(roles: Roles) -> list[str]:
    moving = [name for name in roles.moving if name != "z"]
    return ["1", *moving, *roles.drives, *roles.steers, *roles.others]


def _thrust(drive: str) -> list[str]:
    """Return a force as it is, or the thrust of a propeller, which falls with the inflow."""
    return [drive] if is_force(drive) else [drive, f"{drive}|{drive}|", f"|{drive}| u"]


def _turns(drive: str) -> bool:
    """Return whether a channel counts the revolutions of a propeller, whose thrust is known."""
    return drive.removeprefix("cmd_").partition("_")[0] == "n"


def _turning(steer: str, drives: Sequence[str]) -> list[str]:
    """Return a moment as it is, or the lift of a rudder.

    It grows with the square of the inflow from speed and propellers.
    """
    if steer in FORCE_CHANNELS:
        return [steer]
    propellers = [drive for drive in drives if drive not in FORCE_CHANNELS]
    return [
        f"u|u| {steer}",
        *(f"{n}|{n}| {steer}" for n in propellers),
        *(f"u {n} {steer}" for n in propellers),
    ]


HULL = ("u v", "u r", "v r", "u|u|", "v|v|", "r|r|", "v|r|", "r|v|")
"""Coriolis products and quadratic damping."""
ROLL = ("u p", "p|p|", "u|u| phi", "phi^3")
WIND = (
    "wind_u", "wind_v", "wind_u wind_mag", "wind_v wind_mag",
    "wind_u wind_v", "wind_u wind_v^2 wind_mag^-1", "wind_v wind_u^2 wind_mag^-1",
)  # fmt: skip
"""Loads that are quadratic in the relative wind, with coefficients that turn with its direction:
the first three harmonics.
"""


def _fossen(roles: Roles) -> list[str]:
    """Return the terms of Fossen's manoeuvring model.

    Coriolis products, linear and quadratic damping (document 002 eq. (2.4), document 003 eqs.
    (7)-(9)). Of a roll its damping, what speed does to damping and restoring, and a restoring that
    is not linear (document 004).
    """
    if "z" in roles.moving:
        return submerged(roles)
    hull = (*HULL, *(ROLL if "p" in roles.moving else ()))
    drives, steers = roles.known("fossen").drives, roles.steers
    controls = [t for drive in drives for t in _thrust(drive)]
    controls += [t for steer in steers for t in _turning(steer, drives)]
    return ["1", *roles.moving, *hull, *controls]


VERTICAL = ("sin(theta)", "cos(theta) sin(phi)", "cos(theta) cos(phi)")
"""The vertical along the body axes, which weight and buoyancy act along."""


def submerged(roles: Roles) -> list[str]:
    """Return the terms of any axis of a vessel in six degrees of freedom.

    Linear and quadratic damping, all products of two velocities (Coriolis forces of mass and added
    mass, lift), weight and buoyancy (Fossen 2021, sections 6.3, 6.4 and 4.1); forces as they are,
    thrust and torque of propellers, lift and drag of fins.
    """
    velocities = [name for name in roles.moving if name not in ("z", "phi", "theta")]
    pairs = [" ".join(pair) for pair in combinations(velocities, 2)]
    turns = [f"{name}^2" for name in velocities if name in ("p", "q", "r")]
    driving = (*roles.drives, *roles.others)
    thrust = [t for n in driving for t in _thrust(n)[0 if is_force(n) or not _turns(n) else 1 :]]
    # where no log tells the speed it is that of a usual one
    flow = "u^2 " if "u" in velocities else ""
    fins = [f"{flow}{fin}{power}" for fin in roles.steers for power in ("", "^2")]
    damping = [f"{name}|{name}|" for name in velocities]
    # one that stays upright has weight and buoyancy along heave whatever its pitch
    level = () if "phi" in roles.moving else ("sin(theta)", "1")
    return [*velocities, *damping, *pairs, *turns, *(level or VERTICAL), *thrust, *fins]


def _abkowitz(roles: Roles) -> list[str]:
    """Return a Taylor series to third order about straight ahead.

    Even products act in surge, odd ones in sway and yaw (an asymmetric hull has both).
    """
    sideways = ["v", "r", *roles.known("abkowitz").steers]
    even = [" ".join(c) for c in combinations_with_replacement(sideways, 2)]
    odd = [" ".join(c) for c in combinations_with_replacement(sideways, 3)]
    speed = ["u", "u^2", "u^3", *(f"u {name}" for name in sideways)]
    rolling = [t for name in roles.moving[len(VELOCITY) :] for t in (name, f"u {name}")]
    return [
        "1",
        *speed,
        *sideways,
        *even,
        *odd,
        *rolling,
        *(t for drive in roles.drives for t in _thrust(drive)),
    ]


def _wind(roles: Roles) -> list[str]:
    if not roles.wind:
        raise ConfigError(
            "set 'wind' needs the true wind; add wind_speed and wind_dir to signals.exogenous"
        )
    return list(WIND)


def _astern(roles: Roles) -> list[str]:
    """Return what tells a propeller that turns astern from one that turns ahead.

    The other sets alone take them as mirrored.
    """
    propellers = [name for name in roles.drives if name not in FORCE_CHANNELS]
    if not propellers:
        raise ConfigError(
            "set 'astern' needs a propeller among the channels that push (name it in `drive`)"
        )
    return [
        t
        for n in propellers
        for t in (f"{n}^2", f"{n} u", *(f"{n}^2 {steer}" for steer in roles.steers))
    ]


def _polynomial(roles: Roles, degree: int) -> list[str]:
    wind = ("wind_u", "wind_v") if roles.wind else ()
    return [
        "1",
        *polynomial_terms(
            (
                *(n for n in roles.moving if n != "z"),
                *roles.drives,
                *roles.steers,
                *roles.others,
                *wind,
            ),
            degree,
        ),
    ]


_SETS: dict[str, Callable[[Roles], list[str]]] = {
    "linear": _linear,
    "fossen": _fossen,
    "abkowitz": _abkowitz,
    "astern": _astern,
    "wind": _wind,
    "polynomial_1": lambda roles: _polynomial(roles, 1),
    "polynomial_2": lambda roles: _polynomial(roles, 2),
}


def expand(sets: Sequence[SetName], roles: Roles) -> tuple[str, ...]:
    """Return the terms of all sets, one after another.

    Raises:
        ConfigError: where the model lacks a channel that a set needs.
    """
    return tuple(term for name in sets for term in _SETS[name](roles))


def merged(terms: Sequence[str], names: Sequence[str]) -> tuple[str, ...]:
    """Return the terms without those that repeat one before them.

    Such are `v u` after `u v` or `n^2` after `n n`.
    """
    seen: dict[frozenset[tuple[Factor, int, bool]], str] = {}
    for term in terms:
        seen.setdefault(meaning(term, names, {}), term)
    return tuple(seen.values())

"""Named sets of regressors, written out for the channels that a model has."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations, combinations_with_replacement
from typing import Literal, NamedTuple

from residnet.core.errors import ConfigError
from residnet.core.names import VELOCITY_NAMES, suggest_name
from residnet.physics.signals import FORCE_CHANNELS, WIND_CHANNELS
from residnet.physics.symmetry import canonical_factors, get_dof
from residnet.physics.terms import Factor, make_polynomial_terms

SetName = Literal["linear", "fossen", "abkowitz", "astern", "wind", "polynomial_1", "polynomial_2"]

# thrusters act through forces where the model makes them; two fixed thrusters make no sway force
_DRIVE_NAMES = ("n", "tau_x")
_STEER_NAMES = ("delta", "delta_s", "tau_n")


class ChannelRoles(NamedTuple):
    """The roles of a model's channels.

    Attributes:
        dynamic_states: velocities, and the angles that forces depend on; in six degrees of freedom those
            that live.
        drives: those that push.
        steers: those that turn.
        unassigned: inputs of which neither is known.
        has_wind: whether there is wind.
    """

    dynamic_states: tuple[str, ...]
    drives: tuple[str, ...]
    steers: tuple[str, ...]
    unassigned: tuple[str, ...]
    has_wind: bool

    @classmethod
    def from_channels(
        cls, names: Sequence[str], drive: Sequence[str] = (), steer: Sequence[str] = ()
    ) -> ChannelRoles:
        """Return the roles by name, or as given.

        Raises:
            ConfigError: where a given channel does not exist.
        """
        for name in (*drive, *steer):
            if name not in names:
                raise ConfigError(f"sets: no channel '{name}'{suggest_name(name, names)}")
        has_forces = "tau_x" in names
        input_channels = [
            name
            for name in names
            if name not in (*get_dof(names).dynamic_states, *WIND_CHANNELS)
            and (not has_forces or name in FORCE_CHANNELS)
        ]
        drives = tuple(drive) or tuple(name for name in input_channels if name in _DRIVE_NAMES)
        steers = tuple(steer) or tuple(name for name in input_channels if name in _STEER_NAMES)
        unassigned = tuple(
            name for name in input_channels if name not in (*drives, *steers) and not has_forces
        )
        dof = get_dof(names)
        dynamic_states = dof.active_states if dof.is_six_dof else dof.dynamic_states
        return cls(dynamic_states, drives, steers, unassigned, "wind_u" in names)

    def require_assigned(self, subject: str) -> ChannelRoles:
        """Return the same, where every input has a role.

        Raises:
            ConfigError: where one has none.
        """
        if self.unassigned:
            raise ConfigError(
                f"set '{subject}' must know whether '{self.unassigned[0]}' pushes or turns; name it in"
                " `drive` or `steer`"
            )
        if not self.drives or not self.steers:
            raise ConfigError(
                f"set '{subject}' needs a channel that pushes and one that turns (name them in `drive`"
                " and `steer`)"
            )
        return self


def is_force_channel(name: str) -> bool:
    """Return whether a channel is a force that acts as it is: tau_x, or a thruster's thrust."""
    base_name = name.removeprefix("cmd_")
    return name in FORCE_CHANNELS or base_name == "thrust" or base_name.startswith("thrust_")


def _linear_terms(roles: ChannelRoles) -> list[str]:
    states = [name for name in roles.dynamic_states if name != "z"]
    return ["1", *states, *roles.drives, *roles.steers, *roles.unassigned]


def _thrust_terms(drive: str) -> list[str]:
    """Return a force as it is, or the thrust of a propeller, which falls with the inflow."""
    return [drive] if is_force_channel(drive) else [drive, f"{drive}|{drive}|", f"|{drive}| u"]


def _is_revolutions(drive: str) -> bool:
    """Return whether a channel counts the revolutions of a propeller, whose thrust is known."""
    return drive.removeprefix("cmd_").partition("_")[0] == "n"


def _steering_terms(steer: str, drives: Sequence[str]) -> list[str]:
    """Return a moment as it is, or the lift of a rudder.

    It grows with the square of the inflow from speed and propellers.
    """
    if steer in FORCE_CHANNELS:
        return [steer]
    propellers = [drive for drive in drives if drive not in FORCE_CHANNELS]
    return [
        f"u|u| {steer}",
        *(f"{propeller}|{propeller}| {steer}" for propeller in propellers),
        *(f"u {propeller} {steer}" for propeller in propellers),
    ]


HULL_TERMS = ("u v", "u r", "v r", "u|u|", "v|v|", "r|r|", "v|r|", "r|v|")
"""Coriolis products and quadratic damping."""
ROLL_TERMS = ("u p", "p|p|", "u|u| phi", "phi^3")
WIND_TERMS = (
    "wind_u", "wind_v", "wind_u wind_mag", "wind_v wind_mag",
    "wind_u wind_v", "wind_u wind_v^2 wind_mag^-1", "wind_v wind_u^2 wind_mag^-1",
)  # fmt: skip
"""Loads that are quadratic in the relative wind, with coefficients that turn with its direction:
the first three harmonics.
"""


def _fossen_terms(roles: ChannelRoles) -> list[str]:
    """Return the terms of Fossen's manoeuvring model.

    Coriolis products, linear and quadratic damping (document 002 eq. (2.4), document 003 eqs.
    (7)-(9)). Of a roll its damping, what speed does to damping and restoring, and a restoring that
    is not linear (document 004).
    """
    if "z" in roles.dynamic_states:
        return submerged_terms(roles)
    hull_terms = (*HULL_TERMS, *(ROLL_TERMS if "p" in roles.dynamic_states else ()))
    drives = roles.require_assigned("fossen").drives
    steers = roles.steers
    control_terms = [term for drive in drives for term in _thrust_terms(drive)]
    control_terms += [term for steer in steers for term in _steering_terms(steer, drives)]
    return ["1", *roles.dynamic_states, *hull_terms, *control_terms]


GRAVITY_TERMS = ("sin(theta)", "cos(theta) sin(phi)", "cos(theta) cos(phi)")
"""The vertical along the body axes, which weight and buoyancy act along."""


def submerged_terms(roles: ChannelRoles) -> list[str]:
    """Return the terms of any axis of a vessel in six degrees of freedom.

    Linear and quadratic damping, all products of two velocities (Coriolis forces of mass and added
    mass, lift), weight and buoyancy (Fossen 2021, sections 6.3, 6.4 and 4.1); forces as they are,
    thrust and torque of propellers, lift and drag of fins.
    """
    velocities = [name for name in roles.dynamic_states if name not in ("z", "phi", "theta")]
    velocity_products = [" ".join(pair) for pair in combinations(velocities, 2)]
    squared_rates = [f"{name}^2" for name in velocities if name in ("p", "q", "r")]
    thrusters = (*roles.drives, *roles.unassigned)
    thrust_terms = [
        term
        for thruster in thrusters
        for term in _thrust_terms(thruster)[
            0 if is_force_channel(thruster) or not _is_revolutions(thruster) else 1 :
        ]
    ]
    # where no log tells the speed it is that of a usual one
    speed_factor = "u^2 " if "u" in velocities else ""
    fin_terms = [
        f"{speed_factor}{fin}{exponent}" for fin in roles.steers for exponent in ("", "^2")
    ]
    damping_terms = [f"{name}|{name}|" for name in velocities]
    # one that stays upright has weight and buoyancy along heave whatever its pitch
    vertical_terms = () if "phi" in roles.dynamic_states else ("sin(theta)", "1")
    return [
        *velocities,
        *damping_terms,
        *velocity_products,
        *squared_rates,
        *(vertical_terms or GRAVITY_TERMS),
        *thrust_terms,
        *fin_terms,
    ]


def _abkowitz_terms(roles: ChannelRoles) -> list[str]:
    """Return a Taylor series to third order about straight ahead.

    Even products act in surge, odd ones in sway and yaw (an asymmetric hull has both).
    """
    lateral_channels = ["v", "r", *roles.require_assigned("abkowitz").steers]
    even_terms = [
        " ".join(combination) for combination in combinations_with_replacement(lateral_channels, 2)
    ]
    odd_terms = [
        " ".join(combination) for combination in combinations_with_replacement(lateral_channels, 3)
    ]
    surge_terms = ["u", "u^2", "u^3", *(f"u {name}" for name in lateral_channels)]
    roll_terms = [
        term for name in roles.dynamic_states[len(VELOCITY_NAMES) :] for term in (name, f"u {name}")
    ]
    return [
        "1",
        *surge_terms,
        *lateral_channels,
        *even_terms,
        *odd_terms,
        *roll_terms,
        *(term for drive in roles.drives for term in _thrust_terms(drive)),
    ]


def _wind_terms(roles: ChannelRoles) -> list[str]:
    if not roles.has_wind:
        raise ConfigError(
            "set 'wind' needs the true wind; add wind_speed and wind_dir to signals.exogenous"
        )
    return list(WIND_TERMS)


def _astern_terms(roles: ChannelRoles) -> list[str]:
    """Return what tells a propeller that turns astern from one that turns ahead.

    The other sets alone take them as mirrored.
    """
    propellers = [name for name in roles.drives if name not in FORCE_CHANNELS]
    if not propellers:
        raise ConfigError(
            "set 'astern' needs a propeller among the channels that push (name it in `drive`)"
        )
    return [
        term
        for propeller in propellers
        for term in (
            f"{propeller}^2",
            f"{propeller} u",
            *(f"{propeller}^2 {steer}" for steer in roles.steers),
        )
    ]


def _polynomial_terms(roles: ChannelRoles, degree: int) -> list[str]:
    wind = ("wind_u", "wind_v") if roles.has_wind else ()
    return [
        "1",
        *make_polynomial_terms(
            (
                *(state for state in roles.dynamic_states if state != "z"),
                *roles.drives,
                *roles.steers,
                *roles.unassigned,
                *wind,
            ),
            degree,
        ),
    ]


_TERM_SETS: dict[str, Callable[[ChannelRoles], list[str]]] = {
    "linear": _linear_terms,
    "fossen": _fossen_terms,
    "abkowitz": _abkowitz_terms,
    "astern": _astern_terms,
    "wind": _wind_terms,
    "polynomial_1": lambda roles: _polynomial_terms(roles, 1),
    "polynomial_2": lambda roles: _polynomial_terms(roles, 2),
}


def expand_sets(set_names: Sequence[SetName], roles: ChannelRoles) -> tuple[str, ...]:
    """Return the terms of all sets, one after another.

    Raises:
        ConfigError: where the model lacks a channel that a set needs.
    """
    return tuple(term for name in set_names for term in _TERM_SETS[name](roles))


def drop_equivalent_terms(terms: Sequence[str], names: Sequence[str]) -> tuple[str, ...]:
    """Return the terms without those that repeat one before them.

    Such are `v u` after `u v` or `n^2` after `n n`.
    """
    term_of_factors: dict[frozenset[tuple[Factor, int, bool]], str] = {}
    for term in terms:
        term_of_factors.setdefault(canonical_factors(term, names, {}), term)
    return tuple(term_of_factors.values())

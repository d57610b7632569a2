"""Named sets of regressors, expanded for the channels of a model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations, combinations_with_replacement
from typing import Literal, NamedTuple

from residnet.core.errors import ConfigError
from residnet.core.names import FORCE_CHANNELS, VELOCITY_NAMES, WIND_CHANNELS, suggest_name
from residnet.physics.symmetry import (
    canonical_factors,
    get_dof,
    is_active_term,
)
from residnet.physics.terms import Factor, make_polynomial_terms

SetName = Literal["linear", "fossen", "abkowitz", "astern", "wind", "polynomial_1", "polynomial_2"]

# default channels by role. If the model computes forces, thrusters act through these; tau_y is
# missing, because two fixed thrusters produce no sway force
_DRIVE_NAMES = ("n", "tau_x")
_STEER_NAMES = ("delta", "delta_s", "tau_n")


class ChannelRoles(NamedTuple):
    """Roles of the channels of a model in the sets of regressors.

    Attributes:
        dynamic_states: velocities, and the angles that forces depend on; in six degrees of freedom
            the active ones.
        drives: inputs that produce thrust.
        steers: inputs that produce a steering moment.
        unassigned: inputs of unknown role.
        has_wind: whether the model has wind channels.
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
        """Determine the roles from the channel names, or from `drive` and `steer` if given.

        Raises:
            ConfigError: if a channel of `drive` or `steer` does not exist.
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

    def require_assigned(self, subject: str, *, needs_drive: bool = True) -> ChannelRoles:
        """Check that every input has a role, and return the roles.

        Args:
            subject: name of the set in the error message.
            needs_drive: whether a channel must have the role of propulsion.

        Raises:
            ConfigError: if an input has no role, or no channel has the role of propulsion or
                steering.
        """
        if self.unassigned:
            raise ConfigError(
                f"set '{subject}': the role of channel '{self.unassigned[0]}' is unknown; add it to"
                " `drive` or `steer`"
            )
        if not self.steers or (needs_drive and not self.drives):
            required_roles = "thrust and one for steering" if needs_drive else "steering"
            instruction = "them to `drive` and `steer`" if needs_drive else "it to `steer`"
            raise ConfigError(
                f"set '{subject}' needs a channel for {required_roles}; add {instruction}"
            )
        return self


def is_force_channel(name: str) -> bool:
    """Return whether a channel is a force, such as tau_x or the thrust of a thruster."""
    base_name = name.removeprefix("cmd_")
    return name in FORCE_CHANNELS or base_name == "thrust" or base_name.startswith("thrust_")


def _linear_terms(roles: ChannelRoles) -> list[str]:
    # no force on a submerged hull depends on the depth
    states = [name for name in roles.dynamic_states if name != "z"]
    return ["1", *states, *roles.drives, *roles.steers, *roles.unassigned]


def _thrust_terms(drive: str) -> list[str]:
    """Return the term of a force, or the terms of a propeller, whose thrust depends on speed."""
    # a linear K_T(J) gives n|n| and |n| u; the linear term approximates other actuators
    return [drive] if is_force_channel(drive) else [drive, f"{drive}|{drive}|", f"|{drive}| u"]


def _is_revolutions(drive: str) -> bool:
    """Return whether a channel is the revolutions of a propeller, such as n or cmd_n_port."""
    return drive.removeprefix("cmd_").partition("_")[0] == "n"


def _steering_terms(steer: str, drives: Sequence[str]) -> list[str]:
    """Return the term of a moment, or the terms of the lift of a rudder.

    The lift is proportional to the square of the inflow, from the speed and the propellers.
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
"""Coriolis products and quadratic damping of a hull."""
ROLL_TERMS = ("u p", "p|p|", "u|u| phi", "phi^3")
WIND_TERMS = (
    "wind_u", "wind_v", "wind_u wind_mag", "wind_v wind_mag",
    "wind_u wind_v", "wind_u wind_v^2 wind_mag^-1", "wind_v wind_u^2 wind_mag^-1",
)  # fmt: skip
"""Wind loads, quadratic in the relative wind, with the first three harmonics of its direction."""


def _fossen_terms(roles: ChannelRoles) -> list[str]:
    """Return the terms of the manoeuvring model of Fossen.

    The terms are Coriolis products, linear and quadratic damping (Jervan 2020, eq. (2.4),
    Woo et al. 2018, eqs. (7)-(9)). A model with roll also has roll damping, the effect of speed on
    damping and restoring, and nonlinear restoring (Gouletas 2020).
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
"""Components of the vertical unit vector in the body frame, for weight and buoyancy."""


def submerged_terms(roles: ChannelRoles) -> list[str]:
    """Return the terms of every axis of a vessel in six degrees of freedom.

    The terms are linear and quadratic damping, all products of two velocities (Coriolis forces of
    mass and added mass, lift), weight and buoyancy (Fossen 2021, sections 6.3, 6.4 and 4.1),
    forces, thrust and torque of propellers, and lift and drag of fins.
    """
    velocities = [name for name in roles.dynamic_states if name not in ("z", "phi", "theta")]
    velocity_products = [" ".join(pair) for pair in combinations(velocities, 2)]
    squared_rates = [f"{name}^2" for name in velocities if name in ("p", "q", "r")]
    thrusters = (*roles.drives, *roles.unassigned)
    thrust_terms = [
        term
        for thruster in thrusters
        # revolutions of a propeller have no linear term: its thrust is quadratic
        for term in _thrust_terms(thruster)[
            0 if is_force_channel(thruster) or not _is_revolutions(thruster) else 1 :
        ]
    ]
    # without a measured speed, the speed is assumed constant
    speed_factor = "u^2 " if "u" in velocities else ""
    fin_terms = [
        f"{speed_factor}{fin}{exponent}" for fin in roles.steers for exponent in ("", "^2")
    ]
    damping_terms = [f"{name}|{name}|" for name in velocities]
    # without roll the restoring force is the pitch term; along heave cos(theta) is nearly constant
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
    """Return the terms of a third-order Taylor series about straight-ahead motion (Abkowitz).

    On a symmetric hull even products act in surge, odd ones in sway and yaw. Logs of model tests at
    constant revolutions need no channel of thrust, which is part of the constant.
    """
    steers = roles.require_assigned("abkowitz", needs_drive=False).steers
    lateral_channels = ["v", "r", *steers]
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
    """Return the terms by which the thrust of astern and ahead revolutions differs.

    The terms of the other sets are odd in the revolutions.
    """
    propellers = [name for name in roles.drives if name not in FORCE_CHANNELS]
    if not propellers:
        raise ConfigError(
            "set 'astern' needs a propeller among the channels for thrust; add it to `drive`"
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
    """Return the terms of all sets in order.

    Raises:
        ConfigError: if a channel that a set needs is missing.
    """
    return tuple(term for name in set_names for term in _TERM_SETS[name](roles))


def drop_equivalent_terms(terms: Sequence[str], names: Sequence[str]) -> tuple[str, ...]:
    """Return the terms without those that equal a preceding term, such as `v u` after `u v`."""
    term_of_factors: dict[frozenset[tuple[Factor, int, bool]], str] = {}
    for term in terms:
        term_of_factors.setdefault(canonical_factors(term, names, {}), term)
    return tuple(term_of_factors.values())


def active_terms(
    terms_by_axis: Sequence[Sequence[str]], names: Sequence[str]
) -> list[tuple[str, ...]]:
    """Return the terms per dynamic state without terms that are identically zero.

    States without terms are inactive velocities, angles, whose rates are kinematic, and states
    beyond the axes of `terms_by_axis`.
    """
    dof = get_dof(names)
    all_axes = [*terms_by_axis, *[()] * (dof.n_dynamic - len(terms_by_axis))]
    return [
        tuple(term for term in axis_terms if is_active_term(term, names))
        if axis in dof.active_velocity_indices
        else ()
        for axis, axis_terms in enumerate(all_axes)
    ]

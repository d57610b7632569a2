"""Basis functions of force models.

Source: Jervan 2020, eqs. (4.8)-(4.12).
"""

from __future__ import annotations

from collections.abc import Sequence

from residnet.core.errors import ConfigError
from residnet.core.names import ACCELERATION_NAMES, VELOCITY_NAMES
from residnet.physics.terms import parse_term

MOTION_CHANNELS = (*ACCELERATION_NAMES, *VELOCITY_NAMES)
"""Channels of a force model: u_dot, v_dot, r_dot, u, v, r."""
_CROSS_TERMS = (
    "u v",
    "u r",
    "v r",
    "|u|v",
    "|u|r",
    "|v|u",
    "|v|r",
    "|r|u",
    "|r|v",
    "|u||v|",
    "|u||r|",
    "|v||r|",
)
FERRY_TERMS: tuple[str, ...] = (
    *MOTION_CHANNELS,
    *(f"{name}|{name}|" for name in VELOCITY_NAMES),
    *(f"{name}^3" for name in VELOCITY_NAMES),
    *(f"|{name}|" for name in VELOCITY_NAMES),
    *(f"{name}^2" for name in VELOCITY_NAMES),
    *_CROSS_TERMS,
)
"""The 30 basis functions of Jervan 2020, eqs. (4.10)-(4.12)."""


def term_order(term: str) -> int:
    """Return the order of a basis function, its number of factors.

    The order is beta in Jervan 2020, section 4.3.4.
    """
    return max(sum(abs(factor.power) for factor in parse_term(term, MOTION_CHANNELS)), 1)


def find_acceleration_terms(
    terms: Sequence[str], names: Sequence[str] = MOTION_CHANNELS
) -> dict[int, int]:
    """Return the axis of each term that is an acceleration, by the index of the term.

    The other terms do not depend on accelerations.

    Raises:
        ConfigError: if a term is not affine in nu_dot with a constant factor.
    """
    axis_of_term: dict[int, int] = {}
    for j, term in enumerate(terms):
        factors = parse_term(term, names)
        acceleration_factors = [factor for factor in factors if factor.name in ACCELERATION_NAMES]
        if not acceleration_factors:
            continue
        if (
            len(factors) > 1
            or acceleration_factors[0].magnitude
            or acceleration_factors[0].power != 1
            or acceleration_factors[0].function
        ):
            raise ConfigError(
                f"term '{term}': in force space an acceleration may only be a term by itself"
                " (u_dot, v_dot, r_dot); change the term"
            )
        axis_of_term[j] = ACCELERATION_NAMES.index(acceleration_factors[0].name)
    return axis_of_term


def require_inertia_matrix(*, has_inertia_matrix: bool) -> None:
    """Check that the baseline of a head in force space has an inertia matrix.

    Raises:
        ConfigError: if it has none.
    """
    if not has_inertia_matrix:
        raise ConfigError(
            "space: force needs a baseline with a mass matrix; set its kind to 'believed'"
        )

"""Port/starboard symmetry: mirror images of channels and terms."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import final

from residnet.core.errors import ConfigError
from residnet.core.layout import SURGE_SWAY_YAW, DegreesOfFreedom
from residnet.core.names import get_pair_parity, port_starboard_pairs
from residnet.physics.terms import EVEN_FUNCTIONS, Factor, parse_term

# mirroring at the centre plane changes the sign of motions and forces to the side, and of roll and
# yaw
_CHANNEL_PARITY = dict.fromkeys(
    ("v", "r", "p", "phi", "delta", "fin", "tau_y", "tau_n", "wind_v"), -1
) | dict.fromkeys(("u", "w", "q", "z", "theta", "n", "delta_s", "tau_x", "wind_u", "wind_mag"), 1)
_CHANNEL_PARITY |= {f"{name}_dot": _CHANNEL_PARITY[name] for name in ("u", "v", "w", "p", "q", "r")}


@final
class ChannelNames(tuple[str, ...]):
    """Tuple of channel names with port/starboard pairs and degrees of freedom.

    Attributes:
        partners: partner of each paired channel, declared or by the suffixes `_port` and `_stbd`.
        dof: degrees of freedom; inactive velocities are zero.
    """

    partners: Mapping[str, str]
    dof: DegreesOfFreedom

    def __new__(
        cls,
        names: Iterable[str],
        pairs: Iterable[tuple[str, str]] = (),
        dof: DegreesOfFreedom = SURGE_SWAY_YAW,
    ) -> ChannelNames:
        """Create the tuple from names, declared pairs and degrees of freedom."""
        channel_names = super().__new__(cls, names)
        all_pairs = [*pairs, *port_starboard_pairs(channel_names).items()]
        channel_names.partners = {
            **dict(all_pairs),
            **{starboard: port for port, starboard in all_pairs},
        }
        channel_names.dof = dof
        return channel_names


def get_partners(names: Sequence[str]) -> Mapping[str, str]:
    """Return the partner of each channel that belongs to a port/starboard pair."""
    return (names if isinstance(names, ChannelNames) else ChannelNames(names)).partners


def get_dof(names: Sequence[str]) -> DegreesOfFreedom:
    """Return the degrees of freedom of channels; surge, sway and yaw by default."""
    return names.dof if isinstance(names, ChannelNames) else SURGE_SWAY_YAW


def active_channels(names: Sequence[str]) -> tuple[str, ...]:
    """Return the channels without inactive velocities."""
    unused = get_dof(names).unmodelled_states
    return tuple(name for name in names if name not in unused)


def is_active_term(term: str, names: Sequence[str]) -> bool:
    """Return whether a term contains no inactive velocity."""
    unused = get_dof(names).unmodelled_states
    return not unused or all(factor.name not in unused for factor in parse_term(term, names))


def get_channel_parity(name: str) -> int | None:
    """Return the parity of a channel: its sign in the mirror image, +1 or -1.

    The result is None if the parity is unknown, for example of a user-defined channel.
    """
    return _CHANNEL_PARITY.get(name)


def find_heeling_propellers(names: Sequence[str]) -> tuple[str, ...]:
    """Return the single propellers among the channels of a vessel with roll.

    The torque of a single propeller heels the vessel to one side, which breaks the symmetry.
    """
    single_propellers = [
        name for name in ("n", "cmd_n") if name in names and name not in get_partners(names)
    ]
    return tuple(single_propellers) if get_dof(names).has_roll else ()


def _product_parity(factors: Iterable[Factor], parities: Mapping[str, float]) -> int:
    """Return the sign of the mirror image of a product, from the parities of its channels."""
    sign = 1
    for factor in factors:
        # even factors have the same value in the mirror image
        is_even = factor.magnitude or factor.function in EVEN_FUNCTIONS or factor.power % 2 == 0
        if parities[factor.name] < 0 and not is_even:
            sign = -sign
    return sign


def compute_term_parity(term: str, names: Sequence[str]) -> int | None:
    """Return the parity of a term; None if the parity of a channel is unknown."""
    factors = parse_term(term, names)
    has_known_parity = all(factor.name in _CHANNEL_PARITY for factor in factors)
    return _product_parity(factors, _CHANNEL_PARITY) if has_known_parity else None


def violates_symmetry(term: str, axis: int, names: Sequence[str]) -> bool:
    """Return whether a term of an acceleration violates port/starboard symmetry.

    Args:
        term: name of the term.
        axis: index among the dynamic states: 0 surge, 1 sway, 2 yaw. In roll, terms of a single
            propeller are allowed.
        names: channels of the model.
    """
    if get_dof(names).dynamic_states[axis] == "p":
        heeling_propellers = find_heeling_propellers(names)
        # the propeller torque heels the vessel: symmetry does not exclude these terms in roll
        if any(factor.name in heeling_propellers for factor in parse_term(term, names)):
            return False
    parity = compute_term_parity(term, names)
    return parity is not None and parity != get_axis_parities(names)[axis]


def get_axis_parities(names: Sequence[str]) -> list[int]:
    """Return the parity of each dynamic state, [n]."""
    return [_CHANNEL_PARITY[name] for name in get_dof(names).dynamic_states]


def mirror_channels(names: Sequence[str]) -> tuple[list[int], list[float]] | None:
    """Return the mirror image of channels as source column and sign of each channel.

    Channels of a port/starboard pair are exchanged. The result is None if the parity of a channel
    is unknown, or a single propeller heels the vessel.
    """
    if find_heeling_propellers(names):
        return None
    partners = get_partners(names)
    index = [names.index(partners.get(name, name)) for name in names]
    signs = [
        get_pair_parity(name) if name in partners else get_channel_parity(name) for name in names
    ]
    known_signs = [float(sign) for sign in signs if sign is not None]
    return (index, known_signs) if len(known_signs) == len(names) else None


def require_mirror_image(names: Sequence[str]) -> tuple[list[int], list[float]]:
    """Return the mirror image of channels as source column and sign of each channel.

    Raises:
        ConfigError: if the image of a channel is unknown.
    """
    mirror = mirror_channels(names)
    if mirror is None:
        raise ConfigError(
            f"mirror: the mirror image of some of the channels {', '.join(names)} is unknown"
            " (the torque of a single propeller heels a vessel with roll); remove `mirror`"
        )
    return mirror


def mirror_terms(terms: Sequence[str], names: Sequence[str]) -> dict[int, tuple[int, int]] | None:
    """Return index and sign of the mirror image of each term, by the index of the term.

    Terms whose image is not in the list are omitted. The result is None if the parity of a channel
    is unknown.
    """
    mirror = mirror_channels(names)
    if mirror is None:
        return None
    index, signs = mirror
    renamed = {name: names[i] for name, i in zip(names, index, strict=True)}
    parities = dict(zip(names, signs, strict=True))
    # `u v` and `v u` are one term: compare canonical forms
    index_of_factors = {
        canonical_factors(term, names, {}): term_index for term_index, term in enumerate(terms)
    }
    mirror_images = {}
    for term_index, term in enumerate(terms):
        mirror_index = index_of_factors.get(canonical_factors(term, names, renamed))
        if mirror_index is not None:
            mirror_images[term_index] = (
                mirror_index,
                _product_parity(parse_term(term, names), parities),
            )
    return mirror_images


def canonical_factors(
    term: str, names: Sequence[str], renamed: Mapping[str, str]
) -> frozenset[tuple[Factor, int, bool]]:
    """Return a canonical form of a term, which is equal for `v u` and `u v`.

    The form is a set of (factor without power and magnitude, total power, whether the product is
    odd in the factor).

    Args:
        term: the term.
        names: channels of the model.
        renamed: channels that are replaced by others, such as their port/starboard partners.
    """
    total_power: dict[Factor, int] = {}
    is_odd: dict[Factor, bool] = {}
    for factor in parse_term(term, names):
        name = renamed.get(factor.name, factor.name)
        base_factor = factor._replace(name=name, power=1, magnitude=False)
        total_power[base_factor] = total_power.get(base_factor, 0) + factor.power
        # |x| x is odd although its total power is even, so that parity and power are counted
        # separately
        is_odd[base_factor] = is_odd.get(base_factor, False) ^ (
            not factor.magnitude and factor.power % 2 != 0
        )
    return frozenset(
        (base_factor, total_power[base_factor], is_odd[base_factor]) for base_factor in total_power
    )


def acts_along_own_velocity(term: str, axis: int, names: Sequence[str]) -> bool:
    """Return whether a term always has the sign of the velocity of its axis.

    Such a term is negative damping in any state if its coefficient is positive. Examples are `u`
    and `u|u|` in surge, `v|r|` in sway and `|n| r` in yaw, but not `u v` in sway, whose sign
    depends on the speed.

    Args:
        term: name of the term.
        axis: index among the dynamic states: 0 surge, 1 sway, 2 yaw.
        names: channels of the model.
    """
    factors = canonical_factors(term, names, {})
    odd_channels = {base_factor.name for base_factor, _, is_odd in factors if is_odd}
    return odd_channels == {get_dof(names).dynamic_states[axis]} and not any(
        base_factor.function for base_factor, _, _ in factors
    )

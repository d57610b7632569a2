"""Port/starboard symmetry: how channels and terms change when all is mirrored."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import final

from residnet.core.layout import SURGE_SWAY_YAW, DegreesOfFreedom
from residnet.core.names import port_starboard_pairs
from residnet.physics.terms import EVEN_FUNCTIONS, Factor, parse_term

_CHANNEL_PARITY = dict.fromkeys(
    ("v", "r", "p", "phi", "delta", "tau_y", "tau_n", "wind_v"), -1
) | dict.fromkeys(("u", "w", "q", "z", "theta", "n", "delta_s", "tau_x", "wind_u", "wind_mag"), 1)
_CHANNEL_PARITY |= {f"{name}_dot": _CHANNEL_PARITY[name] for name in ("u", "v", "w", "p", "q", "r")}
_ANGLE_PREFIXES = ("delta", "rudder", "azimuth")


@final
class ChannelNames(tuple[str, ...]):
    """Names of channels, a tuple; `partners` says which change places, as declared or by ending.

    A channel that ends in `_port` has the one that ends in `_stbd` for its partner. `dof` says
    which velocities among them live; the others are zero.
    """

    partners: Mapping[str, str]
    dof: DegreesOfFreedom

    def __new__(
        cls,
        names: Iterable[str],
        pairs: Iterable[tuple[str, str]] = (),
        dof: DegreesOfFreedom = SURGE_SWAY_YAW,
    ) -> ChannelNames:
        """From the names, the pairs that are declared, and the velocities that live."""
        channel_names = super().__new__(cls, names)
        all_pairs = [*pairs, *port_starboard_pairs(channel_names).items()]
        channel_names.partners = {
            **dict(all_pairs),
            **{starboard: port for port, starboard in all_pairs},
        }
        channel_names.dof = dof
        return channel_names


def get_partners(names: Sequence[str]) -> Mapping[str, str]:
    """Return the partner on the other side of each channel that has one."""
    return (names if isinstance(names, ChannelNames) else ChannelNames(names)).partners


def get_dof(names: Sequence[str]) -> DegreesOfFreedom:
    """Return which velocities live among channels; all where nobody said."""
    return names.dof if isinstance(names, ChannelNames) else SURGE_SWAY_YAW


def active_channels(names: Sequence[str]) -> tuple[str, ...]:
    """Return the channels without those that drive nothing."""
    unused = get_dof(names).unmodelled_states
    return tuple(name for name in names if name not in unused)


def is_active_term(term: str, names: Sequence[str]) -> bool:
    """Return whether a product of channels holds none that drives nothing."""
    unused = get_dof(names).unmodelled_states
    return not unused or all(factor.name not in unused for factor in parse_term(term, names))


def get_channel_parity(name: str) -> int | None:
    """Return +1 where a channel keeps its sign in the mirror, -1 where it changes it, else None.

    None means that the channel's parity is not known.
    """
    return _CHANNEL_PARITY.get(name)


def get_pair_parity(name: str) -> int:
    """Return the sign that a channel of a pair changes places with: -1 for an angle, else +1."""
    return -1 if name.removeprefix("cmd_").startswith(_ANGLE_PREFIXES) else 1


def find_heeling_propellers(names: Sequence[str]) -> tuple[str, ...]:
    """Return the lone propellers among channels of a vessel that rolls.

    Their torque heels it to one side, whichever way it is looked at.
    """
    single_propellers = [
        name for name in ("n", "cmd_n") if name in names and name not in get_partners(names)
    ]
    return tuple(single_propellers) if get_dof(names).has_roll else ()


def _product_parity(factors: Iterable[Factor], parities: Mapping[str, float]) -> int:
    """Return the sign that a product changes by where its channels change theirs."""
    sign = 1
    for factor in factors:
        is_even = factor.magnitude or factor.function in EVEN_FUNCTIONS or factor.power % 2 == 0
        if parities[factor.name] < 0 and not is_even:
            sign = -sign
    return sign


def compute_term_parity(term: str, names: Sequence[str]) -> int | None:
    """Return the parity of a product of channels; None where a channel's is not known."""
    factors = parse_term(term, names)
    has_known_parity = all(factor.name in _CHANNEL_PARITY for factor in factors)
    return _product_parity(factors, _CHANNEL_PARITY) if has_known_parity else None


def violates_symmetry(term: str, axis: int, names: Sequence[str]) -> bool:
    """Return whether a mirror-symmetric vessel cannot have this term in an axis' acceleration.

    The axes are those of what moves (`Live.moving`): 0 surge, 1 sway, 2 yaw. A roll may have any
    term of a lone propeller.
    """
    if get_dof(names).dynamic_states[axis] == "p":
        heeling_propellers = find_heeling_propellers(names)
        if any(factor.name in heeling_propellers for factor in parse_term(term, names)):
            return False
    parity = compute_term_parity(term, names)
    return parity is not None and parity != get_axis_parities(names)[axis]


def get_axis_parities(names: Sequence[str]) -> list[int]:
    """Return the sign that each of what moves among channels changes by in the mirror, [n]."""
    return [_CHANNEL_PARITY[name] for name in get_dof(names).dynamic_states]


def mirror_channels(names: Sequence[str]) -> tuple[list[int], list[float]] | None:
    """Return how channels look in the mirror: the column that each is taken from, and the sign.

    The result is None where the parity of one is not known, or a propeller heels the vessel.
    Channels of a port/starboard pair change places.
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


def mirror_terms(terms: Sequence[str], names: Sequence[str]) -> dict[int, tuple[int, int]] | None:
    """Return the place and the sign of each term's mirror image, by the place of the term.

    Terms whose image is not among them are left out; None where a channel's parity is not known.
    """
    mirror = mirror_channels(names)
    if mirror is None:
        return None
    index, signs = mirror
    renamed = {name: names[i] for name, i in zip(names, index, strict=True)}
    parities = dict(zip(names, signs, strict=True))
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
    """Return what a term multiplies, its channels renamed; the same for `v u` and `u v`.

    Each thing stands without its power or magnitude, with its whole power, and with whether the
    product changes sign with it.
    """
    total_power: dict[Factor, int] = {}
    is_odd: dict[Factor, bool] = {}
    for factor in parse_term(term, names):
        name = renamed.get(factor.name, factor.name)
        base_factor = factor._replace(name=name, power=1, magnitude=False)
        total_power[base_factor] = total_power.get(base_factor, 0) + factor.power
        is_odd[base_factor] = is_odd.get(base_factor, False) ^ (
            not factor.magnitude and factor.power % 2 != 0
        )
    return frozenset(
        (base_factor, total_power[base_factor], is_odd[base_factor]) for base_factor in total_power
    )


def acts_along_own_velocity(term: str, axis: int, names: Sequence[str]) -> bool:
    """Return whether a term acts along its axis' own velocity, whatever the other channels are.

    Its power is then of one sign: with a positive coefficient it feeds energy at any state. Such
    are `u` and `u|u|` in surge, `v|r|` in sway, `|n| r` in yaw, and not `u v` in sway, whose sign
    goes with the speed.

    Args:
        axis: of what moves (`Live.moving`): 0 surge, 1 sway, 2 yaw.
    """
    factors = canonical_factors(term, names, {})
    odd_channels = {base_factor.name for base_factor, _, is_odd in factors if is_odd}
    return odd_channels == {get_dof(names).dynamic_states[axis]} and not any(
        base_factor.function for base_factor, _, _ in factors
    )

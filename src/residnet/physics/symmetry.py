"""Port/starboard symmetry: how channels and terms change when all is mirrored."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import final

from residnet.core.layout import ALIVE, Live
from residnet.core.names import sides
from residnet.physics.terms import EVEN_FUNCTIONS, Factor, parse_term

_PARITY = dict.fromkeys(
    ("v", "r", "p", "phi", "delta", "tau_y", "tau_n", "wind_v"), -1
) | dict.fromkeys(("u", "w", "q", "z", "theta", "n", "delta_s", "tau_x", "wind_u", "wind_mag"), 1)
_PARITY |= {f"{name}_dot": _PARITY[name] for name in ("u", "v", "w", "p", "q", "r")}
_ANGLES = ("delta", "rudder", "azimuth")


@final
class ChannelNames(tuple[str, ...]):
    """Names of channels, a tuple; `partners` says which change places, as declared or by ending.

    A channel that ends in `_port` has the one that ends in `_stbd` for its partner. `live` says
    which velocities among them live; the others are zero.
    """

    partners: Mapping[str, str]
    live: Live

    def __new__(
        cls, names: Iterable[str], pairs: Iterable[tuple[str, str]] = (), live: Live = ALIVE
    ) -> ChannelNames:
        """From the names, the pairs that are declared, and the velocities that live."""
        made = super().__new__(cls, names)
        both = [*pairs, *sides(made).items()]
        made.partners = {**dict(both), **{b: a for a, b in both}}
        made.live = live
        return made


def partners_of(names: Sequence[str]) -> Mapping[str, str]:
    """Return the partner on the other side of each channel that has one."""
    return (names if isinstance(names, ChannelNames) else ChannelNames(names)).partners


def live_of(names: Sequence[str]) -> Live:
    """Return which velocities live among channels; all where nobody said."""
    return names.live if isinstance(names, ChannelNames) else ALIVE


def without_dead(names: Sequence[str]) -> tuple[str, ...]:
    """Return the channels without those that drive nothing."""
    dead = live_of(names).hidden
    return tuple(name for name in names if name not in dead)


def living(term: str, names: Sequence[str]) -> bool:
    """Return whether a product of channels holds none that drives nothing."""
    dead = live_of(names).hidden
    return not dead or all(factor.name not in dead for factor in parse_term(term, names))


def channel_parity(name: str) -> int | None:
    """Return +1 where a channel keeps its sign in the mirror, -1 where it changes it, else None.

    None means that the channel's parity is not known.
    """
    return _PARITY.get(name)


def pair_parity(name: str) -> int:
    """Return the sign that a channel of a pair changes places with: -1 for an angle, else +1."""
    return -1 if name.removeprefix("cmd_").startswith(_ANGLES) else 1


def heeling(names: Sequence[str]) -> tuple[str, ...]:
    """Return the lone propellers among channels of a vessel that rolls.

    Their torque heels it to one side, whichever way it is looked at.
    """
    lone = [name for name in ("n", "cmd_n") if name in names and name not in partners_of(names)]
    return tuple(lone) if live_of(names).rolls else ()


def _parity(factors: Iterable[Factor], parities: Mapping[str, float]) -> int:
    """Return the sign that a product changes by where its channels change theirs."""
    sign = 1
    for factor in factors:
        even = factor.magnitude or factor.function in EVEN_FUNCTIONS or factor.power % 2 == 0
        if parities[factor.name] < 0 and not even:
            sign = -sign
    return sign


def term_parity(term: str, names: Sequence[str]) -> int | None:
    """Return the parity of a product of channels; None where a channel's is not known."""
    factors = parse_term(term, names)
    known = all(factor.name in _PARITY for factor in factors)
    return _parity(factors, _PARITY) if known else None


def wrong_parity(term: str, axis: int, names: Sequence[str]) -> bool:
    """Return whether a mirror-symmetric vessel cannot have this term in an axis' acceleration.

    The axes are those of what moves (`Live.moving`): 0 surge, 1 sway, 2 yaw. A roll may have any
    term of a lone propeller.
    """
    if live_of(names).moving[axis] == "p":
        torque = heeling(names)
        if any(factor.name in torque for factor in parse_term(term, names)):
            return False
    parity = term_parity(term, names)
    return parity is not None and parity != axis_parities(names)[axis]


def axis_parities(names: Sequence[str]) -> list[int]:
    """Return the sign that each of what moves among channels changes by in the mirror, [n]."""
    return [_PARITY[name] for name in live_of(names).moving]


def mirrored_channels(names: Sequence[str]) -> tuple[list[int], list[float]] | None:
    """Return how channels look in the mirror: the column that each is taken from, and the sign.

    The result is None where the parity of one is not known, or a propeller heels the vessel.
    Channels of a port/starboard pair change places.
    """
    if heeling(names):
        return None
    partners = partners_of(names)
    index = [names.index(partners.get(name, name)) for name in names]
    signs = [pair_parity(name) if name in partners else channel_parity(name) for name in names]
    known = [float(sign) for sign in signs if sign is not None]
    return (index, known) if len(known) == len(names) else None


def mirrored_terms(terms: Sequence[str], names: Sequence[str]) -> dict[int, tuple[int, int]] | None:
    """Return the place and the sign of each term's mirror image, by the place of the term.

    Terms whose image is not among them are left out; None where a channel's parity is not known.
    """
    mirror = mirrored_channels(names)
    if mirror is None:
        return None
    index, signs = mirror
    renamed = {name: names[i] for name, i in zip(names, index, strict=True)}
    parities = dict(zip(names, signs, strict=True))
    meanings = {meaning(term, names, {}): place for place, term in enumerate(terms)}
    out = {}
    for place, term in enumerate(terms):
        found = meanings.get(meaning(term, names, renamed))
        if found is not None:
            out[place] = (found, _parity(parse_term(term, names), parities))
    return out


def meaning(
    term: str, names: Sequence[str], renamed: Mapping[str, str]
) -> frozenset[tuple[Factor, int, bool]]:
    """Return what a term multiplies, its channels renamed; the same for `v u` and `u v`.

    Each thing stands without its power or magnitude, with its whole power, and with whether the
    product changes sign with it.
    """
    power: dict[Factor, int] = {}
    odd: dict[Factor, bool] = {}
    for factor in parse_term(term, names):
        name = renamed.get(factor.name, factor.name)
        thing = factor._replace(name=name, power=1, magnitude=False)
        power[thing] = power.get(thing, 0) + factor.power
        odd[thing] = odd.get(thing, False) ^ (not factor.magnitude and factor.power % 2 != 0)
    return frozenset((thing, power[thing], odd[thing]) for thing in power)


def dissipates(term: str, axis: int, names: Sequence[str]) -> bool:
    """Return whether a term acts along its axis' own velocity, whatever the other channels are.

    Its power is then of one sign: with a positive coefficient it feeds energy at any state. Such
    are `u` and `u|u|` in surge, `v|r|` in sway, `|n| r` in yaw, and not `u v` in sway, whose sign
    goes with the speed.

    Args:
        axis: of what moves (`Live.moving`): 0 surge, 1 sway, 2 yaw.
    """
    parts = meaning(term, names, {})
    odd = {thing.name for thing, _, changes in parts if changes}
    return odd == {live_of(names).moving[axis]} and not any(thing.function for thing, _, _ in parts)

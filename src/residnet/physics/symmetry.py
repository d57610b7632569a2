"""Port/starboard symmetry: how channels and terms change when all is mirrored."""

from __future__ import annotations

from collections.abc import Sequence

from residnet.core.names import VELOCITY
from residnet.physics.terms import EVEN_FUNCTIONS, parse_term

_ODD = ("v", "r", "delta", "tau_y", "tau_n", "wind_v")
_EVEN = ("u", "n", "tau_x", "wind_u", "wind_mag")
_OTHER_SIDE = {"port": "stbd", "stbd": "port"}


def channel_parity(name: str) -> int | None:
    """Return +1 where a channel keeps its sign in the mirror, -1 where it changes it, else None.

    None means that the channel's parity is not known.
    """
    return -1 if name in _ODD else 1 if name in _EVEN else None


def term_parity(term: str, names: Sequence[str]) -> int | None:
    """Return the parity of a product of channels; None where a channel's is not known."""
    parity = 1
    for factor in parse_term(term, names):
        factor_parity = channel_parity(factor.name)
        if factor_parity is None:
            return None
        if (
            factor_parity < 0
            and not factor.magnitude
            and factor.function not in EVEN_FUNCTIONS
            and factor.power % 2 == 1
        ):
            parity = -parity
    return parity


def wrong_parity(term: str, axis: int, names: Sequence[str]) -> bool:
    """Return whether a mirror-symmetric vessel cannot have this term in an axis' acceleration.

    The axes are 0 surge, 1 sway, 2 yaw.
    """
    parity = term_parity(term, names)
    return parity is not None and parity != (1 if VELOCITY[axis] == "u" else -1)


def mirrored_channels(names: Sequence[str]) -> tuple[list[int], list[float]] | None:
    """Return how channels look in the mirror: the column that each is taken from, and the sign.

    The result is None where the parity of one is not known.

    Channels of a port/starboard pair change places.
    """
    index, sign = [], []
    for place, name in enumerate(names):
        other = _OTHER_SIDE.get(name.rpartition("_")[2])
        partner = f"{name.rpartition('_')[0]}_{other}" if other else name
        parity = 1 if other else channel_parity(name)
        if partner not in names or parity is None:
            return None
        index.append(names.index(partner) if other else place)
        sign.append(float(parity))
    return index, sign

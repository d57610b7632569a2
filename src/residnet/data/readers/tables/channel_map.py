"""How a foreign channel becomes one of a log: unit, sign and frame, converted once."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from residnet.core.config import Config
from residnet.core.errors import UsageError
from residnet.core.names import CHANNEL_UNITS, to_si
from residnet.data.readers.base import unwrap

Frame = Literal["as_measured", "ned", "enu", "body_fsd", "body_fpu"]

_SAME = (1.0, 0.0)
_FLIP = (-1.0, 0.0)
_FROM_EAST = (-1.0, math.pi / 2.0)
_EARTH = ("x", "y", "psi", "wind_dir", "current_north", "current_east")
_FORWARD = ("u", "p", "phi", "u_dot", "tau_x")
_SIDEWAYS_OR_DOWN = ("v", "r", "v_dot", "r_dot", "tau_y", "tau_n")
# frame -> channel -> (factor, offset [SI]) that brings the channel to residnet's frame.
# x and y have no entry in enu: "x" there means east to some and the north column to others, so the
# map must name the north column itself.
_FRAMES: dict[str, dict[str, tuple[float, float]]] = {
    "ned": dict.fromkeys(_EARTH, _SAME),
    "enu": {"psi": _FROM_EAST, "wind_dir": _FROM_EAST},
    "body_fsd": dict.fromkeys((*_FORWARD, *_SIDEWAYS_OR_DOWN), _SAME),
    "body_fpu": {**dict.fromkeys(_FORWARD, _SAME), **dict.fromkeys(_SIDEWAYS_OR_DOWN, _FLIP)},
}


class Conversion(Config):
    """Unit, sign and frame of one foreign channel.

    Attributes:
        unit: its unit, for example `deg/s`.
        sign: -1 turns it around before anything else.
        frame: `as_measured` (nothing to convert), `ned`, `body_fsd` (forward, starboard, down),
            `enu` (angles counter-clockwise from east) or `body_fpu` (forward, port, up).
    """

    unit: str
    sign: Literal[1, -1] = 1
    frame: Frame = "as_measured"

    def require_fit(self, name: str) -> None:
        """Stop where this cannot be the channel `name`.

        Raises:
            ValueError: where the name is no channel's, the unit is unknown or of another dimension,
                or the frame says nothing about the channel.
        """
        if name == "t" or name.startswith("mask:"):
            raise ValueError(f"'{name}' cannot name a channel; time has its own key")
        try:
            factor(self.unit, CHANNEL_UNITS.get(name))
        except ValueError as error:
            raise ValueError(f"channel {name}: {error}") from error
        if self.frame != "as_measured" and name not in _FRAMES[self.frame]:
            fitting = (
                ", ".join(frame for frame, table in _FRAMES.items() if name in table) or "none"
            )
            raise ValueError(
                f"channel {name}: frame '{self.frame}' says nothing about it (frames that do:"
                f" {fitting}); map the column that already holds this quantity, with sign: -1 where"
                " it points the other way"
            )

    def convert(self, name: str, raw: np.ndarray) -> np.ndarray:
        """Return the values [T] of channel `name` in residnet's unit, sign and frame.

        psi unwrapped.
        """
        scale, offset = _FRAMES[self.frame][name] if self.frame != "as_measured" else _SAME
        values = scale * self.sign * to_si(self.unit) * raw + offset
        return unwrap(values) if name == "psi" else values


class ChannelMap(Conversion):
    """One channel of a foreign table.

    Attributes:
        column: name of the column, as the file's header has it.
    """

    column: str


def factor(unit: str, expected: str | None) -> float:
    """Return `to_si` for validators: pydantic adds the key path to a ValueError only."""
    try:
        return to_si(unit, expected)
    except UsageError as error:
        raise ValueError(str(error)) from error

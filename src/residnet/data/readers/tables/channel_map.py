"""How a foreign channel becomes one of a log: unit, sign and frame, converted once."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from residnet.core.config import Config
from residnet.core.errors import UsageError
from residnet.core.names import CHANNEL_UNITS
from residnet.core.units import known_unit, si_unit, to_si
from residnet.data.readers.base import unwrap
from residnet.data.readers.tables.angles import Form, LetterO

Frame = Literal["as_measured", "ned", "enu", "body_fsd", "body_fpu"]

_SAME = (1.0, 0.0)
_FLIP = (-1.0, 0.0)
_FROM_EAST = (-1.0, math.pi / 2.0)
_EARTH = ("x", "y", "psi", "wind_dir", "current_north", "current_east")
QUATERNION = ("qx", "qy", "qz", "qw")
"""Channels of a table that become a heading together, where it has none."""
_FORWARD = ("u", "p", "phi", "u_dot", "tau_x")
_SIDEWAYS_OR_DOWN = ("v", "r", "v_dot", "r_dot", "tau_y", "tau_n")
# frame -> channel -> (factor, offset [SI]) that brings the channel to residnet's frame.
# x and y have no entry in enu: "x" there means east to some and the north column to others, so the
# map must name the north column itself.
_FRAMES: dict[str, dict[str, tuple[float, float]]] = {
    "ned": dict.fromkeys((*_EARTH, "qw"), _SAME),
    # the frame of a quaternion is told at its scalar part
    "enu": {"psi": _FROM_EAST, "wind_dir": _FROM_EAST, "qw": _SAME},
    "body_fsd": dict.fromkeys((*_FORWARD, *_SIDEWAYS_OR_DOWN), _SAME),
    "body_fpu": {**dict.fromkeys(_FORWARD, _SAME), **dict.fromkeys(_SIDEWAYS_OR_DOWN, _FLIP)},
}


class Conversion(Config):
    """Unit, sign and frame of one foreign channel.

    Attributes:
        unit: its unit, for example `deg/s`.
        offset: taken from the column's number first, in the column's own unit: the neutral of a
            servo, for example 1500.
        scale: what the rest is multiplied by to be in `unit`, for example 0.07 where 1000 us more
            are 70 deg more.
        sign: -1 turns it around.
        frame: `as_measured` (nothing to convert), `ned`, `body_fsd` (forward, starboard, down),
            `enu` (angles counter-clockwise from east) or `body_fpu` (forward, port, up).
    """

    unit: str
    offset: float = 0.0
    scale: float = 1.0
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
        if self.scale == 0.0:
            raise ValueError(f"channel {name}: scale must not be zero, all would be the same")
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

    def si(self, name: str) -> str:
        """Return the SI unit of channel `name`."""
        return si_unit(known_unit(self.unit, CHANNEL_UNITS.get(name)))

    def in_si(self, name: str, raw: np.ndarray) -> np.ndarray:
        """Return the size of the values [T] of channel `name` in SI, whatever their frame."""
        gain = to_si(self.unit, CHANNEL_UNITS.get(name)) * self.scale
        size: np.ndarray = np.abs(gain * (raw - self.offset))
        return size

    def convert(self, name: str, raw: np.ndarray) -> np.ndarray:
        """Return the values [T] of channel `name` in residnet's unit, sign and frame.

        psi unwrapped.
        """
        turn, ahead = _FRAMES[self.frame][name] if self.frame != "as_measured" else _SAME
        gain = turn * self.sign * to_si(self.unit, CHANNEL_UNITS.get(name)) * self.scale
        values = gain * (raw - self.offset) + ahead
        return unwrap(values) if name == "psi" else values


class ChannelMap(Conversion):
    """One channel of a foreign table.

    Attributes:
        column: name of the column, as the file's header has it.
        form: of numbers that are angles: `number`, or `ddmm` for degrees and minutes in one, as
            receivers write 5954.321 for 59 degrees and 54.321 minutes. Latitudes and longitudes
            such as `59°54.321'N` or `59 54 19.3 N` are read in either case.
        hemisphere: column with the letters N and S or E and W that belong to the numbers; null
            where there is none.
        letter_o: what the letter O means in longitudes, `east` (Ost, Oost) or `west` (Oeste, Ouest,
            Ovest); null refuses it.
    """

    column: str
    form: Form = "number"
    hemisphere: str | None = None
    letter_o: LetterO | None = None

    @property
    def is_angle(self) -> bool:
        """Whether its cells may be degrees with minutes or letters."""
        return self.form != "number" or self.hemisphere is not None

    def require_fit(self, name: str) -> None:
        """Stop where this cannot be the channel `name`; see `Conversion.require_fit`.

        Raises:
            ValueError: also where degrees with minutes are in another unit.
        """
        super().require_fit(name)
        if self.is_angle and known_unit(self.unit) != "deg":
            raise ValueError(
                f"channel {name}: `form` and `hemisphere` are for degrees; set unit: deg"
            )


def factor(unit: str, expected: str | None) -> float:
    """Return `to_si` for validators: pydantic adds the key path to a ValueError only."""
    try:
        return to_si(unit, expected)
    except UsageError as error:
        raise ValueError(str(error)) from error

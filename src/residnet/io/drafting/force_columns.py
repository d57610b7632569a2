"""Columns of the total forces and the yaw moment on a vessel."""

from __future__ import annotations

import re

from residnet.core.names import CHANNEL_UNITS
from residnet.core.units import si_unit
from residnet.io.header_vocabulary import parse_header_unit, parse_name

_FORCE_AXES = {
    "N": {
        **dict.fromkeys(("u", "x", "surge"), "tau_x"),
        **dict.fromkeys(("v", "y", "sway"), "tau_y"),
    },
    "N m": dict.fromkeys(("r", "n", "z", "yaw", "psi"), "tau_n"),
}
"""SI unit of a force or moment -> last word of a name -> channel."""
_PARTIAL_FORCES = (
    "wind",
    "thrust",
    "propeller",
    "rudder",
    "planes",
    "engine",
    "azimuth",
    "command",
)
"""Concepts of forces that act on a part of the vessel."""


def match_force_column(column: str) -> str | None:
    """Return the channel of a force or moment whose unit is in its header, such as `T_u [N]`."""
    unit = parse_header_unit(column, None)
    parsed_name = parse_name(column)
    is_part = not parsed_name.has_none(*_PARTIAL_FORCES)
    if unit is None or is_part:
        return None
    words = parsed_name.text.split()
    if not words or "_".join(words) in CHANNEL_UNITS:
        # a canonical name such as acting_tau_x has its own channel
        return None
    axis = re.sub(r"^[fmt](?=[xyzuvrn]$)", "", words[-1])
    if words == [axis]:
        # a letter alone may be a load that was measured
        return None
    return _FORCE_AXES.get(si_unit(unit), {}).get(axis)

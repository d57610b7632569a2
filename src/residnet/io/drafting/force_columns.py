"""Columns of the total forces and the yaw moment on a vessel."""

from __future__ import annotations

import re
from collections.abc import Sequence

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
_WRENCH_PATTERN = re.compile(
    r"(?P<stem>(?:.*[\W_])?)(?P<quantity>force|torque|moment)s?[\W_]*(?P<axis>[xyz])"
    r"(?:[\W_]*\[.*\])?",
    re.IGNORECASE,
)
_WRENCH_AXES = {("force", "x"): "tau_x", ("force", "y"): "tau_y", ("moment", "z"): "tau_n"}
_MIN_WRENCH_PARTS = 2
"""Fewest parts by which a force and a moment are those of the vessel, not of one load cell."""


def find_wrench_columns(columns: Sequence[str]) -> dict[str, str]:
    """Return column -> channel of the forces and the moment on a vessel, such as `force.x`.

    Columns of one stem are a wrench. Forces of thrusters, rudders and wind are no total forces.
    """
    groups: dict[str, dict[str, str]] = {}
    for column in columns:
        match = _WRENCH_PATTERN.fullmatch(column.strip())
        if match is None or not parse_name(column).has_none(*_PARTIAL_FORCES):
            continue
        quantity = "force" if match["quantity"].lower() == "force" else "moment"
        channel = _WRENCH_AXES.get((quantity, match["axis"].lower()))
        if channel is not None:
            groups.setdefault(match["stem"].lower(), {}).setdefault(channel, column)
    complete = [group for group in groups.values() if len(group) >= _MIN_WRENCH_PARTS]
    return {column: channel for channel, column in complete[0].items()} if complete else {}


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

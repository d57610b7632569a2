"""Names and SI units of the channels.

All quantities are in SI units with angles in radians; propeller revolutions are in 1/s. Input data
declare their unit once, in the channel map of a log or in a config value such as `"20 deg"`, and
are converted by `residnet.core.units`.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Sequence

from residnet.core.units import si_unit, to_si, unit_names

__all__ = [
    "ACCELERATION_NAMES",
    "BOW_WIND_CHANNELS",
    "CHANNEL_UNITS",
    "POSE_ERROR_UNITS",
    "POSE_NAMES",
    "SET_POINT_CHANNELS",
    "STATE_NAMES",
    "VELOCITY_NAMES",
    "WIND_INPUTS",
    "get_pair_parity",
    "get_si_unit",
    "port_starboard_pairs",
    "require_plain_name",
    "si_unit",
    "suggest_name",
    "to_si",
    "truncate",
    "unit_names",
]

_ANGLE_PREFIXES = ("delta", "rudder", "azimuth")
_COMMENT_DELIMITERS = ("*/", "/*", "//", "\\", '"')


def require_plain_name(name: str) -> str:
    """Check that a name is safe in a comment or a string of an exported program.

    Exports write the names of models and channels into C code, which is compiled and run for
    comparison with the model: a name that ends a comment would be executed.

    Raises:
        ValueError: if a character is not printable, or a comment or text would end there.
    """
    for part in _COMMENT_DELIMITERS:
        if part in name:
            raise ValueError(f"the name {name!r} holds {part!r}; rename it")
    if not name.isprintable():
        raise ValueError(f"the name {name!r} holds a character that is not printable; rename it")
    return name


POSE_NAMES = ("x", "y", "psi")
VELOCITY_NAMES = ("u", "v", "r")
STATE_NAMES = POSE_NAMES + VELOCITY_NAMES
"""State of a 3-DOF model, in the order of the tensors: north [m], east [m], heading [rad], surge
[m/s], sway [m/s], yaw rate [rad/s].
"""

POSE_ERROR_UNITS = {"position": "m", "heading": "rad", "depth": "m", "attitude": "rad"}
"""Errors of the pose at the end of a free run, with their SI units."""

ACCELERATION_NAMES = tuple(f"{name}_dot" for name in VELOCITY_NAMES)

SET_POINT_CHANNELS = ("psi_d",)
"""Set points of a controller: the desired heading (Fossen's psi_d) [rad]. They drive no vessel."""
WIND_INPUTS = ("wind_speed", "wind_dir")
"""Inputs of the true wind: speed [m/s] and the direction it comes FROM [rad], earth-fixed."""
BOW_WIND_CHANNELS = ("wind_angle", "apparent_wind_speed", "apparent_wind_angle")
"""Wind relative to the bow: direction of the true wind, speed and direction of the apparent."""

# SI unit of the standard channels; any other channel has the SI unit that its channel map declares
CHANNEL_UNITS: dict[str, str] = {
    "t": "s",
    "x": "m",
    "y": "m",
    "z": "m",
    "psi": "rad",
    "psi_d": "rad",
    "phi": "rad",
    "theta": "rad",
    "u": "m/s",
    "v": "m/s",
    "r": "rad/s",
    "p": "rad/s",
    "w": "m/s",
    "q": "rad/s",
    "u_dot": "m/s^2",
    "v_dot": "m/s^2",
    "r_dot": "rad/s^2",
    "delta": "rad",
    "delta_s": "rad",
    "n": "1/s",
    "n_port": "1/s",
    "n_stbd": "1/s",
    "cmd_port": "1/s",
    "cmd_stbd": "1/s",
    "cmd_delta": "rad",
    "cmd_delta_s": "rad",
    "fin": "rad",
    "cmd_fin": "rad",
    "cmd_n": "1/s",
    "nozzle": "rad",
    "cmd_nozzle": "rad",
    "cmd_thrust": "N",
    "tau_x": "N",
    "tau_y": "N",
    "tau_n": "N m",
    "acting_tau_x": "N",
    "acting_tau_y": "N",
    "acting_tau_n": "N m",
    "wind_speed": "m/s",
    "wind_dir": "rad",
    "wind_angle": "rad",
    "apparent_wind_speed": "m/s",
    "apparent_wind_angle": "rad",
    "current_north": "m/s",
    "current_east": "m/s",
}
_SI_OF_PREFIX = {
    **{
        r"n(_|$)": "1/s",
        "delta|azimuth|drift_angle": "rad",
        "tau_x|tau_y|thrust": "N",
        "tau_n": "N m",
    },
    "throttle": "-",
}
"""Pattern of the start of a non-standard channel name -> SI unit."""


def get_si_unit(channel: str) -> str | None:
    """Return the SI unit of a channel, guessed from the start of a non-standard name; or None."""
    base_name = channel.removeprefix("cmd_")
    matches = (si for prefix, si in _SI_OF_PREFIX.items() if re.match(prefix, base_name))
    return CHANNEL_UNITS.get(channel) or next(matches, None)


def port_starboard_pairs(names: Iterable[str]) -> dict[str, str]:
    """Return the pairs of channels `<name>_port` -> `<name>_stbd`."""
    known_names = dict.fromkeys(names)
    starboard_names = {
        name: f"{name[:-4]}stbd" for name in known_names if name[:-5] and name.endswith("_port")
    }
    return {port: stbd for port, stbd in starboard_names.items() if stbd in known_names}


def get_pair_parity(name: str) -> int:
    """Return the sign of a paired channel after the exchange: -1 for angles, otherwise +1."""
    return -1 if name.removeprefix("cmd_").startswith(_ANGLE_PREFIXES) else 1


def truncate(text: object, max_length: int = 60) -> str:
    """Return a text for a message, truncated to `max_length` characters."""
    full_text = str(text)
    return full_text if len(full_text) <= max_length else f"{full_text[: max_length - 3]}..."


def suggest_name(name: str, valid: Iterable[str]) -> str:
    """Return `; did you mean 'x'?` for error messages, or the valid names if none is similar."""
    names = sorted({truncate(valid_name) for valid_name in valid})
    close_matches = difflib.get_close_matches(name, names, n=1, cutoff=0.6)
    if close_matches:
        return f"; did you mean '{close_matches[0]}'?"
    return f"; valid: {', '.join(names[:24])}" + (", ..." if len(names) > 24 else "")


def azimuth_thrusters(names: Sequence[str]) -> dict[str, str]:
    """Return the angle channel of each azimuth thruster -> channel of its revolutions or thrust."""
    channel_of_base_name = {channel.removeprefix("cmd_"): channel for channel in names}
    thrust_of_angle = {}
    for angle in (channel for channel in channel_of_base_name if channel.startswith("azimuth")):
        suffix = angle.removeprefix("azimuth")
        thrust_quantity = next(
            (n for n in ("n", "throttle", "thrust") if f"{n}{suffix}" in channel_of_base_name), None
        )
        if thrust_quantity and suffix != "_diff":
            thrust_of_angle[channel_of_base_name[angle]] = channel_of_base_name[
                f"{thrust_quantity}{suffix}"
            ]
    return thrust_of_angle


WIND_CHANNELS = ("wind_u", "wind_v", "wind_mag")
"""Relative wind along the body axes and its magnitude in m/s, computed from `WIND_INPUTS`."""
FORCE_CHANNELS = ("tau_x", "tau_y", "tau_n")

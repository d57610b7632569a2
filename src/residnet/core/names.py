"""Names and units of the channels, and the one table of unit conversions.

Inside residnet everything is SI with angles in radians; propeller revolutions are in 1/s. A channel
that enters declares its unit once (in the log's channel map or in a config value such as `"20
deg"`) and is converted here.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable

from residnet.core.errors import UsageError

POSE = ("x", "y", "psi")
VELOCITY = ("u", "v", "r")
STATE = POSE + VELOCITY
"""State of a 3-DOF model, in the order of the tensors: north [m], east [m], heading [rad], surge
[m/s], sway [m/s], yaw rate [rad/s].
"""

ACCELERATION = tuple(f"{name}_dot" for name in VELOCITY)

# unit -> (SI unit of its dimension, factor to it)
_UNITS: dict[str, tuple[str, float]] = {
    "-": ("-", 1.0),
    "%": ("-", 0.01),
    "m": ("m", 1.0),
    "cm": ("m", 0.01),
    "mm": ("m", 0.001),
    "km": ("m", 1000.0),
    "nmi": ("m", 1852.0),
    "ft": ("m", 0.3048),
    "m^2": ("m^2", 1.0),
    "m^3": ("m^3", 1.0),
    "s": ("s", 1.0),
    "ms": ("s", 1e-3),
    "us": ("s", 1e-6),
    "ns": ("s", 1e-9),
    "min": ("s", 60.0),
    "h": ("s", 3600.0),
    "Hz": ("1/s", 1.0),
    "1/s": ("1/s", 1.0),
    "rps": ("1/s", 1.0),
    "rpm": ("1/s", 1.0 / 60.0),
    "1/s^2": ("1/s^2", 1.0),
    "rpm/s": ("1/s^2", 1.0 / 60.0),
    "m/s": ("m/s", 1.0),
    "kn": ("m/s", 1852.0 / 3600.0),
    "km/h": ("m/s", 1.0 / 3.6),
    "m/s^2": ("m/s^2", 1.0),
    "g": ("m/s^2", 9.80665),
    "rad": ("rad", 1.0),
    "deg": ("rad", math.pi / 180.0),
    "rad/s": ("rad/s", 1.0),
    "deg/s": ("rad/s", math.pi / 180.0),
    "rad/s^2": ("rad/s^2", 1.0),
    "deg/s^2": ("rad/s^2", math.pi / 180.0),
    "N": ("N", 1.0),
    "kN": ("N", 1000.0),
    "N m": ("N m", 1.0),
    "kN m": ("N m", 1000.0),
    "kg": ("kg", 1.0),
    "t": ("kg", 1000.0),
    "kg m": ("kg m", 1.0),
    "kg m^2": ("kg m^2", 1.0),
    "kg/m^3": ("kg/m^3", 1.0),
    "V": ("V", 1.0),
    "A": ("A", 1.0),
    "W": ("W", 1.0),
}

# SI unit of the channels that residnet knows by name; any other channel keeps the SI unit that its
# map declares
CHANNEL_UNITS: dict[str, str] = {
    "t": "s",
    "x": "m",
    "y": "m",
    "psi": "rad",
    "phi": "rad",
    "u": "m/s",
    "v": "m/s",
    "r": "rad/s",
    "p": "rad/s",
    "u_dot": "m/s^2",
    "v_dot": "m/s^2",
    "r_dot": "rad/s^2",
    "delta": "rad",
    "n": "1/s",
    "n_port": "1/s",
    "n_stbd": "1/s",
    "cmd_port": "1/s",
    "cmd_stbd": "1/s",
    "cmd_delta": "rad",
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
    "current_north": "m/s",
    "current_east": "m/s",
}


def units() -> tuple[str, ...]:
    """Return the names of all units that residnet converts."""
    return tuple(_UNITS)


def shown(text: object, most: int = 60) -> str:
    """Return what a message quotes from a file, cut to `most` characters."""
    whole = str(text)
    return whole if len(whole) <= most else f"{whole[: most - 3]}..."


def nearest(name: str, valid: Iterable[str]) -> str:
    """Return `; did you mean 'x'?` for error messages, or the valid names where none is near."""
    names = sorted({shown(other) for other in valid})
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.6)
    if close:
        return f"; did you mean '{close[0]}'?"
    return f"; valid: {', '.join(names[:24])}" + (", ..." if len(names) > 24 else "")


def si_unit(unit: str) -> str:
    """Return the SI unit of the dimension of `unit`.

    Raises:
        UsageError: where the unit is not known.
    """
    if unit not in _UNITS:
        raise UsageError(f"unknown unit '{unit}'{nearest(unit, _UNITS)}")
    return _UNITS[unit][0]


def to_si(unit: str, expected: str | None = None) -> float:
    """Return the factor that converts values in `unit` to SI.

    Args:
        unit: name of a unit, for example `deg/s`.
        expected: SI unit of the dimension that is wanted, for example `rad/s`; None takes any.

    Raises:
        UsageError: where the unit is not known or of another dimension than `expected`.
    """
    si, factor = si_unit(unit), _UNITS[unit][1]
    if expected is not None and si != expected:
        fitting = ", ".join(name for name, (base, _) in _UNITS.items() if base == expected)
        raise UsageError(
            f"unit '{unit}' does not measure [{expected}]; units that do: {fitting or 'none'}"
        )
    return factor

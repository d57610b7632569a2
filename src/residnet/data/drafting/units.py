"""The unit of a column from its header, else from the size of its values."""

from __future__ import annotations

import re
from typing import Any, NamedTuple

import numpy as np

from residnet.core.errors import UsageError
from residnet.core.names import CHANNEL_UNITS
from residnet.core.units import known_unit

_IN_BRACKETS = re.compile(r"[\[({]([^\])}]*)[\])}]")
_FULL = 35.0
"""Angle in deg of a rudder that is hard over, as most are built."""
_GERMAN = {"grad": "deg", "grad/s": "deg/s", "grad/min": "deg/min"}


def written_unit(column: str, expected: str | None) -> str | None:
    """Return the unit that a column's name holds, in brackets or at its end; None for none.

    Args:
        column: its name.
        expected: SI unit of the dimension; None takes any, in brackets only.
    """
    texts = [text.strip() for text in _IN_BRACKETS.findall(column)]
    if expected is not None:
        tail = re.split(r"[\s_,;]+", _IN_BRACKETS.sub("", column).strip())
        # `r_deg_s` and `speed_m_s` are quotients
        texts += ["/".join(tail[-2:]), tail[-1]] if len(tail) > 1 else []
        texts += [f"{tail[-3]}/{tail[-1]}"] if len(tail) > 3 and tail[-2] == "per" else []
    for text in texts:
        unit = _GERMAN.get(text.casefold(), text)
        if len(unit) == 1 and unit.isalpha() and text not in _IN_BRACKETS.findall(column):
            # a letter at the end is rather a name
            continue
        try:
            return known_unit(unit, expected)
        except UsageError:
            continue
    return None


def other_dimension(column: str, expected: str) -> str | None:
    """Return the unit in the brackets of a name where it measures something else; None for none."""
    for text in _IN_BRACKETS.findall(column):
        if expected == "rad" and text in ("T", "M"):
            # a true or a magnetic heading
            continue
        try:
            known_unit(text.strip(), expected)
        except UsageError:
            try:
                return known_unit(text.strip())
            except UsageError:
                continue
    return None


def unit_by_size(channel: str, values: np.ndarray) -> tuple[str, str]:
    """Return the unit of a channel by the size of its values, and why.

    Args:
        channel: canonical name, or a name of one's own.
        values: of the column [T], of all logs together.
    """
    known = np.abs(values[np.isfinite(values)])
    largest = float(np.quantile(known, 0.99)) if known.size else 0.0
    expected = si_of(channel) or "-"
    if expected == "rad":
        limit = 7.0 if channel in ("psi", "wind_dir") or "azimuth" in channel else 1.6
        unit = "deg" if largest > limit else "rad"
    elif expected == "rad/s":
        # a turn round in two seconds
        unit = "deg/s" if largest > np.pi else "rad/s"
    elif expected == "1/s":
        unit = "rpm" if largest > 60.0 else "1/s"
    else:
        unit = expected
    return unit, f"the header has no unit; values up to {largest:.3g} would be {unit}"


class Throw(NamedTuple):
    """How numbers that say how far an actuator is thrown become the values of its channel.

    Attributes:
        settings: unit, offset and scale of a channel map.
        reason: why these are guessed.
    """

    settings: dict[str, Any]
    reason: str


def thrown(channel: str, column: str, values: np.ndarray) -> Throw | None:
    """Return how pulses, per cent or shares become a channel; None where its unit is a plain one.

    Args:
        channel: of an actuator.
        column: its name.
        values: of the column [T], of all logs together.
    """
    rudder = channel.removeprefix("cmd_").startswith("delta")
    if rudder and written_unit(column, "rad") is not None:
        return None
    unit, all_the_way, told = ("deg", _FULL, f", {_FULL:g} deg") if rudder else ("-", 1.0, "")
    if is_pulse(channel, values):
        settings = {"unit": unit, "offset": 1500, "scale": all_the_way / 500.0}
        reason = "pulses of a servo; 1500 us are taken as neutral, 500 us as all the way"
        return Throw(settings, reason + told)
    if not rudder or not (whole := _whole(column, values)):
        return None
    reason = f"{whole:g} is taken as all the way{told}"
    return Throw({"unit": unit, "scale": all_the_way / whole}, reason)


def _whole(column: str, values: np.ndarray) -> float:
    """Return the number that stands for a rudder that is hard over; 0 where it is an angle."""
    written = written_unit(column, "-")
    if written is not None:
        return 100.0 if written == "%" else 1.0
    largest = float(np.abs(values[np.isfinite(values)]).max(initial=0.0))
    if largest > 180.0:
        # no angle of a rudder: counts of a lever, to the power of ten above them
        return float(10.0 ** np.ceil(np.log10(largest)))
    # numbers that end at a round one are rather shares than angles
    return next((whole for whole in (1.0, 100.0) if 0.995 * whole <= largest <= whole), 0.0)


def is_pulse(channel: str, values: np.ndarray) -> bool:
    """Return whether values are pulses of a servo, in us; revolutions may be as large."""
    known = values[np.isfinite(values)]
    if not known.size or re.match(r"(cmd_)?n(_|$)", channel):
        return False
    low, high = np.quantile(known, (0.01, 0.99))
    return bool(low >= 800.0 and high <= 2300.0 and high > 1200.0)


def si_of(channel: str) -> str | None:
    """Return the SI unit of a channel, by its name where residnet does not know it, or None."""
    if channel in CHANNEL_UNITS:
        return CHANNEL_UNITS[channel]
    first = channel.removeprefix("cmd_")
    if re.match(r"n(_|$)", first):
        return "1/s"
    if first.startswith(("delta", "azimuth")):
        return "rad"
    if first.startswith(("tau_x", "tau_y", "thrust")):
        return "N"
    return "N m" if first.startswith("tau_n") else None

"""Format numbers for display: rounding, minus signs, display units."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import NamedTuple

DEGREES_PER_RADIAN = 180.0 / math.pi
"""Degrees per radian."""
DASH = "–"
"""Placeholder for a missing number."""
DISPLAY_UNITS = {"rad": ("deg", DEGREES_PER_RADIAN), "rad/s": ("deg/s", DEGREES_PER_RADIAN)}
"""SI unit -> display unit and the factor from SI."""
_CHANNEL_TITLES = {
    "u": "surge u",
    "v": "sway v",
    "r": "yaw rate r",
    "p": "roll rate p",
    "phi": "roll angle phi",
    "w": "heave w",
    "q": "pitch rate q",
    "z": "depth z",
    "theta": "pitch angle theta",
}
_PLAIN_EXPONENTS = (-4, 6)
"""Range of powers of ten in which a number is written without an exponent."""


class DisplayUnit(NamedTuple):
    """Unit in which a quantity is displayed.

    Attributes:
        name: name of the unit.
        factor: factor from SI to this unit.
    """

    name: str
    factor: float


def display_unit(unit: str) -> DisplayUnit:
    """Return the unit for display, such as deg for rad, and the factor from the SI unit."""
    return DisplayUnit(*DISPLAY_UNITS.get(unit, (unit, 1.0)))


def channel_title(channel: str) -> str:
    """Return the title of a channel, for example `yaw rate r`."""
    return _CHANNEL_TITLES.get(channel, channel)


def format_minus_signs(text: str) -> str:
    """Replace hyphens before numbers by minus signs."""
    return re.sub(r"(?<![\w-])-(?=\d)", "−", text)


_SUPERSCRIPTS = str.maketrans("234", "²³⁴")


def format_exponents(text: str) -> str:
    """Replace exponents such as `m/s^2` by superscripts."""
    exponent_pattern = r"(?<=[^\W\d_]|\))\^([234])(?!\w|\.\d)"
    return re.sub(exponent_pattern, lambda match: match[1].translate(_SUPERSCRIPTS), text)


def format_number(value: float | None, digits: int = 3) -> str:
    """Format a number with significant digits; a missing or non-finite number is a dash.

    Only very small and very large numbers have an exponent.
    """
    if value is None or not math.isfinite(value):
        return DASH
    if value == 0:
        return "0"
    exponent = math.floor(math.log10(abs(value)))
    lower, upper = _PLAIN_EXPONENTS
    if not lower <= exponent < upper:
        return f"{value:.{digits - 1}e}".replace("-", "−")
    return f"{value:.{max(digits - 1 - exponent, 0)}f}".replace("-", "−")


def format_fixed(value: float | None, decimals: int) -> str:
    """Format a number with fixed decimals; a missing or non-finite number is a dash."""
    if value is None or not math.isfinite(value):
        return DASH
    return f"{value:.{decimals}f}".replace("-", "−")


def format_integer(value: float) -> str:
    """Format a count with thin spaces between groups of three digits."""
    return f"{round(value):,}".replace(",", "\u2009")


def format_seconds(seconds: float) -> str:
    """Format a duration with its unit, rounded to a tenth of a second."""
    return f"{round(seconds, 1):g} s"


def format_percent_change(value: float) -> str:
    """Format a change given in percent with its sign, rounded to 1 %."""
    return f"{value:+.0f} %".replace("-", "−") if abs(value) >= 0.5 else "0 %"


def format_relative_change(value: float, reference: float) -> str:
    """Format the relative change against a reference in percent; empty if the reference is 0."""
    return format_percent_change(100 * (value / reference - 1)) if reference > 0 else ""


def format_signed(value: float, decimals: int = 4) -> str:
    """Format a difference with its sign and fixed decimals."""
    if abs(value) < 0.5 * 10**-decimals:
        return "0"
    return f"{value:+.{decimals}f}".replace("-", "−")


def format_interval(bounds: Sequence[float] | None, factor: float = 1.0, digits: int = 3) -> str:
    """Format the bounds of an interval; a missing interval is a dash."""
    if not bounds:
        return DASH
    lower, upper = (format_number(factor * bound, digits) for bound in bounds)
    return f"{lower} to {upper}"


def format_range(lower: float, upper: float, digits: int = 3) -> str:
    """Format the limits of a range with the decimals of the limit of larger magnitude."""
    largest = max(abs(lower), abs(upper))
    if not math.isfinite(largest) or largest == 0.0:
        return f"{format_number(lower, digits)} to {format_number(upper, digits)}"
    decimals = max(digits - 1 - math.floor(math.log10(largest)), 0)
    # the sum removes the sign of a rounded zero
    limits = (format_fixed(round(limit, decimals) + 0.0, decimals) for limit in (lower, upper))
    return " to ".join(limits)


def join_list(texts: Sequence[str]) -> str:
    """Join texts as `a, b and c`."""
    return " and ".join(filter(None, (", ".join(texts[:-1]), *texts[-1:])))


def format_count(count: int, noun: str) -> str:
    """Format a count with its noun, for example `1 log` or `2 logs`."""
    return f"{count} {noun}" + ("" if count == 1 else "s")

"""Numbers as text: rounding, minus signs, and the units in which quantities are shown."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

DEGREES_PER_RADIAN = 180.0 / math.pi
"""Degrees in a radian."""
DASH = "–"
"""Stands where there is no number."""
DISPLAY_UNITS = {"rad": ("deg", DEGREES_PER_RADIAN), "rad/s": ("deg/s", DEGREES_PER_RADIAN)}
"""SI units that are shown in another one, with the factor to it."""
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
"""Powers of ten between which a number is written without an exponent."""


def display_unit(unit: str) -> tuple[str, float]:
    """Return the unit in which a quantity is shown and the factor to it from SI."""
    return DISPLAY_UNITS.get(unit, (unit, 1.0))


def channel_title(channel: str) -> str:
    """Return the name of a channel in words."""
    return _CHANNEL_TITLES.get(channel, channel)


def format_minus_signs(text: str) -> str:
    """Return the text with hyphens before numbers written as minus signs."""
    return re.sub(r"(?<![\w-])-(?=\d)", "−", text)


_SUPERSCRIPTS = str.maketrans("234", "²³⁴")


def format_exponents(text: str) -> str:
    """Return the text with powers of units and variables as they are written by hand: m/s²."""
    exponent_pattern = r"(?<=[^\W\d_]|\))\^([234])(?!\w|\.\d)"
    return re.sub(exponent_pattern, lambda match: match[1].translate(_SUPERSCRIPTS), text)


def format_number(value: float | None, digits: int = 3) -> str:
    """Return a number with so many significant digits, and a dash where there is none.

    An exponent is written only for very small and very large numbers.
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
    """Return a number with so many decimals, and a dash where there is none."""
    if value is None or not math.isfinite(value):
        return DASH
    return f"{value:.{decimals}f}".replace("-", "−")


def format_integer(value: float) -> str:
    """Return a count with thin spaces between thousands."""
    return f"{round(value):,}".replace(",", "\u2009")


def format_percent_change(value: float) -> str:
    """Return a change in percent with its sign."""
    return f"{value:+.0f} %".replace("-", "−") if abs(value) >= 0.5 else "0 %"


def format_relative_change(value: float, reference: float) -> str:
    """Return the change of an error against a reference in percent, empty without a reference."""
    return format_percent_change(100 * (value / reference - 1)) if reference > 0 else ""


def format_signed(value: float, decimals: int = 4) -> str:
    """Return a difference with its sign and a fixed number of decimals."""
    if abs(value) < 0.5 * 10**-decimals:
        return "0"
    return f"{value:+.{decimals}f}".replace("-", "−")


def format_interval(bounds: list[float] | None, factor: float = 1.0, digits: int = 3) -> str:
    """Return the two ends of an interval, and a dash where there is none."""
    if not bounds:
        return DASH
    return f"{format_number(factor * bounds[0], digits)} to {format_number(factor * bounds[1], digits)}"


def join_list(texts: Sequence[str]) -> str:
    """Return texts as `a, b and c`."""
    return " and ".join(filter(None, (", ".join(texts[:-1]), *texts[-1:])))


def format_count(count: int, noun: str) -> str:
    """Return a count with its noun, as in "1 log" and "2 logs"."""
    return f"{count} {noun}" + ("" if count == 1 else "s")

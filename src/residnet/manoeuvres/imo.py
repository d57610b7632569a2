"""Limits of IMO resolution MSC.137(76), Standards for Ship Manoeuvrability.

They hold for ships of 100 m and more.
"""

from __future__ import annotations

import math

_DEGREE = math.pi / 180.0


def turning(length: float) -> dict[str, float]:
    """Return the largest advance and tactical diameter in m, at full rudder (section 5.3.1)."""
    return {"advance": 4.5 * length, "tactical_diameter": 5.0 * length}


def zigzag_10(length: float, speed: float) -> dict[str, float]:
    """Return the limits of the 10/10 zigzag (sections 5.3.2 and 5.3.3).

    These are the overshoots in rad, which grow with length [m] over speed [m/s], and the distance
    of the initial turn in m.
    """
    ratio = min(max(length / speed, 10.0), 30.0) if speed > 0 else 30.0
    # between 10 s and 30 s; below and above the standard is the value at the end
    return {
        "first_overshoot": (5.0 + 0.5 * ratio) * _DEGREE,
        "second_overshoot": (17.5 + 0.75 * ratio) * _DEGREE,
        "initial_turning_distance": 2.5 * length,
    }


def zigzag_20() -> dict[str, float]:
    """Return the limit of the 20/20 zigzag: first overshoot in rad (section 5.3.3.3)."""
    return {"first_overshoot": 25.0 * _DEGREE}


def stopping(length: float) -> dict[str, float]:
    """Return the limit of a full-astern stop: track reach in m (section 5.3.4)."""
    return {"track_reach": 15.0 * length}

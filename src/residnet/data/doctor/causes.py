"""What the causes that kinematics finds are called, and from what size on they mislead."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from residnet.core.log import Log
from residnet.data.doctor.findings import Finding, Level
from residnet.data.doctor.kinematics import Cause

# a lag below this matters to no rollout of a vessel, s
LEAST_LAG = 0.2


@dataclass(frozen=True)
class Limit:
    """The name of a cause of disagreement, and the size from which on it misleads.

    `least` is a number of time steps, or a share of the speed.
    """

    text: str
    unit: str
    least: float
    action: str
    steps: float = 0.0
    of_speed: float = 0.0


_SHIFT = "shift it in time, or estimate the lag where the reader can"
YAW_LIMITS = {
    "gain": Limit("r is too large against psi by a share of", "", 0.1, "correct its unit or scale"),
    "lag": Limit("r trails psi by", "s", LEAST_LAG, _SHIFT, steps=1.0),
}
POSITION_LIMITS = {
    "gain_u": Limit(
        "u is too large against the position by a share of", "", 0.1, "correct its unit or scale"
    ),
    "gain_v": Limit(
        "v is too large against the position by a share of", "", 0.25, "correct its unit or scale"
    ),
    "gain": Limit(
        "u, v are too large against the position by a share of",
        "",
        0.1,
        "correct their unit or scale",
    ),
    "heading": Limit(
        "psi is off against course and drift by",
        "deg",
        math.radians(3.0),
        "take the offset off psi",
    ),
    "lag_u": Limit("u trails the position by", "s", LEAST_LAG, _SHIFT, steps=1.0),
    "lag_v": Limit("v trails the position by", "s", LEAST_LAG, _SHIFT, steps=1.0),
    "lag": Limit("u, v trail the position by", "s", LEAST_LAG, _SHIFT, steps=1.0),
    "lag_psi": Limit(
        "psi trails position and velocities by", "s", 2.0 * LEAST_LAG, _SHIFT, steps=1.0
    ),
    "lag_xy": Limit("x, y trail heading and velocities by", "s", LEAST_LAG, _SHIFT, steps=1.0),
    "lever_arm": Limit(
        "x, y belong to a point forward and to starboard of where u, v hold by",
        "m",
        0.3,
        "move it to the vessel's centre (lever arm)",
        of_speed=0.05,
    ),
    "current": Limit(
        "u, v are through water that moves north and east by",
        "m/s",
        0.02,
        "give the current as an input",
        of_speed=0.1,
    ),
    "bias": Limit(
        "u, v are too large against the position by", "m/s", 0.02, "take the bias off", of_speed=0.1
    ),
}


def cause_findings(
    causes: dict[str, Cause], limits: dict[str, Limit], log: Log
) -> Iterator[Finding]:
    """Return the findings for the causes that are certain and large enough to matter."""
    step = float(np.median(np.diff(log.t)))
    speed = (
        float(np.sqrt(np.nanmean(log["u"] ** 2 + log["v"] ** 2)))
        if "u" in log.channels and "v" in log.channels
        else 0.0
    )
    for name, cause in causes.items():
        limit = limits.get(name)
        if limit is None or not cause.sure:
            continue
        size = float(np.hypot.reduce(cause.values))
        least = max(limit.least, limit.steps * step, limit.of_speed * speed)
        factor = math.degrees(1.0) if limit.unit == "deg" else 1.0
        text, sign = (
            (limit.text.replace("trail", "lead"), -1.0)
            if "trail" in limit.text and cause.values[0] < 0.0
            else (limit.text, 1.0)
        )
        factor *= sign
        sizes = zip(factor * cause.values, np.abs(2.0 * factor * cause.errors), strict=True)
        values = ", ".join(f"{value:+.3g} +- {error:.2g}" for value, error in sizes)
        if size < 0.3 * least:
            continue
        level: Level = "will mislead" if size > least else "note"
        figures = {
            "size": size,
            **{f"value_{i + 1}": float(value) for i, value in enumerate(cause.values)},
            "error": float(cause.errors.max()),
        }
        unit = f" {limit.unit}" if limit.unit else ""
        yield Finding(
            level, name, f"{text}: {values}{unit}", figures, limit.action if level != "note" else ""
        )

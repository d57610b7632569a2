"""What the causes that kinematics finds are called, and from what size on they mislead."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from residnet.core.log import Log
from residnet.data.doctor.findings import Finding, Level, raised, scaled, shifted, with_channels
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
    "gain": Limit(
        "r is too large against psi by a share of", "", 0.06, "correct its unit or scale"
    ),
    "lag": Limit("r trails psi by", "s", LEAST_LAG, _SHIFT, steps=1.0),
}
POSITION_LIMITS = {
    "gain_u": Limit(
        "u is too large against the position by a share of", "", 0.04, "correct its unit or scale"
    ),
    "gain_v": Limit(
        "v is too large against the position by a share of", "", 0.25, "correct its unit or scale"
    ),
    "gain": Limit(
        "u, v are too large against the position by a share of",
        "",
        0.04,
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
    causes: dict[str, Cause], limits: dict[str, Limit], log: Log, pair: tuple[str, ...]
) -> Iterator[Finding]:
    """Return the findings for the causes that are certain and large enough to matter.

    Args:
        causes: what explains a difference between pose and velocities.
        limits: from what size on they may mislead.
        log: that they were found in.
        pair: channels that are compared with the pose.
    """
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
            level,
            name,
            f"{text}: {values}{unit}",
            figures,
            limit.action if level != "note" else "",
            repair=_REPAIRS[name](cause.values, pair) if name in _REPAIRS else None,
        )


_Repair = Callable[[Log], Log]


def _moved(values: np.ndarray, pair: tuple[str, ...]) -> _Repair:
    """Return the correction of positions that belong to a point so far from the centre."""

    def repair(log: Log) -> Log:
        arm = (values[0] + 1j * values[1]) * np.exp(1j * log["psi"])
        return with_channels(log, x=log["x"] - arm.real, y=log["y"] - arm.imag)

    return repair


def _unbiased(values: np.ndarray, pair: tuple[str, ...]) -> _Repair:
    def repair(log: Log) -> Log:
        return with_channels(log, u=log["u"] - values[0], v=log["v"] - values[1])

    return repair


# cause -> what corrects it, given its values and the channels that are compared with the pose
_REPAIRS: dict[str, Callable[[np.ndarray, tuple[str, ...]], _Repair]] = {
    "gain": lambda values, pair: scaled(pair, 1.0 + values[0]),
    "gain_u": lambda values, pair: scaled(("u",), 1.0 + values[0]),
    "gain_v": lambda values, pair: scaled(("v",), 1.0 + values[0]),
    "lag": lambda values, pair: shifted(pair, values[0]),
    "lag_u": lambda values, pair: shifted(("u",), values[0]),
    "lag_v": lambda values, pair: shifted(("v",), values[0]),
    "lag_psi": lambda values, pair: shifted(("psi",), values[0]),
    "lag_xy": lambda values, pair: shifted(("x", "y"), values[0]),
    "heading": lambda values, pair: raised("psi", values[0]),
    "lever_arm": _moved,
    "bias": _unbiased,
}

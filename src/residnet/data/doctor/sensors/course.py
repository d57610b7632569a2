"""Whether what is called heading is the course over ground."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from residnet.core.log import Log
from residnet.data.doctor.findings import Finding, with_channels
from residnet.data.doctor.rates import Rates

# the drift angle must vary by so much before it tells heading from course
_LEAST_DRIFT = math.radians(1.0)
_FEWEST = 100


def course_findings(log: Log, motion: Rates) -> Iterator[Finding]:
    """Return a heading that follows the course over ground where velocities tell of drift."""
    if any(name not in motion.measured for name in ("u", "v")):
        return
    drift = np.angle(motion.measured["u"] + 1j * motion.measured["v"])
    away = np.exp(-1j * log["psi"])
    course = np.angle(motion.ground * away)
    known = np.isfinite(course) & np.isfinite(drift)
    if known.sum() < _FEWEST:
        return
    speed = np.abs(motion.ground)
    fast = speed > 0.3 * np.quantile(speed[known], 0.9)
    good = known & fast & (np.abs(drift) < 1.2)
    if good.sum() < _FEWEST:
        return
    spread = float(np.std(drift[good]))
    if spread < _LEAST_DRIFT:
        return
    as_heading = _rms(_wrapped(course[good] - drift[good]))
    as_course = _rms(_wrapped(course[good]))
    if as_course < 0.6 * as_heading and as_course < 0.6 * spread:
        text = (
            f"psi is the course over ground: it follows the positions to"
            f" {math.degrees(as_course):.1f} deg without the drift of v over u, and to"
            f" {math.degrees(as_heading):.1f} deg with it"
        )
        yield Finding(
            "will mislead",
            "course_as_heading",
            text,
            {"as_course": as_course, "as_heading": as_heading},
            "take psi from the compass",
            repair=_without_drift,
        )


def _without_drift(log: Log) -> Log:
    drift = np.where(np.abs(log["u"]) > 0.0, np.arctan2(log["v"], log["u"]), 0.0)
    return with_channels(log, psi=log["psi"] - drift)


def _wrapped(angle: np.ndarray) -> np.ndarray:
    wrapped: np.ndarray = np.angle(np.exp(1j * angle))
    return wrapped


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))

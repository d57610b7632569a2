"""Findings about causes of inconsistencies between position, heading and velocities of a log."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from residnet.core.log import Log
from residnet.quality.findings import (
    Check,
    Finding,
    Level,
    describe_unit_confusion,
    make_correction,
    with_channels,
)
from residnet.quality.kinematics import KinematicCause
from residnet.quality.statistics import LogStatistics

_MIN_LAG = 0.2
"""Smallest lag in s that affects a rollout of a vessel."""
_MIN_UNRELATED_SWAY_RATIO = 3.0
"""Smallest ratio of v to the sway velocity from the position at which both are unrelated."""


@dataclass(frozen=True)
class CauseLimit:
    """Description of a cause, and the size from which it misleads a fit.

    Attributes:
        text: text before the size.
        unit: display unit of the size.
        min_size: size from which the cause misleads, SI.
        fix: recommended action.
        min_time_steps: lower bound on that size in time steps.
        min_speed_share: lower bound on that size as a share of the RMS speed.
        si_unit: SI unit of the channel.
    """

    text: str
    unit: str
    min_size: float
    fix: str
    min_time_steps: float = 0.0
    min_speed_share: float = 0.0
    si_unit: str = "m/s"


def _lag_limit(text: str, min_size: float = _MIN_LAG) -> CauseLimit:
    fix = "shift it in time, or let the reader estimate the lag"
    return CauseLimit(text, "s", min_size, fix, min_time_steps=1.0)


def _gain_limit(
    text: str, min_size: float, fix: str = "correct its unit or scale", si_unit: str = "m/s"
) -> CauseLimit:
    return CauseLimit(f"{text} by a share of", "", min_size, fix, si_unit=si_unit)


YAW_LIMITS = {
    "gain": _gain_limit("r is too large against psi", 0.06, si_unit="rad/s"),
    "lag": _lag_limit("r trails psi by"),
    "course": CauseLimit(
        "psi is the course over ground: beyond r it turns with the drift angle of u, v, by a share"
        " of",
        "",
        0.5,
        "take psi from the compass, or subtract the drift atan2(v, u) from it",
    ),
}
POSITION_LIMITS = {
    "gain_u": _gain_limit("u is too large against the position", 0.04),
    "gain_v": _gain_limit("v is too large against the position", 0.25),
    "gain": _gain_limit(
        "u, v are too large against the position", 0.04, "correct their unit or scale"
    ),
    "heading": CauseLimit(
        "psi is off against course and drift by",
        "deg",
        math.radians(3.0),
        "subtract the offset from psi",
    ),
    "lag": _lag_limit("u, v trail the position by"),
    "lag_psi": _lag_limit("psi trails position and velocities by", 2.0 * _MIN_LAG),
    "lag_xy": _lag_limit("x, y trail heading and velocities by"),
    "lever_arm": CauseLimit(
        "x, y refer to a point forward and to starboard of that of u, v by",
        "m",
        0.3,
        "move it to the vessel's centre (lever arm)",
        min_speed_share=0.05,
    ),
    "current": CauseLimit(
        "u, v are relative to water that moves north and east by",
        "m/s",
        0.02,
        "provide the current as an input",
        min_speed_share=0.1,
    ),
    "bias": CauseLimit(
        "u, v are too large against the position by",
        "m/s",
        0.02,
        "subtract the bias",
        min_speed_share=0.1,
    ),
}


def make_cause_findings(
    causes: Mapping[str, KinematicCause],
    limits: Mapping[str, CauseLimit],
    log: LogStatistics,
    make_finding: Check,
) -> Iterator[Finding]:
    """Yield findings for significant causes that are large enough.

    Args:
        causes: estimated causes.
        limits: descriptions and limits of the causes to report.
        log: statistics of the log.
        make_finding: the check that reports.
    """
    for name, cause in causes.items():
        limit = limits.get(name)
        if limit is None or not cause.is_significant:
            continue
        magnitude = float(np.hypot.reduce(cause.estimates))
        min_size = max(
            limit.min_size,
            limit.min_time_steps * log.sampling_interval,
            limit.min_speed_share * log.rms_speed,
        )
        # a lag below one sample is a convention of the recorder
        if magnitude < max(0.3 * min_size, limit.min_time_steps * log.sampling_interval):
            continue
        is_leading = "trail" in limit.text and cause.estimates[0] < 0.0
        text = limit.text.replace("trail", "lead") if is_leading else limit.text
        display_factor = (math.degrees(1.0) if limit.unit == "deg" else 1.0) * (
            -1.0 if is_leading else 1.0
        )
        values_and_errors = zip(
            display_factor * cause.estimates,
            np.abs(2.0 * display_factor * cause.standard_errors),
            strict=True,
        )
        sizes_text = ", ".join(
            f"{estimate:+.3g} +- {interval_half_width:.2g}"
            for estimate, interval_half_width in values_and_errors
        )
        level: Level = "will mislead" if magnitude > min_size else "note"
        fix = limit.fix
        unit_text = ""
        is_gross = name.startswith("gain") and cause.is_gross
        ratio = 1.0 + float(cause.estimates[0])
        if is_gross and name == "gain_v" and abs(ratio) > _MIN_UNRELATED_SWAY_RATIO:
            text = f"v does not follow position and heading: {text}"
            fix = (
                "mask v where it is frozen or of another clock, or leave it out; if psi is the"
                " course over ground, take it from the compass"
            )
        elif is_gross and ratio < 0.0:
            text = f"the sign is wrong: {text}"
            fix = "turn it in the channel map (sign: -1)"
        elif is_gross:
            unit_text = describe_unit_confusion(ratio, limit.si_unit)
        figures = {f"value_{i + 1}": float(estimate) for i, estimate in enumerate(cause.estimates)}
        yield make_finding(
            f"{text}: {sizes_text} {limit.unit}".rstrip() + unit_text,
            {"size": magnitude, **figures, "error": cause.standard_errors.max()},
            code=name,
            level=level,
            fix=fix if level != "note" else "",
            # a wrong sign or unit must be corrected regardless of its effect on a fit
            repair=None
            if is_gross
            else _make_repair(
                name, cause.estimates, ("r",) if limits is YAW_LIMITS else ("u", "v")
            ),
        )


def _make_repair(
    name: str, estimates: np.ndarray, velocity_names: tuple[str, ...]
) -> Callable[[Log], Log] | None:
    """Create a function that corrects a cause in a log; None if there is no correction.

    Args:
        name: name of the cause.
        estimates: estimated size of the cause.
        velocity_names: velocities that are compared with the pose.
    """
    cause_kind, _, channel_suffix = name.partition("_")
    channel_names = {"": velocity_names, "xy": ("x", "y")}.get(channel_suffix, (channel_suffix,))
    if cause_kind == "gain":
        return make_correction(channel_names, factor=1.0 + estimates[0])
    if cause_kind == "lag":
        return make_correction(channel_names, delay=estimates[0])
    if name == "heading":
        return make_correction(("psi",), offset=-estimates[0])
    if name == "bias":
        return lambda log: with_channels(log, u=log["u"] - estimates[0], v=log["v"] - estimates[1])
    if name == "lever_arm":

        def move_to_centre(log: Log) -> Log:
            lever_arm = (estimates[0] + 1j * estimates[1]) * np.exp(1j * log["psi"])
            return with_channels(log, x=log["x"] - lever_arm.real, y=log["y"] - lever_arm.imag)

        return move_to_centre
    return None

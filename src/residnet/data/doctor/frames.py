"""Whether position, heading and velocities of a log describe one motion.

Frames, signs and units come first, then what is finer.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from residnet.core.log import Log
from residnet.core.names import VELOCITY
from residnet.data.doctor.causes import POSITION_LIMITS, YAW_LIMITS, cause_findings
from residnet.data.doctor.findings import Finding, Level, raised
from residnet.data.doctor.following import FEWEST_SAMPLES, follow_findings, slip_in_words
from residnet.data.doctor.kinematics import Cause, position_causes, yaw_causes
from residnet.data.doctor.rates import Rates, average_rates
from residnet.data.doctor.sensors.course import course_findings
from residnet.data.doctor.signals import noise_of

# a reference must vary by this share of the speed (or this yaw rate, rad/s) before a correlation
# says anything
_SHARE_OF_SPEED = 0.05
_LEAST_YAW = math.radians(0.1)
# from here on a gyro's bias, or the heading lost to it over the log, misleads
_LEAST_BIAS = math.radians(0.03)
_SHARE_OF_YAW = 0.05
_MOST_DRIFT = math.radians(15.0)
# (change of sign, constant angle in deg) -> how a user would say it; psi, y and v reversed cover
# all, because any two equal the third
_CONVENTIONS = {
    ("as declared", 180): "u and v (or x and y) with the sign turned",
    ("psi reversed", 0): "psi counted counter-clockwise (sign: -1)",
    ("psi reversed", 90): "psi counted counter-clockwise from east (frame: enu)",
    ("y reversed", 0): "y positive to the west (sign: -1)",
    ("y reversed", -90): "x and y exchanged (x is north, y is east)",
    ("v reversed", 0): "v positive to port (frame: body_fpu)",
    ("v reversed", 180): "u positive astern (sign: -1)",
}


def frame_findings(log: Log) -> list[Finding]:
    """Return whether position, heading and velocities of a log describe one motion.

    The log is on a uniform grid, with NaN where a channel is not to be trusted.
    """
    absent = [name for name in ("x", "y", "psi") if name not in log.channels]
    moving = [name for name in VELOCITY if name in log.channels]
    if absent or not moving:
        return [
            Finding(
                "note",
                "frames_unchecked",
                f"frames not checked: the log has no {', '.join(absent or VELOCITY)}",
            )
        ]
    motion = average_rates(log, moving)
    findings: list[Finding] = []
    if "u" in moving and "v" in moving:
        convention = _velocity(motion)
        findings += [*convention, *_position_jumps(log, motion.step)]
        findings += course_findings(log, motion)
        # an offset or a current is found by the comparison of increments, wrong axes are not
        if any(
            finding.figures.get("coherence", 0.0) > 0.8
            and 0.8 < finding.figures["speed_ratio"] < 1.25
            for finding in convention
        ):
            causes = position_causes(log)
            findings += [
                *_follows_ground(log, motion, causes),
                *cause_findings(causes, POSITION_LIMITS, log, ("u", "v")),
            ]
    if "r" in moving:
        findings += _yaw(log, motion)
    return findings


def _velocity(motion: Rates) -> list[Finding]:
    good = (
        np.isfinite(motion.ground)
        & np.isfinite(motion.through_water["as declared"])
        & np.isfinite(motion.through_water["psi reversed"])
    )
    ground, through_water = (
        motion.ground[good],
        {name: values[good] for name, values in motion.through_water.items()},
    )
    if good.sum() < FEWEST_SAMPLES or not ground.any() or not through_water["as declared"].any():
        return [
            Finding(
                "note",
                "frames_unchecked",
                f"u, v not checked against position: fewer than {FEWEST_SAMPLES} samples with"
                " motion",
            )
        ]
    return [_convention(ground, through_water)]


def _convention(ground: np.ndarray, through_water: dict[str, np.ndarray]) -> Finding:
    """Return how the velocity over ground [N] agrees with R(psi) [u, v] under each convention.

    Vectors are complex numbers.

    The coherence is 1 where both agree, and the angle of the complex overlap is what would have to
    be added to psi.
    """
    candidates = {name: (ground, values) for name, values in through_water.items()} | {
        "y reversed": (ground.conj(), through_water["as declared"])
    }
    overlap = {
        name: complex(np.vdot(b, g)) / float(np.linalg.norm(g) * np.linalg.norm(b))
        for name, (g, b) in candidates.items()
    }
    declared, offset = overlap["as declared"].real, math.degrees(np.angle(overlap["as declared"]))
    ratio = float(np.linalg.norm(through_water["as declared"]) / np.linalg.norm(ground))
    # on a straight course all conventions do equally well: the declared one wins
    best = max(
        overlap, key=lambda name: abs(overlap[name]) + (1e-3 if name == "as declared" else 0.0)
    )
    reached, angle = abs(overlap[best]), math.degrees(np.angle(overlap[best]))
    text = (
        f"x, y rates against R(psi) [u, v]: coherence {declared:.3f}, heading off by {offset:+.1f}"
        f" deg, speed ratio {ratio:.3f}"
    )
    level: Level = "will mislead"
    action = "correct it in the channel map"
    better = best != "as declared" and reached > 0.8 and 1.0 - reached < 0.5 * (1.0 - declared)
    if (declared < 0.8 and reached > declared + 0.1) or (better and reached > declared + 0.02):
        near = [
            key
            for key in _CONVENTIONS
            if key[0] == best and abs((angle - key[1] + 180.0) % 360.0 - 180.0) < 15.0
        ]
        named = _CONVENTIONS[near[0]] if near else f"{best}, {angle:+.1f} deg added to psi"
        text += f"; the frames do not fit: coherence {reached:.3f} with {named}"
    elif declared < 0.8:
        level, action = "fatal", "are the columns of one run, one clock and one vessel?"
        text += "; no change of sign or angle makes them fit"
    elif not 0.8 < ratio < 1.25:
        text += f"; check the units of u, v and x, y{slip_in_words(ratio)}"
    elif abs(offset) > 5.0:
        text, action = (
            text + "; a compass offset, or velocities through the water in a current",
            "correct psi, or give the current as an input",
        )
    else:
        level, action = "note", ""
    figures = {"coherence": declared, "offset": math.radians(offset), "speed_ratio": ratio}
    return Finding(
        level,
        "frames",
        text,
        {**figures, "best_coherence": reached, "best_offset": math.radians(angle)},
        action,
    )


def _follows_ground(log: Log, motion: Rates, causes: dict[str, Cause]) -> Iterator[Finding]:
    in_body_axes = motion.ground * np.exp(-1j * log["psi"])
    known = np.isfinite(in_body_axes)
    if not known.any():
        return
    speed = float(np.sqrt(np.mean(np.abs(in_body_axes[known]) ** 2)))
    for name, reference in (("u", in_body_axes.real), ("v", in_body_axes.imag)):
        certain = any(cause.sure for cause in causes.values())
        yield from follow_findings(
            name,
            reference,
            motion,
            _SHARE_OF_SPEED * speed,
            f"the position's rate along {'xy'[name == 'v']}",
            certain,
        )


def _position_jumps(log: Log, step: float) -> Iterator[Finding]:
    """Return the steps of the position that the velocities do not explain."""
    velocity = (log["u"] + 1j * log["v"]) * np.exp(1j * log["psi"])
    explained = 0.5 * step * (velocity[1:] + velocity[:-1])
    excess = np.abs(np.nan_to_num(np.diff(log["x"] + 1j * log["y"]) - explained))
    known = np.abs(explained[np.isfinite(explained)])
    limit = max(
        15.0 * float(np.median(excess)),
        0.5 * float(np.quantile(known, 0.95)) if known.size else 0.0,
    )
    over = np.flatnonzero(excess > limit)
    if over.size:
        worst = int(over[np.argmax(excess[over])])
        text = (
            f"position jumps {over.size} times by more than {limit:.2g} m beyond u, v, at most by"
            f" {excess[worst]:.2g} m "
        )
        text += f"at t = {log.t[worst + 1]:.2f} s"
        figures = {
            "count": over.size,
            "largest": float(excess[worst]),
            "t": float(log.t[worst + 1]),
        }
        at = np.zeros(len(log), dtype=bool)
        at[over] = at[over + 1] = True
        yield Finding(
            "will mislead",
            "position_jump",
            text,
            figures,
            "mask them (kind: frozen or jump), or split the log there",
            at,
            channels=("x", "y"),
        )


def _yaw(log: Log, motion: Rates) -> Iterator[Finding]:
    causes = yaw_causes(log)
    certain = any(cause.sure for cause in causes.values())
    follows = list(follow_findings("r", motion.yaw, motion, _LEAST_YAW, "the rate of psi", certain))
    yield from follows
    psi, r = log["psi"], log["r"]
    change = np.diff(psi) - 0.5 * motion.step * (r[1:] + r[:-1])
    noise = max(
        noise_of(psi) * math.sqrt(2.0),
        1.4826 * float(np.nanmedian(np.abs(change))) if np.isfinite(change).any() else 0.0,
    )
    over = np.abs(np.nan_to_num(change)) > max(10.0 * noise, math.radians(2.0))
    if over.any():
        worst = int(np.argmax(np.where(over, np.abs(change), 0.0)))
        text = (
            f"psi jumps {int(over.sum())} times beyond what r explains, at most by"
            f" {math.degrees(change[worst]):+.1f} deg "
        )
        text += f"at t = {log.t[worst + 1]:.2f} s"
        figures = {
            "count": over.sum(),
            "largest": float(abs(change[worst])),
            "t": float(log.t[worst + 1]),
        }
        yield Finding(
            "will mislead",
            "heading_jump",
            text,
            figures,
            "mask it (kind: jump, channel: psi), or split the log there",
            np.append(over, False) | np.append(False, over),
            channels=("psi",),
        )
    if all(finding.level == "note" or "lag" in finding.action for finding in follows):
        yield from _drift(log, causes)


def _drift(log: Log, causes: dict[str, Cause]) -> Iterator[Finding]:
    """Return the bias, lag and gain of r against psi."""
    if min(int(np.isfinite(log[name]).sum()) for name in ("psi", "r")) < 2:
        return
    psi, r = (
        np.interp(log.t, log.t[np.isfinite(values)], values[np.isfinite(values)])
        for values in (log["psi"], log["r"])
    )
    drift = psi - psi[0] - np.append(0.0, np.cumsum(0.5 * np.diff(log.t) * (r[1:] + r[:-1])))
    end, most, span = float(drift[-1]), float(np.abs(drift).max()), float(log.t[-1] - log.t[0])
    spread = max(float(np.nanstd(log["r"])), 1e-12)
    known = causes.get("bias") or causes.get("ramp")
    bias = end / span
    sure = known is not None and known.sure
    strong = sure and (abs(bias) > max(_LEAST_BIAS, _SHARE_OF_YAW * spread) or most > _MOST_DRIFT)
    text = (
        f"heading minus the integral of r: {math.degrees(end):+.1f} deg at the end, at most"
        f" {math.degrees(most):.1f} deg, a bias of {math.degrees(bias):+.4f} deg/s"
        f" ({100.0 * abs(bias) / spread:.2g} % of the standard deviation of r)"
    )
    level: Level = "will mislead" if strong else "note"
    action = "take the bias off r, or use the rate of psi in its place" if strong else ""
    figures = {"end": end, "most": most, "bias": bias}
    yield Finding(level, "yaw_drift", text, figures, action, repair=raised("r", bias))
    yield from cause_findings(causes, YAW_LIMITS, log, ("r",))

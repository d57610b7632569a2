"""Whether position, heading and velocities of a log describe one motion.

Frames, signs and units come first, then what is finer (`kinematics`). All look at a log on a
uniform grid, with NaN where a channel is not to be trusted.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from residnet.core.names import POSE, VELOCITY
from residnet.data.channels import SIGMA_OF_MAD, STILL, deviation, median, quantiles
from residnet.data.doctor.findings import (
    Check,
    Finding,
    Level,
    check,
    correction,
    slip_in_words,
    with_channels,
)
from residnet.data.doctor.kinematics import (
    LEAST_LAG,
    POSITION_LIMITS,
    YAW_LIMITS,
    cause_findings,
    position_causes,
    yaw_causes,
)
from residnet.data.doctor.statistics import Record, bridged
from residnet.data.statistics import FEWEST, agreement

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
_ALL = (*POSE, "u", "v")


@dataclass(frozen=True)
class Rates:
    """The rates of a log on a uniform grid, all averaged over the same few seconds.

    Pose and velocities are thus filtered alike.

    Attributes:
        ground: rate of the position, north + i east, [T] in m/s.
        through_water: the same from psi, u, v [T], for each convention.
        yaw: rate of psi [T] in rad/s.
        measured: u, v, r as far as the log has them, [T].
        noise: the larger of those in `yaw` and in the averaged r, rad/s.
        sway: noise in the averaged v, m/s.
    """

    ground: np.ndarray
    through_water: dict[str, np.ndarray]
    yaw: np.ndarray
    measured: dict[str, np.ndarray]
    noise: float
    sway: float


def rates(log: Record) -> Rates:
    """Return the rates over windows in which the pose moves by several times its noise."""
    known = [name for name in log.moving if np.isfinite(log[name]).any()]
    turning = log.std("r") if "r" in known else 0.0

    def half(noise: float, rate: float) -> int:
        longest = float(log.t[-1] - log.t[0]) / 15.0
        return max(
            round(0.5 * min(max(1.5, 10.0 * noise / max(rate, 1e-9)), longest) / log.step), 3
        )

    def rate(values: np.ndarray, half: int) -> np.ndarray:
        """Return central differences [T] over 2 half steps, NaN at the ends."""
        out = np.full(values.shape, np.nan, dtype=values.dtype)
        if values.size > 2 * half:
            out[half:-half] = (values[2 * half :] - values[: -2 * half]) / (2 * half * log.step)
        out[log.torn(half)] = np.nan
        return out

    def mean(values: np.ndarray, half: int) -> np.ndarray:
        """Return trapezoidal means [T] over 2 half steps, NaN at the ends and around a gap."""
        out = np.full(values.shape, np.nan, dtype=values.dtype)
        if values.size > 2 * half:
            weights, there = np.ones(2 * half + 1), np.isfinite(values)
            lost = np.convolve(~there, weights, mode="valid") > 0.5
            weights[[0, -1]] = 0.5
            whole = np.convolve(np.where(there, values, 0.0), weights / (2 * half), mode="valid")
            out[half:-half] = np.where(lost, np.nan, whole)
        return out

    place = half(max(log.noise("x"), log.noise("y")), log.speed)
    turn = half(log.noise("psi"), turning)
    u, v = (log[name] if name in known else np.full(len(log), np.nan) for name in ("u", "v"))
    noise = np.sqrt(0.5) * log.noise("psi") / (turn * log.step)
    return Rates(
        rate(log["x"] + 1j * log["y"], place),
        {
            "as declared": mean(np.exp(1j * log["psi"]) * (u + 1j * v), place),
            "psi reversed": mean(np.exp(-1j * log["psi"]) * (u + 1j * v), place),
            "v reversed": mean(np.exp(1j * log["psi"]) * (u - 1j * v), place),
        },
        rate(log["psi"], turn),
        {name: mean(log[name], turn if name == "r" else place) for name in known},
        max(noise, log.noise("r") / np.sqrt(2.0 * turn) if "r" in known else 0.0),
        log.noise("v") / np.sqrt(2.0 * place) if "v" in known else 0.0,
    )


@check("grid", "frames_unchecked", "note")
def unchecked(log: Record, found: Check) -> Iterator[Finding]:
    """Report a log without what is needed."""
    lost = [name for name in POSE if name not in log]
    if lost or not log.moving:
        yield found(f"frames not checked: the log has no {', '.join(lost or VELOCITY)}")


@dataclass(frozen=True)
class Convention:
    """How the velocity over ground agrees with R(psi) [u, v] under each convention.

    Attributes:
        overlap: complex for each convention; its size, the coherence, is 1 where both agree, and
            its angle is what would have to be added to psi.
        ratio: size of the declared velocity over that of the velocity over ground.
    """

    overlap: dict[str, complex]
    ratio: float

    @property
    def fits(self) -> bool:
        """Whether frames and units are right, so that finer causes can be looked for."""
        return self.overlap["as declared"].real > 0.8 and 0.8 < self.ratio < 1.25


def convention(log: Record) -> Convention | None:
    """Return how position and velocities agree; None where fewer than 50 samples tell."""
    motion = log.of(rates)
    good = np.isfinite(motion.ground)
    for values in motion.through_water.values():
        good &= np.isfinite(values)
    ground = motion.ground[good]
    declared = motion.through_water["as declared"][good]
    if good.sum() < FEWEST or not ground.any() or not declared.any():
        return None
    sides = {name: (ground, values[good]) for name, values in motion.through_water.items()}
    sides["y reversed"] = ground.conj(), declared
    overlap = {
        name: complex(np.vdot(b, g)) / float(np.linalg.norm(g) * np.linalg.norm(b))
        for name, (g, b) in sides.items()
    }
    return Convention(overlap, float(np.linalg.norm(declared) / np.linalg.norm(ground)))


@check("grid", "frames", fix="correct it in the channel map", needs=_ALL, few=True)
def frames(log: Record, found: Check) -> Iterator[Finding]:
    """Report frames, signs and units of position and velocities."""
    known = log.of(convention)
    if known is None:
        text = f"u, v not checked against position: fewer than {FEWEST} samples with motion"
        yield found(text, code="frames_unchecked", level="note", fix="")
        return
    overlap, ratio = known.overlap, known.ratio
    declared, offset = overlap["as declared"].real, math.degrees(np.angle(overlap["as declared"]))
    # on a straight course all conventions do equally well: the declared one wins
    best = max(overlap, key=lambda name: abs(overlap[name]) + 1e-3 * (name == "as declared"))
    reached, angle = abs(overlap[best]), math.degrees(np.angle(overlap[best]))
    text = (
        f"x, y rates against R(psi) [u, v]: coherence {declared:.3f}, heading off by {offset:+.1f}"
        f" deg, speed ratio {ratio:.3f}"
    )
    level: Level = "will mislead"
    fix = None
    better = best != "as declared" and reached > 0.8 and 1.0 - reached < 0.5 * (1.0 - declared)
    if (declared < 0.8 and reached > declared + 0.1) or (better and reached > declared + 0.02):
        named = f"{best}, {angle:+.1f} deg added to psi"
        for (name, about), words in _CONVENTIONS.items():
            if name == best and abs((angle - about + 180.0) % 360.0 - 180.0) < 15.0:
                named = words
        text += f"; the frames do not fit: coherence {reached:.3f} with {named}"
    elif declared < 0.8:
        level, fix = "fatal", "are the columns of one run, one clock and one vessel?"
        text += "; no change of sign or angle makes them fit"
    elif not 0.8 < ratio < 1.25:
        text += f"; check the units of u, v and x, y{slip_in_words(ratio, 'm/s', 'm')}"
    elif abs(offset) > 5.0:
        text += "; a compass offset, or velocities through the water in a current"
        fix = "correct psi, or give the current as an input"
    else:
        level, fix = "note", ""
    yield found(
        text,
        {
            "coherence": declared,
            "offset": math.radians(offset),
            "speed_ratio": ratio,
            "best_coherence": reached,
            "best_offset": math.radians(angle),
        },
        level=level,
        fix=fix,
    )


@check(
    "grid",
    "position_jump",
    fix="mask them (kind: frozen or jump), or split the log there",
    needs=_ALL,
)
def position_jumps(log: Record, found: Check) -> Iterator[Finding]:
    """Report steps of the position that the velocities do not explain."""
    velocity = (log["u"] + 1j * log["v"]) * np.exp(1j * log["psi"])
    explained = 0.5 * _bridged_steps(log) * (velocity[1:] + velocity[:-1])
    excess = np.abs(np.nan_to_num(np.diff(log["x"] + 1j * log["y"]) - explained))
    known = np.abs(explained[np.isfinite(explained)])
    fast = 0.5 * quantiles(known, 0.95)[0] if known.size else 0.0
    limit = max(15.0 * median(excess), fast)
    what = (
        f"position jumps {{}} times by more than {limit:.2g} m beyond u, v, at most by {{:.2g}} m"
    )
    yield from _jumps(log, found, excess, limit, what, ("x", "y"))


def _bridged_steps(log: Record) -> np.ndarray:
    """Return the steps [T - 1] in s, NaN where they are longer than a grid bridges."""
    dt = np.diff(log.t)
    return np.where(dt > 3.5 * log.step, np.nan, dt)


def _jumps(
    log: Record,
    found: Check,
    excess: np.ndarray,
    limit: float,
    what: str,
    channels: tuple[str, ...],
    factor: float = 1.0,
) -> Iterator[Finding]:
    """Return the steps of a pose whose excess [T - 1] is beyond a limit, if any."""
    over = np.abs(excess) > limit
    if over.any():
        worst = int(np.argmax(np.abs(excess)))
        largest, t = float(abs(excess[worst])), float(log.t[worst + 1])
        yield found(
            what.format(int(over.sum()), factor * excess[worst]) + f" at t = {t:.2f} s",
            {"count": over.sum(), "largest": largest, "t": t},
            at=np.append(over, False) | np.append(False, over),
            channels=channels,
        )


@check("grid", "course_as_heading", fix="take psi from the compass", needs=_ALL, few=True)
def course_as_heading(log: Record, found: Check) -> Iterator[Finding]:
    """Report a heading that follows the course over ground where velocities tell of drift."""
    motion = log.of(rates)
    if not {"u", "v"} <= motion.measured.keys():
        return
    drift = np.angle(motion.measured["u"] + 1j * motion.measured["v"])
    course = np.angle(motion.ground * np.exp(-1j * log["psi"]))
    good = np.isfinite(course) & np.isfinite(drift)
    speed = np.abs(motion.ground)
    if good.any():
        good &= (speed > 0.3 * quantiles(speed[good], 0.9)[0]) & (np.abs(drift) < 1.2)
    spread = float(np.std(drift[good])) if good.sum() >= 100 else 0.0
    # the drift angle must vary by so much, beyond its noise, before it tells heading from course
    noise = float(np.sqrt(np.mean((motion.sway / speed[good]) ** 2))) if spread else 0.0
    if spread < math.hypot(math.radians(1.0), noise):
        return
    as_heading, as_course = (
        float(np.sqrt(np.mean(np.angle(np.exp(1j * angle)) ** 2)))
        for angle in (course[good] - drift[good], course[good])
    )
    if as_course < 0.6 * min(as_heading, spread):
        text = (
            "psi is the course over ground: it follows the positions to"
            f" {math.degrees(as_course):.1f} deg without the drift of v over u, and to"
            f" {math.degrees(as_heading):.1f} deg with it"
        )
        yield found(
            text,
            {"as_course": as_course, "as_heading": as_heading},
            repair=lambda log: with_channels(log, psi=log["psi"] - np.arctan2(log["v"], log["u"])),
        )


@check("grid", "follows", needs=_ALL, few=True)
def follows_ground(log: Record, found: Check) -> Iterator[Finding]:
    """Report sign, gain and lag of u and v against the rate of the position."""
    known = log.of(convention)
    ground = log.of(rates).ground * np.exp(-1j * log["psi"])
    if known is None or not known.fits or not np.isfinite(ground).any():
        return
    # an offset or a current is found by the comparison of increments, wrong axes are not
    sure = any(cause.sure for cause in log.of(position_causes).values())
    least = 0.05 * float(np.sqrt(np.nanmean(np.abs(ground) ** 2)))
    for name, axis, reference in (("u", "x", ground.real), ("v", "y", ground.imag)):
        what = f"the position's rate along {axis}"
        told = _follow(log, name, reference, least, what, sure)
        if told:
            yield found(**told)


def _follow(
    log: Record, name: str, reference: np.ndarray, least: float, what: str, certain: bool
) -> dict[str, Any]:
    """Return what a finding says of a channel against a reference [T] of `least` variation.

    Its sign, gain and lag; nothing where these cannot be told.

    A lag alone misleads where the finer look is `certain` that pose and velocities differ at all:
    slow channels correlate at any lag.
    """
    motion = log.of(rates)
    own, turned = (deviation(one) for one in (motion.measured[name], reference))
    if name == "r" and turned > 5.0 * motion.noise and own < STILL * turned:
        return {
            "text": f"{name} does not move, while {what} does; the gyro is dead or another column",
            "figures": {"correlation": 0.0, "gain": 0.0, "lag": 0.0},
            "code": f"follows_{name}",
            "level": "will mislead",
            "fix": f"leave {name} out of the channel map: it follows from the heading",
        }
    match = agreement(reference, motion.measured[name], log.step)
    if match is None or match.spread < least:
        return {}
    correlation, gain, lag, spread = match
    text = (
        f"{name} against {what}: correlation {correlation:.3f}, gain {gain:.3f}, lag {lag:+.2f} s"
    )
    level: Level = "will mislead"
    fix = ""
    clear = name != "r" or spread > 5.0 * motion.noise
    if correlation < -0.8 or (correlation < -0.5 and clear):
        text, fix = f"{text}; it has the opposite sign", "turn it in the channel map (sign: -1)"
    elif correlation < 0.5 and name == "r" and clear:
        level, fix = "fatal", "are both columns of this vessel and this clock?"
        text += "; they do not describe one motion"
    elif correlation > 0.9 and clear and not 0.6 < gain < 1.6:
        text += f"; check its unit{slip_in_words(gain, log.units[name])}"
        fix = "correct the unit in the channel map"
    else:
        # how far a lag misleads is measured with the causes, which tell the channels apart
        level = "note"
        if correlation > 0.9 and abs(lag) > max(LEAST_LAG, log.step) and clear and certain:
            text += f"; it {'trails' if lag > 0.0 else 'leads'}, a filter or another clock"
    figures = {"correlation": correlation, "gain": gain, "lag": lag}
    return {"text": text, "figures": figures, "code": f"follows_{name}", "level": level, "fix": fix}


@check("grid", "position_causes", needs=_ALL, few=True)
def causes_of_position(log: Record, found: Check) -> Iterator[Finding]:
    """Report what makes position and velocities differ, where the frames are right."""
    known = log.of(convention)
    if known is not None and known.fits:
        yield from cause_findings(log.of(position_causes), POSITION_LIMITS, log, found)


def yaw_follows(log: Record) -> dict[str, Any]:
    """Return what a finding says of r against the rate of psi."""
    if "r" not in log.of(rates).measured:
        return {}
    sure = any(cause.sure for cause in log.of(yaw_causes).values())
    reference = log.of(rates).yaw
    return _follow(log, "r", reference, math.radians(0.1), "the rate of psi", sure)


def _yaw_is_one(log: Record) -> bool:
    """Return whether psi and r describe one motion, but for what is finer."""
    known = min(int(np.isfinite(log[name]).sum()) for name in ("psi", "r")) > 1
    return known and log.of(yaw_follows).get("level", "note") == "note"


_YAW = (*POSE, "r")


@check("grid", "follows", needs=_YAW, few=True)
def follows_heading(log: Record, found: Check) -> Iterator[Finding]:
    """Report sign, gain and lag of r against the rate of psi."""
    told = log.of(yaw_follows)
    if told:
        yield found(**told)


@check(
    "grid",
    "heading_jump",
    fix="mask it (kind: jump, channel: psi), or split the log there",
    needs=_YAW,
)
def heading_jumps(log: Record, found: Check) -> Iterator[Finding]:
    """Report steps of the heading that the yaw rate does not explain."""
    psi, r = log["psi"], log["r"]
    change = np.diff(psi) - 0.5 * _bridged_steps(log) * (r[1:] + r[:-1])
    scatter = median(np.abs(change)) if np.isfinite(change).any() else 0.0
    noise = max(log.noise("psi") * math.sqrt(2.0), SIGMA_OF_MAD * scatter)
    limit = max(10.0 * noise, math.radians(2.0))
    what = "psi jumps {} times beyond what r explains, at most by {:+.1f} deg"
    excess = np.nan_to_num(change)
    yield from _jumps(log, found, excess, limit, what, ("psi",), math.degrees(1.0))


@check("grid", "yaw_drift", needs=_YAW, certain=True)
def yaw_drift(log: Record, found: Check) -> Iterator[Finding]:
    """Report the bias of r against psi."""
    if not _yaw_is_one(log.few):
        return
    psi, r = bridged(log.t, log["psi"]), bridged(log.t, log["r"])
    drift = psi - psi[0] - np.append(0.0, np.cumsum(0.5 * np.diff(log.t) * (r[1:] + r[:-1])))
    end, most, span = float(drift[-1]), float(np.abs(drift).max()), float(log.t[-1] - log.t[0])
    spread, bias = max(log.std("r"), 1e-12), end / span
    causes = log.few.of(yaw_causes)
    known = causes.get("bias") or causes.get("ramp")
    # a bias misleads from 1.8 deg a minute and 5 % of the yaw rate on, or by what it adds up to
    large = abs(bias) > max(math.radians(0.03), 0.05 * spread) or most > math.radians(15.0)
    strong = known is not None and known.sure and large
    text = (
        f"heading minus the integral of r: {math.degrees(end):+.1f} deg at the end, at most"
        f" {math.degrees(most):.1f} deg, a bias of {math.degrees(bias):+.4f} deg/s"
        f" ({100.0 * abs(bias) / spread:.2g} % of the standard deviation of r)"
    )
    level: Level = "will mislead" if strong else "note"
    fix = "take the bias off r, or use the rate of psi in its place" if strong else ""
    repair = correction(("r",), offset=bias)
    yield found(text, {"end": end, "most": most, "bias": bias}, level=level, fix=fix, repair=repair)


@check("grid", "yaw_causes", needs=_YAW, few=True)
def causes_of_yaw(log: Record, found: Check) -> Iterator[Finding]:
    """Report gain and lag of r against psi."""
    if _yaw_is_one(log):
        yield from cause_findings(log.of(yaw_causes), YAW_LIMITS, log, found)


_TIED = 0.8
"""Correlation from which steps of an angle and integrals of its rate are measures of one motion."""


@check("grid", "roll_rate", fix="correct the sign or the unit of one", needs=("phi", "p"), few=True)
def roll_rate(log: Record, found: Check) -> Iterator[Finding]:
    """Report a roll rate that is not the rate of the roll angle: another sign, or a unit."""
    phi, p = bridged(log.t, log["phi"]), bridged(log.t, log["p"])
    run = np.append(0.0, np.cumsum(0.5 * np.diff(log.t) * (p[1:] + p[:-1])))
    every = slice(None, None, max(round(1.0 / log.step), 1))
    moved, told = np.diff(phi[every]), np.diff(run[every])
    size = float(np.linalg.norm(moved) * np.linalg.norm(told))
    if moved.size < FEWEST or size == 0.0 or abs(float(moved @ told)) < _TIED * size:
        return
    gain = float(moved @ told) / float(told @ told)
    # a mistaken sign makes it -1, a mistaken unit 57 or a 57th
    if not 0.5 < gain < 2.0:
        yield found(f"phi moves by {gain:.2g} times what its rate p says")

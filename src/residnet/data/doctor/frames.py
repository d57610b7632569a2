"""Whether position, heading and velocities of a log describe one motion.

Frames, signs and units come first, then what is finer.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from residnet.core.log import Log
from residnet.core.names import VELOCITY
from residnet.data.doctor.causes import LEAST_LAG, POSITION_LIMITS, YAW_LIMITS, told
from residnet.data.doctor.findings import Finding, Level, unit_slip
from residnet.data.doctor.kinematics import Cause, position_causes, yaw_causes
from residnet.data.doctor.signals import noise_of

_FEWEST = 50
_LONGEST_LAG = 3.0
# a reference must vary by this share of the speed (or this yaw rate, rad/s) before a correlation
# says anything
_SHARE_OF_SPEED = 0.05
_LEAST_YAW = math.radians(0.1)
# from here on a gyro's bias, or the heading lost to it over the log, misleads
_LEAST_BIAS = math.radians(0.03)
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


@dataclass(frozen=True)
class _Motion:
    """The rates of a log on a uniform grid, all averaged over the same few seconds.

    Pose and velocities are thus filtered alike.

    Attributes:
        step: time between samples, s.
        ground: rate of the position, north + i east, [T] in m/s.
        sailed: what psi, u, v say of it [T] for each convention.
        yaw: rate of psi [T] in rad/s.
        measured: u, v, r as far as the log has them, [T].
        noise: standard deviation of the noise in `yaw` and in the averaged r.
    """

    step: float
    ground: np.ndarray
    sailed: dict[str, np.ndarray]
    yaw: np.ndarray
    measured: dict[str, np.ndarray]
    noise: tuple[float, float]


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
    motion = _motion(log, moving)
    findings: list[Finding] = []
    if "u" in moving and "v" in moving:
        convention = _velocity(motion)
        findings += [*convention, *_position_jumps(log, motion.step)]
        # an offset or a current is told apart by the finer look, wrong axes are not
        if any(
            finding.figures.get("coherence", 0.0) > 0.8
            and 0.8 < finding.figures["speed_ratio"] < 1.25
            for finding in convention
        ):
            causes = position_causes(log)
            findings += [*_follows_ground(log, motion, causes), *told(causes, POSITION_LIMITS, log)]
    if "r" in moving:
        findings += _yaw(log, motion)
    return findings


def _motion(log: Log, moving: list[str]) -> _Motion:
    """Return the rates over windows in which the pose moves by several times its noise."""
    step, span = float(np.median(np.diff(log.t))), float(log.t[-1] - log.t[0])
    speed = (
        float(np.sqrt(np.nanmean(log["u"] ** 2 + log["v"] ** 2)))
        if "u" in moving and "v" in moving
        else 0.0
    )
    turning = float(np.nanstd(log["r"])) if "r" in moving else 0.0

    def half(noise: float, rate: float) -> int:
        seconds = min(max(1.5, 10.0 * noise / max(rate, 1e-9)), span / 15.0)
        return max(round(0.5 * seconds / step), 3)

    place, turn = (
        half(max(noise_of(log["x"]), noise_of(log["y"])), speed),
        half(noise_of(log["psi"]), turning),
    )
    position = log["x"] + 1j * log["y"]
    u, v = (log[name] if name in moving else np.full(len(log), np.nan) for name in ("u", "v"))
    angles = {
        "as declared": (log["psi"], u + 1j * v),
        "psi reversed": (-log["psi"], u + 1j * v),
        "v reversed": (log["psi"], u - 1j * v),
    }
    sailed = {
        name: _mean(np.exp(1j * angle) * body, place) for name, (angle, body) in angles.items()
    }
    measured = {name: _mean(log[name], turn if name == "r" else place) for name in moving}
    noise = (
        np.sqrt(0.5) * noise_of(log["psi"]) / (turn * step),
        noise_of(log["r"]) / np.sqrt(2.0 * turn) if "r" in moving else 0.0,
    )
    return _Motion(
        step, _rate(position, place, step), sailed, _rate(log["psi"], turn, step), measured, noise
    )


def _rate(values: np.ndarray, half: int, step: float) -> np.ndarray:
    """Return the central differences [T] over 2 half steps, NaN at the ends."""
    out = np.full(values.shape, np.nan, dtype=values.dtype)
    if values.size > 2 * half:
        out[half:-half] = (values[2 * half :] - values[: -2 * half]) / (2 * half * step)
    return out


def _mean(values: np.ndarray, half: int) -> np.ndarray:
    """Return the trapezoidal means [T] over 2 half steps.

    They are NaN at the ends and where a sample is missing.
    """
    out = np.full(values.shape, np.nan, dtype=values.dtype)
    if values.size > 2 * half:
        weights = np.ones(2 * half + 1)
        weights[[0, -1]] = 0.5
        missing = np.convolve(~np.isfinite(values), np.ones(2 * half + 1), mode="valid") > 0.5
        out[half:-half] = np.where(
            missing,
            np.nan,
            np.convolve(
                np.where(np.isfinite(values), values, 0.0), weights / (2 * half), mode="valid"
            ),
        )
    return out


def _velocity(motion: _Motion) -> list[Finding]:
    good = (
        np.isfinite(motion.ground)
        & np.isfinite(motion.sailed["as declared"])
        & np.isfinite(motion.sailed["psi reversed"])
    )
    ground, sailed = (
        motion.ground[good],
        {name: values[good] for name, values in motion.sailed.items()},
    )
    if good.sum() < _FEWEST or not ground.any() or not sailed["as declared"].any():
        return [
            Finding(
                "note",
                "frames_unchecked",
                f"u, v not checked against position: fewer than {_FEWEST} samples with motion",
            )
        ]
    return [_convention(ground, sailed)]


def _convention(ground: np.ndarray, sailed: dict[str, np.ndarray]) -> Finding:
    """Return how the velocity over ground [N] agrees with R(psi) [u, v] under each convention.

    Vectors are complex numbers.

    The coherence is 1 where both agree, and the angle of the complex overlap is what would have to
    be added to psi.
    """
    candidates = {name: (ground, values) for name, values in sailed.items()} | {
        "y reversed": (ground.conj(), sailed["as declared"])
    }
    overlap = {
        name: complex(np.vdot(b, g)) / float(np.linalg.norm(g) * np.linalg.norm(b))
        for name, (g, b) in candidates.items()
    }
    declared, offset = overlap["as declared"].real, math.degrees(np.angle(overlap["as declared"]))
    ratio = float(np.linalg.norm(sailed["as declared"]) / np.linalg.norm(ground))
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
        text += f"; check the units of u, v and x, y{_named(ratio)}"
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


def _named(factor: float) -> str:
    slip = unit_slip(factor)
    return f" ({slip})" if slip else ""


def _follows_ground(log: Log, motion: _Motion, causes: dict[str, Cause]) -> Iterator[Finding]:
    turned = motion.ground * np.exp(-1j * log["psi"])
    known = np.isfinite(turned)
    if not known.any():
        return
    speed = float(np.sqrt(np.mean(np.abs(turned[known]) ** 2)))
    for name, reference in (("u", turned.real), ("v", turned.imag)):
        certain = any(cause.sure for cause in causes.values())
        yield from _follows(
            name,
            reference,
            motion,
            _SHARE_OF_SPEED * speed,
            f"the position's rate along {'xy'[name == 'v']}",
            certain,
        )


def _follows(
    name: str, reference: np.ndarray, motion: _Motion, least: float, what: str, certain: bool
) -> Iterator[Finding]:
    """Return the sign, gain and lag of a channel against a reference [T].

    Nothing is returned where the reference varies by less than `least`.

    A lag alone misleads where the finer look is `certain` that pose and velocities differ at all:
    slow channels correlate at any lag.
    """
    match = _agreement(reference, motion.measured[name], np.isfinite(reference), motion.step)
    if match is None or match[3] < least:
        return
    correlation, gain, lag, spread = match
    text = (
        f"{name} against {what}: correlation {correlation:.3f}, gain {gain:.3f}, lag {lag:+.2f} s"
    )
    level: Level = "will mislead"
    action = ""
    clear = name != "r" or spread > 5.0 * max(motion.noise)
    if correlation < -0.8 or (correlation < -0.5 and clear):
        text, action = f"{text}; it has the opposite sign", "turn it in the channel map (sign: -1)"
    elif correlation < 0.5 and name == "r" and clear:
        level, text, action = (
            "fatal",
            f"{text}; they do not describe one motion",
            "are both columns of this vessel and this clock?",
        )
    elif correlation > 0.9 and not 0.6 < gain < 1.6:
        text, action = (
            f"{text}; check its unit{_named(gain)}",
            "correct the unit in the channel map",
        )
    elif correlation > 0.9 and abs(lag) > max(LEAST_LAG, motion.step) and clear and certain:
        text = f"{text}; it {'trails' if lag > 0.0 else 'leads'}, a filter or another clock"
        action = "shift it, or estimate the lag where the reader can"
    else:
        level = "note"
    yield Finding(
        level,
        f"follows_{name}",
        text,
        {"correlation": correlation, "gain": gain, "lag": lag},
        action,
    )


def _agreement(
    reference: np.ndarray, measured: np.ndarray, good: np.ndarray, step: float
) -> tuple[float, float, float, float] | None:
    """Return how `measured` [T] follows `reference` [T] where `good` [T].

    Returns:
        Correlation (means removed) and gain (least squares through the origin) at the lag with the
        largest correlation, that lag in s (positive where `measured` trails; within 3 s, refined by
        a parabola), and the standard deviation of the reference; None where fewer than 50 samples
        can be compared at all lags, or either does not vary.
    """
    reach = max(round(_LONGEST_LAG / step), 10)
    if good.size < 2 * reach + _FEWEST:
        return None
    # the same samples for every lag, or the comparison of lags would be one of samples
    around = np.lib.stride_tricks.sliding_window_view(np.isfinite(measured), 2 * reach + 1).all(
        axis=1
    )
    at = np.flatnonzero(good[reach:-reach] & around) + reach
    if at.size < _FEWEST:
        return None
    a, spread = reference[at], float(reference[at].std())
    lags = np.arange(-reach, reach + 1)
    cov = np.array([(a - a.mean()) @ measured[at + k] for k in lags]) / at.size
    std = np.array([measured[at + k].std() for k in lags])
    if spread == 0.0 or std.min() <= 1e-12 * np.nanmax(np.abs(measured)):
        return None
    values = cov / (spread * std)
    best = int(np.argmax(np.abs(values)))
    shift = 0.0
    if 0 < best < lags.size - 1:
        before, peak, after = np.abs(values[best - 1 : best + 2])
        curvature = before - 2.0 * peak + after
        shift = 0.5 * (before - after) / curvature if curvature < 0.0 else 0.0
    return (
        float(values[best]),
        float(a @ measured[at + lags[best]] / (a @ a)),
        float((lags[best] + shift) * step),
        spread,
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
        yield Finding(
            "will mislead",
            "position_jump",
            text,
            figures,
            "mask them (kind: frozen or jump), or split the log there",
        )


def _yaw(log: Log, motion: _Motion) -> Iterator[Finding]:
    causes = yaw_causes(log)
    certain = any(cause.sure for cause in causes.values())
    follows = list(_follows("r", motion.yaw, motion, _LEAST_YAW, "the rate of psi", certain))
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
        )
    if all(finding.level == "note" or "lag" in finding.action for finding in follows):
        yield from _drift(log, causes)


def _drift(log: Log, causes: dict[str, Cause]) -> Iterator[Finding]:
    """Return the bias, lag and gain of r against psi."""
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
    strong = sure and (abs(bias) > _LEAST_BIAS or most > _MOST_DRIFT)
    text = (
        f"heading minus the integral of r: {math.degrees(end):+.1f} deg at the end, at most"
        f" {math.degrees(most):.1f} deg, a bias of {math.degrees(bias):+.4f} deg/s"
        f" ({100.0 * abs(bias) / spread:.2g} % of the standard deviation of r)"
    )
    level: Level = "will mislead" if strong else "note"
    action = "take the bias off r, or use the rate of psi in its place" if strong else ""
    yield Finding(level, "yaw_drift", text, {"end": end, "most": most, "bias": bias}, action)
    yield from told(causes, YAW_LIMITS, log)

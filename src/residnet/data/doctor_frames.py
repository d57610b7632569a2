"""Whether position, heading and velocities of a log describe one motion: frames, signs, units, lags, drifts."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from residnet.core.log import Log
from residnet.core.names import VELOCITY
from residnet.data.derivatives import SavitzkyGolay
from residnet.data.doctor_findings import Finding, Level
from residnet.data.masks import Frozen, segments

_FEWEST = 50
_LONGEST_LAG = 3.0
# a reference must vary by this share of the speed (or this yaw rate, rad/s) before a correlation says anything
_SHARE_OF_SPEED = 0.05
_LEAST_YAW = math.radians(0.1)
# (change of sign, constant angle in deg) -> how a user would say it; psi, y and v reversed cover all, because any two equal the third
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
    """Rates of a log on a uniform grid.

    Attributes:
        step: time between samples, s.
        over_ground: velocity over ground, north + i east, [T] in m/s.
        yaw: rate of psi [T] in rad/s.
        measured: u, v, r as far as the log has them, smoothed as the rates are, [T].
        good: [T] bool, away from gaps and freezes.
    """

    step: float
    over_ground: np.ndarray
    yaw: np.ndarray
    measured: dict[str, np.ndarray]
    good: np.ndarray


def frame_findings(log: Log) -> list[Finding]:
    """Whether position, heading and velocities of a log on a uniform grid describe one motion."""
    absent = [name for name in ("x", "y", "psi") if name not in log.channels]
    moving = [name for name in VELOCITY if name in log.channels]
    if absent or not moving:
        return [Finding("info", "frames_unchecked", f"frames not checked: the log has no {', '.join(absent or VELOCITY)}")]
    step = float(np.median(np.diff(log.t)))
    rule = SavitzkyGolay(window=max(1.5, 7.0 * step), order=2)
    smooth, rate, valid = rule.derive(log.stack(("x", "y", "psi", *moving)), step, segments(log))
    measured = {name: smooth[:, 3 + i] for i, name in enumerate(moving)}
    motion = _Motion(step, rate[:, 0] + 1j * rate[:, 1], rate[:, 2], measured, valid & ~Frozen().apply(log))
    findings: list[Finding] = []
    if "u" in moving and "v" in moving:
        findings += [*_velocity(log, motion), *_position_jumps(log, motion)]
    if "r" in moving:
        findings += _yaw(log, motion)
    return findings


def _velocity(log: Log, motion: _Motion) -> Iterator[Finding]:
    good = motion.good
    ground, psi, body = motion.over_ground[good], log["psi"][good], (motion.measured["u"] + 1j * motion.measured["v"])[good]
    if good.sum() < _FEWEST or not ground.any() or not body.any():
        yield Finding("info", "frames_unchecked", f"u, v not checked against position: fewer than {_FEWEST} samples with motion")
        return
    yield _convention(ground, psi, body)
    turned = motion.over_ground * np.exp(-1j * log["psi"])
    speed = float(np.sqrt(np.mean(np.abs(ground) ** 2)))
    for name, reference in (("u", turned.real), ("v", turned.imag)):
        yield from _follows(name, reference, motion, _SHARE_OF_SPEED * speed, f"the position's rate along {'xy'[name == 'v']}")


def _convention(ground: np.ndarray, psi: np.ndarray, body: np.ndarray) -> Finding:
    """Velocity over ground against R(psi) [u, v], as declared and under other conventions; vectors as complex numbers [N], psi in rad.

    The coherence is 1 where both agree, and the angle of the complex overlap is what would have to be added to psi.
    """
    energy = float(np.linalg.norm(ground) * np.linalg.norm(body))
    candidates = {
        "as declared": (ground, psi, body),
        "psi reversed": (ground, -psi, body),
        "y reversed": (ground.conj(), psi, body),
        "v reversed": (ground, psi, body.conj()),
    }
    overlap = {name: complex(np.vdot(np.exp(1j * angle) * b, g)) / energy for name, (g, angle, b) in candidates.items()}
    declared, offset = overlap["as declared"].real, math.degrees(np.angle(overlap["as declared"]))
    ratio = float(np.linalg.norm(body) / np.linalg.norm(ground))
    # on a straight course all conventions do equally well: the declared one wins
    best = max(overlap, key=lambda name: abs(overlap[name]) + (1e-3 if name == "as declared" else 0.0))
    reached, angle = abs(overlap[best]), math.degrees(np.angle(overlap[best]))
    text = f"x, y rates against R(psi) [u, v]: coherence {declared:.3f}, heading off by {offset:+.1f} deg, speed ratio {ratio:.3f}"
    level: Level = "error"
    if declared < 0.8 and reached > declared + 0.1:
        near = [key for key in _CONVENTIONS if key[0] == best and abs((angle - key[1] + 180.0) % 360.0 - 180.0) < 15.0]
        named = _CONVENTIONS[near[0]] if near else f"{best}, {angle:+.1f} deg added to psi"
        text += f"; the frames do not fit: coherence {reached:.3f} with {named}"
    elif declared < 0.8:
        text += "; no change of sign or angle makes them fit: columns of different runs, clocks or vessels?"
    elif not 0.8 < ratio < 1.25:
        text += "; check the units of u, v and x, y"
    elif abs(offset) > 5.0:
        level, text = "warning", text + "; a compass offset, or velocities through the water in a current"
    else:
        level = "info"
    figures = {"coherence": declared, "offset": math.radians(offset), "speed_ratio": ratio}
    return Finding(level, "frames", text, {**figures, "best_coherence": reached, "best_offset": math.radians(angle)})


def _follows(name: str, reference: np.ndarray, motion: _Motion, least: float, what: str) -> Iterator[Finding]:
    """Sign, gain and lag of a channel against a reference [T], unless that varies by less than `least`."""
    match = _agreement(reference, motion.measured[name], motion.good, motion.step)
    if match is None or match[3] < least:
        return
    correlation, gain, lag, spread = match
    text = f"{name} against {what}: correlation {correlation:.3f}, gain {gain:.3f}, lag {lag:+.2f} s"
    level: Level = "error"
    if correlation < -0.5:
        text += "; it has the opposite sign"
    elif correlation < 0.5 and float(motion.measured[name][motion.good].std()) < 0.6 * spread:
        # noise of the reference alone explains this
        level, text = "warning", f"{text}; the reference is too noisy to tell"
    elif correlation < 0.5:
        text += "; they do not describe one motion"
    elif correlation > 0.9 and not 0.6 < gain < 1.6:
        text += "; check its unit"
    elif abs(lag) > max(0.3, 2.0 * motion.step):
        level, text = "warning", f"{text}; it {'trails' if lag > 0.0 else 'leads'}, a filter or another clock"
    else:
        level = "info"
    yield Finding(level, f"follows_{name}", text, {"correlation": correlation, "gain": gain, "lag": lag})


def _agreement(reference: np.ndarray, measured: np.ndarray, good: np.ndarray, step: float) -> tuple[float, float, float, float] | None:
    """How `measured` [T] follows `reference` [T] where `good` [T].

    Returns:
        Correlation (means removed) and gain (least squares through the origin) at the lag with the largest correlation, that lag in s (positive
        where `measured` trails; within 3 s, refined by a parabola), and the standard deviation of the reference; None where fewer than 50 samples
        can be compared at all lags, or either does not vary.
    """
    reach = max(round(_LONGEST_LAG / step), 10)
    if good.size < 2 * reach + _FEWEST:
        return None
    # the same samples for every lag, or the comparison of lags would be one of samples
    around = np.lib.stride_tricks.sliding_window_view(np.isfinite(measured), 2 * reach + 1).all(axis=1)
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
    return float(values[best]), float(a @ measured[at + lags[best]] / (a @ a)), float((lags[best] + shift) * step), spread


def _position_jumps(log: Log, motion: _Motion) -> Iterator[Finding]:
    """Steps of the position that the velocities do not explain."""
    velocity = (log["u"] + 1j * log["v"]) * np.exp(1j * log["psi"])
    explained = 0.5 * motion.step * (velocity[1:] + velocity[:-1])
    excess = np.abs(np.nan_to_num(np.diff(log["x"] + 1j * log["y"]) - explained))
    limit = max(15.0 * float(np.median(excess)), 0.1 * float(np.abs(explained[np.isfinite(explained)]).max(initial=0.0)))
    over = np.flatnonzero(excess > limit)
    if over.size:
        at = int(over[np.argmax(excess[over])])
        text = f"position jumps {over.size} times by more than {limit:.2g} m beyond u, v, at most by {excess[at]:.2g} m at t = {log.t[at + 1]:.2f} s"
        figures = {"count": over.size, "largest": float(excess[at]), "t": float(log.t[at + 1])}
        yield Finding("warning", "position_jump", f"{text}; mask them (kind: frozen or jump)", figures)


def _yaw(log: Log, motion: _Motion) -> Iterator[Finding]:
    yield from _follows("r", motion.yaw, motion, _LEAST_YAW, "the rate of psi")
    r = log["r"]
    change = np.nan_to_num(np.diff(log["psi"]) - 0.5 * motion.step * (r[1:] + r[:-1]))
    drift = np.append(0.0, np.cumsum(change))
    end, most, span = float(drift[-1]), float(np.abs(drift).max()), motion.step * (drift.size - 1)
    # a bias matters by what it is next to the yaw rates of the log
    share = abs(end) / span / max(float(np.nanstd(r)), 1e-12)
    level: Level = "error" if share > 0.5 and most > math.radians(10.0) else "warning" if most > math.radians(5.0) else "info"
    text = (
        f"heading minus the integral of r: {math.degrees(end):+.1f} deg at the end, at most {math.degrees(most):.1f} deg, "
        f"a bias of {math.degrees(end) / span:+.4f} deg/s ({100.0 * share:.2g} % of the standard deviation of r)"
    )
    yield Finding(level, "yaw_drift", text, {"end": end, "most": most, "bias": end / span})

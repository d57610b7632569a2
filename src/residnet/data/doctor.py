"""The data doctor: what a log holds, what is wrong with it, and whether a fit would be misled."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from residnet.core.errors import DataError
from residnet.core.log import Log
from residnet.core.names import ACCELERATION, STATE, VELOCITY
from residnet.data.align import GridConfig, align
from residnet.data.derivatives import SavitzkyGolay
from residnet.data.masks import Frozen, Outlier, segments
from residnet.data.readers.base import unwrap

Level = Literal["info", "warning", "error"]

_MEASURED = (*STATE, "phi", "p", *ACCELERATION)
_CLIPPABLE = (*VELOCITY, "phi", "p", *ACCELERATION)
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
class Finding:
    """One thing that the doctor saw.

    Attributes:
        level: `info`, `warning` (look at it, mask it) or `error` (a fit would be misled).
        code: what kind of finding, fixed for programs that read the report.
        text: one line with figures.
        figures: the numbers, SI.
    """

    level: Level
    code: str
    text: str
    figures: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Report:
    """What `inspect` found in one log.

    Attributes:
        name: the log.
        findings: in the order channels, clock, values, frames, excitation.
    """

    name: str
    findings: tuple[Finding, ...]

    @property
    def misled(self) -> bool:
        """Whether a fit to this log would be misled: any finding is an error."""
        return any(finding.level == "error" for finding in self.findings)

    def find(self, code: str) -> tuple[Finding, ...]:
        """Findings of one code."""
        return tuple(finding for finding in self.findings if finding.code == code)

    def lines(self) -> list[str]:
        """The report as text, one line per finding."""
        return [f"{self.name}: {finding.level}: {finding.text}" for finding in self.findings]


def inspect(log: Log, inputs: Sequence[str] | None = None) -> Report:
    """Examine one log as recorded (before masks and grid, whose effect it cannot see).

    Args:
        log: any log.
        inputs: channels that drive the vessel; None takes all that are neither states nor accelerations.

    Raises:
        UsageError: where the log lacks an input that was named.
        DataError: where the log has fewer than two samples, or a channel holds no number.
    """
    if len(log) < 2:
        raise DataError(f"log {log.name}: {len(log)} samples, at least 2 are needed; leave it out")
    for name, values in log.channels.items():
        if not np.isfinite(values).any():
            raise DataError(f"log {log.name}: channel {name} holds no number; take it out of the channel map")
    driving = tuple(name for name in log.channels if name not in _MEASURED) if inputs is None else tuple(inputs)
    log.stack(driving)
    findings = [*_channels(log), *_clock(log), *_missing(log), *_repeats(log), *_jumps(log, driving), *_outliers(log), *_limits(log, driving)]
    try:
        findings += _frames(align(log, GridConfig(step=float(np.median(np.diff(log.t))))))
    except DataError as error:
        findings.append(Finding("error", "clock_span", f"frames not checked: {error}"))
    return Report(log.name, (*findings, *_excitation(log, driving)))


def _channels(log: Log) -> Iterator[Finding]:
    named = ", ".join(f"{name} [{unit}]" for name, unit in log.units.items())
    yield Finding("info", "channels", f"{len(log.channels)} channels, {len(log)} samples, manoeuvre {log.manoeuvre}: {named}")
    absent = [name for name in STATE if name not in log.channels]
    if absent:
        yield Finding("warning", "absent", f"no {', '.join(absent)}: free runs cannot be scored on what is not measured")


def _clock(log: Log) -> Iterator[Finding]:
    dt = np.diff(log.t)
    step, span = float(np.median(dt)), float(log.t[-1] - log.t[0])
    jitter = float(dt[dt <= 1.5 * step].std() / step)
    level: Level = "warning" if jitter > 0.05 else "info"
    text = f"{1.0 / step:.4g} Hz over {span:.1f} s from t = {log.t[0]:.1f} s, steps vary by {100.0 * jitter:.2g} % (standard deviation)"
    text += "; interpolation will smooth" if level == "warning" else ""
    yield Finding(level, "clock", text, {"rate": 1.0 / step, "jitter": jitter, "span": span})
    gaps = np.flatnonzero(dt > 1.5 * step)
    if gaps.size:
        longest, lost = gaps[np.argmax(dt[gaps])], float((dt[gaps] - step).sum())
        text = f"{gaps.size} gaps, {lost:.2f} s in all, the longest {dt[longest]:.2f} s after t = {log.t[longest]:.2f} s; mask them (kind: gap)"
        yield Finding("error" if lost > 0.5 * span else "warning", "gaps", text, {"count": gaps.size, "lost": lost, "longest": float(dt[longest])})


def _missing(log: Log) -> Iterator[Finding]:
    for name, values in log.channels.items():
        share = float(np.isnan(values).mean())
        if share:
            text = f"{name} is missing in {100.0 * share:.2g} % of the samples; mask them (kind: nan)"
            yield Finding("error" if share > 0.5 else "warning", "nan", text, {"share": share})


def _repeats(log: Log) -> Iterator[Finding]:
    same = float((np.diff(log.stack(tuple(log.channels)), axis=0) == 0.0).all(axis=1).mean())
    if same > 0.01:
        text = f"{100.0 * same:.2g} % of the rows repeat the row before: logged faster than measured, or at rest"
        yield Finding("error" if same > 0.5 else "warning", "repeated_rows", text, {"share": same})
    if "x" in log.channels and "y" in log.channels:
        share = float(Frozen().apply(log).mean())
        held = float((np.diff(log.stack(("x", "y")), axis=0) == 0.0).all(axis=1).mean())
        if share:
            text = f"position repeats bit by bit in {100.0 * held:.2g} % of the steps; freezes of 5 steps or more and the 2 s after each "
            text += f"make {100.0 * share:.2g} % of the samples unusable; mask them (kind: frozen)"
            yield Finding("error" if share > 0.5 else "warning", "frozen", text, {"share": share, "held": held})


def _jumps(log: Log, inputs: Sequence[str]) -> Iterator[Finding]:
    """Changes within one sample."""
    for name, values in log.channels.items():
        unit = log.units[name]
        smooth = unwrap(values) if unit == "rad" else values
        span, change = float(np.nanmax(smooth) - np.nanmin(smooth)), np.abs(np.nan_to_num(np.diff(smooth)))
        at = int(np.argmax(change))
        share = float(change[at]) / span if span > 0.0 else 0.0
        figures = {"largest": float(change[at]), "t": float(log.t[at + 1]), "share_of_range": share}
        text = f"{name} changes by {_show(change[at], unit)} within one sample ({100.0 * share:.0f} % of its range) at t = {log.t[at + 1]:.2f} s"
        if name in inputs and share > 0.25:
            yield Finding("info", "input_jump", f"{text}; derivatives are biased around it, mask them (kind: input_jump)", figures)
        elif name in VELOCITY and share > 0.1:
            yield Finding("warning", "jump", f"{text}; mask it (kind: jump)", figures)


def _outliers(log: Log) -> Iterator[Finding]:
    for name in (name for name in STATE if name in log.channels):
        share = float(Outlier(channels=(name,)).apply(log).mean())
        if share > 0.001:
            text = f"{100.0 * share:.2g} % of {name} lie more than 3 standard deviations from their neighbours; mask them (kind: outlier)"
            yield Finding("warning" if share > 0.01 else "info", "outliers", text, {"share": share})


def _limits(log: Log, inputs: Sequence[str]) -> Iterator[Finding]:
    """Samples exactly at the largest or smallest value of their channel."""
    for name in (*(name for name in _CLIPPABLE if name in log.channels and name not in inputs), *inputs):
        known = log[name][np.isfinite(log[name])]
        low, high = known.min(), known.max()
        share = float(((known == low) | (known == high)).mean())
        # a channel of few levels (a switch, a constant) is at its extremes by nature
        if share <= 0.01 or np.unique(known).size <= 20:
            continue
        text = (
            f"{name} is exactly at its limits {_show(low, log.units[name])} or {_show(high, log.units[name])} in {100.0 * share:.2g} % of the samples"
        )
        if name in inputs:
            yield Finding("info", "at_limits", text, {"share": share})
        else:
            yield Finding("warning", "clipping", f"{text}: the sensor clips or holds", {"share": share})


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


def _frames(log: Log) -> list[Finding]:
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


def _excitation(log: Log, inputs: Sequence[str]) -> Iterator[Finding]:
    """How much of the vessel's envelope the log covers, and whether effects can be told apart."""
    moving = []
    for name in (*(name for name in VELOCITY if name in log.channels), *inputs):
        values, unit = log[name][np.isfinite(log[name])], log.units[name]
        low, high, std = float(values.min()), float(values.max()), float(values.std())
        figures = {"min": low, "max": high, "std": std}
        if std > 1e-6 * max(abs(low), abs(high)):
            moving.append(name)
            yield Finding("info", "range", f"{name} from {_show(low, unit)} to {_show(high, unit)}, standard deviation {_show(std, unit)}", figures)
        else:
            text = f"{name} stays at {_show(low, unit)}: its effect cannot be identified from this log alone"
            yield Finding("warning", "constant", text, figures)
    if "u" in log.channels and "v" in log.channels:
        speed = np.hypot(log["u"], log["v"])
        slow = 0.1 * float(np.nanpercentile(speed, 95))
        share = float(np.mean(speed[np.isfinite(speed)] <= slow))
        if share > 0.05:
            text = f"slower than {_show(slow, 'm/s')} (a tenth of its speed) for {100.0 * share:.2g} % of the time: little to learn there"
            yield Finding("warning" if share > 0.2 else "info", "standing", text, {"share": share})
    if any(name in log.channels for name in VELOCITY) and not any(name in VELOCITY for name in moving):
        yield Finding("error", "no_motion", "no velocity varies: a fit would find nothing but noise")
    if len(moving) > 1:
        yield from _collinearity(log, moving)


def _collinearity(log: Log, names: Sequence[str]) -> Iterator[Finding]:
    columns = log.stack(tuple(names))
    columns = columns[np.isfinite(columns).all(axis=1)]
    if columns.shape[0] < 10 * len(names):
        return
    scaled = (columns - columns.mean(axis=0)) / np.maximum(columns.std(axis=0), np.finfo(float).tiny)
    _, singular, directions = np.linalg.svd(scaled, full_matrices=False)
    condition = float(singular[0] / max(singular[-1], np.finfo(float).tiny))
    worst = ", ".join(names[i] for i in np.argsort(-np.abs(directions[-1]))[:3] if abs(directions[-1][i]) > 0.2)
    text = f"condition number of [{', '.join(names)}] (centred, scaled): {condition:.3g}"
    level: Level = "error" if condition > 1e6 else "warning" if condition > 30.0 else "info"
    if level != "info":
        text += f"; {worst} move together" + (": one of them must go" if level == "error" else ", their effects are hard to tell apart")
    yield Finding(level, "condition", text, {"condition": condition})


def _show(value: float, unit: str) -> str:
    """A value in SI as text; angles in degrees, which people read more easily."""
    if unit.startswith("rad"):
        return f"{math.degrees(value):.3g} {unit.replace('rad', 'deg', 1)}"
    return f"{value:.3g} {unit}" if unit != "-" else f"{value:.3g}"

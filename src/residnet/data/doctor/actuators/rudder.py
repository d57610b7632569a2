"""Whether a rudder's zero is where the vessel goes straight, and whether its record is cut off."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from residnet.core.log import Log
from residnet.core.stretches import stretches
from residnet.data.doctor.effects.one_step import blocks_of, integrals
from residnet.data.doctor.findings import Finding, raised
from residnet.data.doctor.signals import noise_of

_RUDDERS = ("delta",)
# hulls and single propellers have a neutral angle of a degree or so
_NEUTRAL = math.radians(2.0)
_SURE = 6.0
# beyond so many degrees even a wind is no excuse
_FAR = math.radians(2.6)
# share of the time at one end, and how much harder the vessel then turns
_AT_END = 0.03
_HARDER = 1.3
_SURE_AT_END = 4.5
_VISITS = 3
_UNEXPLAINED = 4.5
_MANY_VISITS = 8


@dataclass(frozen=True)
class Neutral:
    """The rudder angle at which the vessel goes straight, rad, and its standard error."""

    angle: float
    error: float
    effect: float
    effect_error: float


def neutral_angle(log: Log, name: str) -> Neutral | None:
    """Return the neutral rudder angle, from the yaw moment that is there without any rudder."""
    found = _yaw_fit(log, name, [])
    if found is None:
        return None
    values, spread = found
    effect, effect_error = float(values[1]), float(np.sqrt(spread[1, 1]))
    # of a vessel that never moved both are zero
    if not abs(effect) > 4.0 * effect_error:
        return None
    angle = -float(values[0]) / effect
    gradient = np.array([-1.0 / effect, float(values[0]) / effect**2])
    error = float(np.sqrt(max(gradient @ spread[:2, :2] @ gradient, 0.0)))
    return Neutral(angle, error, effect, effect_error)


def _yaw_fit(
    log: Log, name: str, further: list[np.ndarray]
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return coefficients [k] and covariance [k, k] of a yaw model linear in the rudder angle.

    The first two are the moment without rudder and the effect of the rudder, those of `further`
    columns [T], which act as the rudder does, come next. None where the log does not tell.
    """
    if any(other not in log.channels for other in ("u", "r")):
        return None
    first, size = blocks_of(log, ("r",))
    u, r = log["u"], log["r"]
    v = log["v"] if "v" in log.channels else np.zeros(len(log))
    speed = u * np.abs(u)
    if "n" in log.channels:
        race = log["n"] * np.abs(log["n"])
        speed = speed / max(float(np.nanmean(np.abs(speed))), 1e-9) + race / max(
            float(np.nanmean(np.abs(race))), 1e-9
        )
    columns = [speed, speed * log[name], *(speed * one for one in further)]
    columns += [np.abs(u) * r, r * np.abs(r), np.abs(u) * v, v * np.abs(v)]
    if "wind_speed" in log.channels and "wind_dir" in log.channels:
        wind = log["wind_speed"] ** 2
        side = log["wind_dir"] - (log["psi"] if "psi" in log.channels else 0.0)
        columns += [wind * np.sin(side), wind * np.sin(2.0 * side)]
    x = integrals(np.stack(columns, axis=-1), log.t, first, size)
    y = r[first + size] - r[first]
    good = np.isfinite(x).all(axis=1) & np.isfinite(y)
    x, y = x[good], y[good]
    if y.size < 60 or float(np.nanstd(log[name])) < math.radians(1.0):
        return None
    length = np.linalg.norm(x, axis=0)
    # a column of zeros, of a channel that stands still, keeps its coefficient of zero
    scale = np.where(length > 0.0, length, 1.0)
    x = x / scale
    inverse = np.linalg.pinv(x.T @ x, rcond=1e-10)
    values = inverse @ (x.T @ y)
    rest = y - x @ values
    section = np.arange(y.size) * 20 // y.size
    scores = np.add.reduceat(x * rest[:, None], np.searchsorted(section, np.arange(20)), axis=0)
    return values / scale, inverse @ (scores.T @ scores) @ inverse / np.outer(scale, scale)


def _cut_off(log: Log, name: str) -> Iterator[Finding]:
    """Return a rudder at whose recorded limit the vessel turns harder than the angle explains."""
    if "u" not in log.channels or "r" not in log.channels:
        return
    values = log[name]
    size = float(np.nanmax(np.abs(values)))
    at_end = np.abs(values) > 0.999 * size
    # a turning circle goes there once, and all of it lies there
    if not _AT_END < float(at_end.mean()) < 1.0 - _AT_END or stretches(at_end)[0].size < _VISITS:
        return
    beyond = max(_harder(log, name, at_end), _unexplained(log, name, at_end))
    if beyond > 0.0:
        text = (
            f"at {math.degrees(size):.1f} deg of {name} the vessel turns harder than smaller angles"
            f" explain ({beyond:.1f} times what they leave open): its record is cut off there"
        )
        yield Finding(
            "will mislead",
            "rudder_clipped",
            text,
            {"limit": size, "harder": beyond},
            "log with a wider range, or leave these parts out",
        )


def _harder(log: Log, name: str, at_end: np.ndarray) -> float:
    """Return the rudder effect beyond the recorded limit in standard errors; 0 where it is small.

    The ramps of a zigzag tell the effect of smaller angles.
    """
    found = _yaw_fit(log, name, [np.sign(log[name]) * at_end])
    if found is None:
        return 0.0
    coefficients, spread = found
    effect = float(coefficients[1]) * float(np.nanmax(np.abs(log[name])))
    beyond = float(coefficients[2])
    sure = abs(beyond) / max(float(np.sqrt(spread[2, 2])), 1e-300)
    return sure if beyond / effect > _HARDER - 1.0 and sure > _SURE_AT_END else 0.0


def _unexplained(log: Log, name: str, at_end: np.ndarray) -> float:
    """Return how much harder the vessel turns at the limit, over what a fit elsewhere leaves.

    The fit is one to all that lies off the limit, so it must hold rests at smaller angles; 0 where
    it does not, or explains what happens at the limit.
    """
    first, size = blocks_of(log, ("r",))
    u, r, values = log["u"], log["r"], log[name]
    v = log["v"] if "v" in log.channels else np.zeros(len(log))
    flows = [u * np.abs(u)] + [log[n] * np.abs(log[n]) for n in ("n",) if n in log.channels]
    columns = [*flows, *(flow * values for flow in flows)]
    columns += [np.abs(u) * r, r * np.abs(r), np.abs(u) * v, v * np.abs(v)]
    x = integrals(np.stack(columns, axis=-1), log.t, first, size)
    y = r[first + size] - r[first]
    count = np.append(0, np.cumsum(at_end))
    ends = count[first + size + 1] - count[first]
    known = np.isfinite(x).all(axis=1) & np.isfinite(y)
    inside, outside = known & (ends == size + 1), known & (ends == 0)
    moved = np.abs(values[first + size] - values[first]) + np.abs(
        values[first + size // 2] - values[first]
    )
    most = float(np.nanmax(np.abs(values)))
    resting = outside & (moved < 0.05 * most) & (np.abs(values[first]) > 0.15 * most)
    few = stretches(at_end)[0].size < _MANY_VISITS
    if few or inside.sum() < 10 or resting.sum() < 20:
        return 0.0
    scale = np.maximum(np.sqrt(np.mean(x[outside] ** 2, axis=0)), 1e-300)
    fitted = np.linalg.lstsq(x[outside] / scale, y[outside], rcond=1e-8)[0] / scale
    usual = float(np.sqrt(np.mean((y - x @ fitted)[outside] ** 2)))
    side = np.sign(values[first[inside]]) * np.sign(_effect(fitted, flows))
    harder = float(np.mean((y - x @ fitted)[inside] * side)) / max(usual, 1e-300)
    return harder if harder > _UNEXPLAINED else 0.0


def _effect(fitted: np.ndarray, flows: list[np.ndarray]) -> float:
    """Return the mean effect of the rudder in a fit whose first columns are flows, then rudder."""
    count = len(flows)
    parts = zip(fitted[count : 2 * count], flows, strict=True)
    return float(sum(value * np.nanmean(flow) for value, flow in parts))


def rudder_findings(log: Log, inputs: Sequence[str]) -> Iterator[Finding]:
    """Return a rudder whose zero is off, or whose record is cut off at an angle."""
    for name in _RUDDERS:
        if name not in inputs:
            continue
        neutral = neutral_angle(log, name)
        if neutral is not None and neutral.effect < -_SURE * neutral.effect_error:
            text = f"positive {name} turns the vessel to port"
            action = "turn it in the channel map (sign: -1), and check the sign of r and psi"
            yield Finding("will mislead", "rudder_sign", text, {"effect": neutral.effect}, action)
        elif neutral is not None and abs(neutral.angle) > max(_FAR, _SURE * neutral.error):
            text = (
                f"the vessel goes straight at {name} = {math.degrees(neutral.angle):+.1f} +-"
                f" {math.degrees(2.0 * neutral.error):.1f} deg"
            )
            yield Finding(
                "will mislead",
                "rudder_bias",
                text,
                {"angle": neutral.angle, "error": neutral.error},
                "take the offset off, or give a steady wind or current as an input",
                repair=raised(name, -neutral.angle),
            )
        yield from _clipped(log, name)
        yield from _cut_off(log, name)


def neutrals_between(logs: Sequence[Log], inputs: Sequence[str]) -> Iterator[Finding]:
    """Return the logs whose neutral rudder angle or rudder effect differs from the others'."""
    for name in _RUDDERS:
        if name not in inputs:
            continue
        found = [(log, neutral_angle(log, name)) for log in logs]
        members = [(log, neutral) for log, neutral in found if neutral is not None]
        if len(members) < 3:
            continue
        for log, one in members:
            others = [other for another, other in members if another is not log]
            usual = float(np.median([other.angle for other in others]))
            scatter = 1.4826 * float(np.median([abs(other.angle - usual) for other in others]))
            apart = one.angle - usual
            error = float(np.hypot(one.error, np.median([other.error for other in others])))
            if abs(apart) > max(_NEUTRAL, 4.0 * scatter, _SURE * error):
                text = (
                    f"{log.name}: the vessel goes straight at {math.degrees(apart):+.1f} deg of"
                    f" {name} more than in {len(others)} other logs"
                )
                yield Finding(
                    "will mislead",
                    "rudder_bias",
                    text,
                    {"angle": apart, "error": error},
                    "take the offset off this log's rudder",
                )


def _clipped(log: Log, name: str) -> Iterator[Finding]:
    """Return a rudder that rests exactly at both ends although it never rests elsewhere."""
    values = log[name]
    known = values[np.isfinite(values)]
    low, high = float(known.min()), float(known.max())
    if high <= low or noise_of(known) <= 1e-6 * (high - low):
        return
    ends = (values == low) | (values == high)
    counts = [int((values == low).sum()), int((values == high).sum())]
    same = np.append(False, np.diff(values) == 0.0)
    elsewhere = float(same[~ends].mean()) if (~ends).any() else 1.0
    if max(counts) >= 5 and float(ends.mean()) > 0.01 and elsewhere < 0.05:
        text = (
            f"{name} rests exactly at {math.degrees(low):.1f} and {math.degrees(high):.1f} deg in"
            f" {100.0 * float(ends.mean()):.0f} % of the samples and nowhere else: its record is"
            " cut off"
        )
        yield Finding(
            "will mislead",
            "clipping",
            text,
            {"low": low, "high": high, "share": float(ends.mean())},
            "log with a wider range, or leave these parts out",
        )

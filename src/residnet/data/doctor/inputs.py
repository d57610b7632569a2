"""Findings about the channels that drive the vessel.

These are jumps, limits, offset, astern, stuck actuators and wind that contains the motion.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence

import numpy as np

from residnet.core.log import Log
from residnet.core.stretches import stretches
from residnet.data.doctor.findings import Finding, share_of, show
from residnet.data.doctor.relative_wind import relative_wind_findings
from residnet.data.doctor.response import response_findings
from residnet.data.doctor.signals import noise_of

# words that tell a demand from what the actuator does
_DEMAND = re.compile(
    r"^(cmd|ref|command|commanded|set|desired)_|_(cmd|ref|command|commanded|set|desired)(?=_|$)"
)
# an actuator that rests so long, s, so far from its demand (share of the demand's range) is stuck
_STUCK = 5.0
_FAR_APART = 0.2
# a heading that goes so far one way and the other was steered
_SWING = math.radians(10.0)
_STEERING = ("delta", "cmd_delta", "nozzle", "cmd_nozzle")


def input_findings(log: Log, inputs: Sequence[str]) -> Iterator[Finding]:
    """Return the findings about the inputs."""
    driving = [name for name in inputs if np.isfinite(log[name]).sum() > 1]
    for name in driving:
        yield from _jumps(log, name)
        yield from _limits(log, name)
        yield from _astern(log, name)
        yield from _size(log, name)
        yield from _excursions(log, name)
    yield from _stuck(log, inputs)
    yield from relative_wind_findings(log, inputs)
    yield from response_findings(log, inputs)


def _jumps(log: Log, name: str) -> Iterator[Finding]:
    change, span = (
        np.abs(np.nan_to_num(np.diff(log[name]))),
        float(np.nanmax(log[name]) - np.nanmin(log[name])),
    )
    at = int(np.argmax(change))
    # a direction may wrap
    if 0.0 < 0.25 * span < change[at] and (log.units[name] != "rad" or name in _STEERING):
        text = (
            f"{name} changes by {show(change[at], log.units[name])} within one sample"
            f" ({share_of(change[at] / span)} of its range) "
        )
        text += f"at t = {log.t[at + 1]:.2f} s"
        figures = {
            "largest": float(change[at]),
            "t": float(log.t[at + 1]),
            "share_of_range": float(change[at] / span),
        }
        yield Finding(
            "note",
            "input_jump",
            text,
            figures,
            "derivatives are biased around it, mask them (kind: input_jump)",
        )


def _limits(log: Log, name: str) -> Iterator[Finding]:
    """Rests at the largest and smallest value, and where their middle lies."""
    known = log[name][np.isfinite(log[name])]
    low, high = float(known.min()), float(known.max())
    tolerance = 1e-3 * (high - low)
    at = (known <= low + tolerance, known >= high - tolerance)
    shares = [float(end.mean()) for end in at]
    if np.unique(known).size <= 2 or max(shares) <= 0.01:
        return
    unit = log.units[name]
    text = (
        f"{name} rests at its limits {show(low, unit)} ({share_of(shares[0])}) and"
        f" {show(high, unit)} ({share_of(shares[1])})"
    )
    yield Finding(
        "note",
        "at_limits",
        text,
        {"low": low, "high": high, "share": sum(shares)},
        "what lies beyond is not learned",
    )
    middle = 0.5 * (low + high)
    # only limits that are nearly the same on both sides are two ends of one actuator
    if name in _STEERING and low < 0.0 < high and 1e-3 * high < abs(middle) < 0.02 * (high - low):
        text = (
            f"{name} goes from {show(low, unit)} to {show(high, unit)}, not the same to both sides:"
            f" an offset of {show(middle, unit)}"
        )
        yield Finding(
            "note",
            "input_offset",
            text,
            {"offset": middle, "low": low, "high": high},
            "take it off, or keep a constant among the regressors",
        )


def _astern(log: Log, name: str) -> Iterator[Finding]:
    if log.units[name] != "1/s" and name.split("_")[0] not in ("n", "rpm", "rev"):
        return
    share = float((log[name] < 0.0).mean())
    if 0.0 < share < 1.0:
        text = (
            f"{name} is negative (astern) in {share_of(share)} of the samples, down to"
            f" {show(float(np.nanmin(log[name])), log.units[name])}"
        )
        yield Finding(
            "note",
            "reversed",
            text,
            {"share": share},
            "a propeller astern obeys another law: give it terms of its own, or leave these"
            " parts out",
        )


def _size(log: Log, name: str) -> Iterator[Finding]:
    """Return a rudder angle that no rudder has."""
    if name not in ("delta", "cmd_delta"):
        return
    largest = float(np.nanquantile(np.abs(log[name]), 0.99))
    if largest > math.radians(100.0):
        text = f"{name} reaches {show(largest, 'rad')}, more than any rudder: deg taken as rad?"
        yield Finding(
            "will mislead",
            "unit",
            text,
            {"largest": largest},
            "correct the unit in the channel map",
        )


def _excursions(log: Log, name: str) -> Iterator[Finding]:
    """Return the values far outside the rest of the channel that return within a second."""
    if log.units[name] == "rad" and name not in _STEERING:
        # a direction may go anywhere at once, as that of a light wind does
        return
    values = log[name]
    step = float(np.median(np.diff(log.t)))
    half = max(round(1.5 / step), 3)
    if np.isfinite(values).sum() < 10 * half:
        return
    known = np.interp(log.t, log.t[np.isfinite(values)], values[np.isfinite(values)])
    windows = np.lib.stride_tricks.sliding_window_view(
        np.pad(known, half, mode="edge"), 2 * half + 1
    )
    distance = np.abs(known - np.median(windows, axis=1))
    low, high = (float(value) for value in np.quantile(known, (0.01, 0.99)))
    beyond = np.maximum(low - known, known - high)
    far = (
        (distance > 0.25 * max(high - low, 1e-12))
        & (beyond > 0.25 * max(high - low, 1e-12))
        & (distance > 8.0 * noise_of(known))
    )
    far = _abrupt(known, distance, far)
    starts, _ = stretches(far)
    if starts.size:
        furthest = show(float(known[far][np.argmax(distance[far])]), log.units[name])
        text = (
            f"{name} leaves its range for a moment {starts.size} times ({int(far.sum())} samples),"
            f" to {furthest}"
        )
        figures = {"count": starts.size, "samples": far.sum(), "t": float(log.t[starts[0]])}
        yield Finding(
            "will mislead",
            "outliers",
            text,
            figures,
            f"mask them (kind: hampel, channels: [{name}])",
            far,
            channels=(name,),
        )


def _abrupt(values: np.ndarray, distance: np.ndarray, far: np.ndarray) -> np.ndarray:
    """Return the excursions among far [T] that go and come within a step or two.

    An actuator takes its time.
    """
    change = np.abs(np.diff(values, prepend=values[0], append=values[-1]))
    out = far.copy()
    for start, stop in zip(*stretches(far), strict=True):
        edges = change[max(start - 1, 0) : start + 1].max(), change[stop : stop + 2].max()
        out[start:stop] = min(edges) > 0.5 * distance[start:stop].max()
    return out


def _stuck(log: Log, inputs: Sequence[str]) -> Iterator[Finding]:
    """Return the actuators that rest although their demand goes elsewhere."""
    for demand in log.channels:
        actual = _actual_of(demand, log)
        if actual is None or log.units[actual] != log.units[demand]:
            continue
        demanded, measured = log[demand], log[actual]
        span = float(np.nanmax(demanded) - np.nanmin(demanded))
        if span <= 0.0:
            continue
        still = np.abs(np.nan_to_num(np.diff(measured))) <= max(
            6.0 * noise_of(measured), 1e-4 * span
        )
        starts, stops = stretches(still)
        worst: tuple[float, int, int] = (0.0, 0, 0)
        for start, stop in zip(starts, stops, strict=True):
            run = slice(start, stop + 1)
            seconds = float(log.t[stop] - log.t[start])
            far_apart = np.abs(demanded[run] - measured[run]) > _FAR_APART * span
            if (
                seconds >= _STUCK
                and float(np.ptp(demanded[run])) > _FAR_APART * span
                and float(far_apart.mean()) > 0.1
                and seconds > worst[0]
            ):
                worst = (seconds, int(start), int(stop))
        if worst[0] > 0.0:
            at = np.zeros(len(log), dtype=bool)
            at[worst[1] : worst[2] + 1] = True
            text = (
                f"{actual} rests for {worst[0]:.1f} s from t = {log.t[worst[1]]:.2f} s while"
                f" {demand} moves on: stuck, or not recorded"
            )
            yield Finding(
                "will mislead",
                "stuck",
                text,
                {"seconds": worst[0], "t": float(log.t[worst[1]])},
                "leave this part out",
                at,
            )
    yield from _idle(log, inputs)


def _actual_of(demand: str, log: Log) -> str | None:
    """Return the channel that says what an actuator does, for that which says what it should.

    None where there is none.
    """
    bare = _DEMAND.sub("", demand)
    if bare == demand:
        candidates = [f"acting_{demand}"]
    else:
        candidates = [bare, f"n_{bare}", f"actual_{bare}", f"{bare}_actual", f"acting_{bare}"]
    return next((name for name in candidates if name in log.channels), None)


def _idle(log: Log, inputs: Sequence[str]) -> Iterator[Finding]:
    """Return a vessel that weaves although nothing that drives it moves."""
    driving = [name for name in inputs if not name.startswith(("wind", "current"))]
    if not driving or "psi" not in log.channels or np.isfinite(log["psi"]).sum() < 50:
        return
    known = np.isfinite(log["psi"])
    psi = np.interp(log.t, log.t[known], log["psi"][known])
    still = np.logical_and.reduce(
        [
            np.abs(np.nan_to_num(np.diff(log[name]))) <= 1e-9 * np.nanmax(np.abs(log[name]))
            for name in driving
        ]
    )
    for start, stop in zip(*stretches(still), strict=True):
        turns = _swings(psi[start : stop + 1])
        if turns >= 2:
            text = (
                f"no input moves for {log.t[stop] - log.t[start]:.1f} s from t = {log.t[start]:.2f}"
                f" s, yet the heading turns round {turns} times"
            )
            at = np.zeros(len(log), dtype=bool)
            at[start : stop + 1] = True
            figures = {
                "seconds": float(log.t[stop] - log.t[start]),
                "turns": float(turns),
                "t": float(log.t[start]),
            }
            yield Finding(
                "will mislead",
                "stuck",
                text,
                figures,
                "the recorded input is stuck, or another one is missing from the log",
                at,
            )


def _swings(angle: np.ndarray) -> int:
    """Return how often an angle [T] turns round after going more than `_SWING` one way."""
    count, low, high, direction = 0, float(angle[0]), float(angle[0]), 0
    for value in angle.tolist():
        low, high = min(low, value), max(high, value)
        if direction <= 0 and value - low > _SWING:
            count, direction, high = count + (direction < 0), 1, value
        elif direction >= 0 and high - value > _SWING:
            count, direction, low = count + (direction > 0), -1, value
    return count

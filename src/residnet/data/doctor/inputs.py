"""Findings about the channels that drive the vessel, and about what stands beside the motion.

Jumps, limits, offset, astern, unit, stuck actuators; wind that contains the motion; positions
against latitude and longitude.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator

import numpy as np

from residnet.core.names import BOW_WIND
from residnet.core.stretches import stretches
from residnet.data.doctor.findings import (
    Check,
    Finding,
    Level,
    check,
    share_of,
    show,
    slip_in_words,
)
from residnet.data.doctor.statistics import STEERING, Record, bridged, fit, high, reversals
from residnet.data.statistics import FEWEST

_LATITUDE = ("latitude", "lat", "gps_lat", "gnss_lat", "latitude_deg", "lat_deg")
_LONGITUDE = ("longitude", "lon", "lng", "long", "gps_lon", "gnss_lon", "longitude_deg", "lon_deg")
# mean radii of curvature are within .4 % of this
_RADIUS = 6_371_000.0


@check(
    "inputs",
    "positions_scaled",
    fix="compute x, y from latitude and longitude, or correct their unit",
    needs=("x", "y"),
)
def positions_scaled(log: Record, found: Check) -> Iterator[Finding]:
    """Report a scale or turn of x, y against latitude and longitude."""
    by_name = {name.lower(): name for name in log}
    latitude = next((by_name[name] for name in _LATITUDE if name in by_name), "")
    longitude = next((by_name[name] for name in _LONGITUDE if name in by_name), "")
    if not latitude or not longitude:
        return
    north, east = (
        log[name] if log.units[name] == "rad" else np.radians(log[name])
        for name in (latitude, longitude)
    )
    fixes = _RADIUS * (north - np.nanmean(north) + 1j * np.cos(north) * (east - np.nanmean(east)))
    place = log["x"] + 1j * log["y"]
    good = np.isfinite(fixes) & np.isfinite(place)
    if good.sum() < FEWEST:
        return
    fixes, place = fixes[good] - fixes[good].mean(), place[good] - place[good].mean()
    if float(np.abs(fixes).max()) < 1.0:
        return
    overlap = complex(np.vdot(fixes, place)) / float(np.vdot(fixes, fixes).real)
    size, left = float(np.linalg.norm(place)), float(np.linalg.norm(place - overlap * fixes))
    rest = left / max(size, 1e-12)
    scale, turn = abs(overlap), float(np.angle(overlap))
    if rest >= 0.2:
        text = f"x, y do not follow {latitude}, {longitude}: {100.0 * rest:.0f} % is left"
    elif abs(scale - 1.0) >= 0.02 or abs(turn) >= math.radians(3.0):
        text = (
            f"x, y are {scale:.3f} times as far as {latitude}, {longitude} say, turned by"
            f" {math.degrees(turn):+.1f} deg{slip_in_words(scale, 'm')}"
        )
    else:
        return
    yield found(text, {"scale": scale, "turn": turn, "rest": rest})


def _driving(log: Record) -> list[str]:
    return [name for name in log.inputs if np.isfinite(log[name]).sum() > 1]


@check(
    "inputs",
    "input_jump",
    "note",
    "derivatives are biased around it, mask them (kind: input_jump)",
)
def input_jumps(log: Record, found: Check) -> Iterator[Finding]:
    """Report inputs that change by a quarter of their range within one sample."""
    for name in _driving(log):
        change = np.abs(np.nan_to_num(np.diff(log[name])))
        span = float(np.nanmax(log[name]) - np.nanmin(log[name]))
        at = int(np.argmax(change))
        largest, t = float(change[at]), float(log.t[at + 1])
        # a direction may wrap
        if 0.0 < 0.25 * span < largest and (log.units[name] != "rad" or name in STEERING):
            text = (
                f"{name} changes by {show(largest, log.units[name])} within one sample"
                f" ({share_of(largest / span)} of its range) at t = {t:.2f} s"
            )
            yield found(text, {"largest": largest, "t": t, "share_of_range": largest / span})


@check("inputs", "at_limits", "note", "what lies beyond is not learned")
def limits(log: Record, found: Check) -> Iterator[Finding]:
    """Report rests at the largest and smallest value, and where their middle lies."""
    for name in _driving(log):
        known, unit = log[name][np.isfinite(log[name])], log.units[name]
        low, most = float(known.min()), float(known.max())
        margin = 1e-3 * (most - low)
        shares = float((known <= low + margin).mean()), float((known >= most - margin).mean())
        if max(shares) <= 0.01 or np.unique(known).size <= 2:
            continue
        text = (
            f"{name} rests at its limits {show(low, unit)} ({share_of(shares[0])}) and"
            f" {show(most, unit)} ({share_of(shares[1])})"
        )
        yield found(text, {"low": low, "high": most, "share": sum(shares)})
        middle = 0.5 * (low + most)
        # only limits that are nearly the same on both sides are two ends of one actuator
        alike = low < 0.0 < most and 1e-3 * most < abs(middle) < 0.02 * (most - low)
        if alike and name in STEERING and unit == "rad":
            text = (
                f"{name} goes from {show(low, unit)} to {show(most, unit)}, not the same to both"
                f" sides: an offset of {show(middle, unit)}"
            )
            fix = "take it off, or keep a constant among the regressors"
            yield found(
                text, {"offset": middle, "low": low, "high": most}, code="input_offset", fix=fix
            )


@check(
    "inputs",
    "reversed",
    "note",
    "a propeller astern obeys another law: give it terms of its own, or leave these parts out",
)
def astern(log: Record, found: Check) -> Iterator[Finding]:
    """Report propellers that run astern."""
    for name in _driving(log):
        share = float((log[name] < 0.0).mean())
        turns = log.units[name] == "1/s" or name.split("_")[0] in ("n", "rpm", "rev")
        if turns and 0.0 < share < 1.0:
            most = show(float(np.nanmin(log[name])), log.units[name])
            text = (
                f"{name} is negative (astern) in {share_of(share)} of the samples, down to {most}"
            )
            yield found(text, {"share": share})


@check("inputs", "unit", fix="correct the unit in the channel map", certain=True)
def rudder_unit(log: Record, found: Check) -> Iterator[Finding]:
    """Report a rudder angle that no rudder has."""
    for name in _driving(log):
        largest = high(log[name], 0.99)
        if name in ("delta", "cmd_delta") and largest > math.radians(100.0):
            shown = show(largest, "rad")
            text = f"{name} reaches {shown}, more than any rudder: deg taken as rad?"
            yield found(text, {"largest": largest})


# words that tell a demand from what the actuator does
_DEMAND = re.compile(
    r"^(cmd|ref|command|commanded|set|desired)_|_(cmd|ref|command|commanded|set|desired)(?=_|$)"
)
_STUCK, _FAR_APART = 5.0, 0.2
"""An actuator that rests so long, s, so far from its demand, share of the demand's range, is stuck.

Chosen by hand: longer than actuators lag, and farther than they are inaccurate.
"""


@check("inputs", "stuck", fix="leave this part out", certain=True)
def stuck(log: Record, found: Check) -> Iterator[Finding]:
    """Report actuators that rest although their demand goes elsewhere."""
    import pandas as pd

    for demand in log:
        bare = _DEMAND.sub("", demand)
        names = [bare, f"n_{bare}", f"actual_{bare}", f"{bare}_actual", f"acting_{bare}"]
        names = names if bare != demand else [f"acting_{demand}"]
        actual = next((name for name in names if name in log), "")
        span = float(np.nanmax(log[demand]) - np.nanmin(log[demand]))
        if not actual or log.units[actual] != log.units[demand] or span <= 0.0:
            continue
        demanded, measured = log[demand], log[actual]
        still = max(6.0 * log.noise(actual), 1e-4 * span)
        # a slow gear moves less in a step than its sensor is noisy: ranges over many steps tell
        many = max(2, round(_STUCK / log.step))
        rolling = pd.Series(measured).rolling(many, min_periods=1)
        rests = ~((rolling.max() - rolling.min()).to_numpy()[many - 1 :] > still)
        longest = slice(0, 0)
        seconds = 0.0
        for start, stop in zip(*stretches(rests), strict=True):
            run = slice(start, stop + many - 1)
            lasted = float(log.t[run.stop - 1] - log.t[start])
            apart = np.abs(demanded[run] - measured[run]) > _FAR_APART * span
            moved = float(np.ptp(demanded[run])) > _FAR_APART * span
            if lasted > seconds and moved and float(apart.sum()) * log.step >= _STUCK:
                longest, seconds = run, lasted
        if seconds:
            at, first = np.zeros(len(log), dtype=bool), float(log.t[longest.start])
            at[longest] = True
            text = (
                f"{actual} rests for {seconds:.1f} s from t = {first:.2f} s while {demand} moves"
                " on: stuck, or not recorded"
            )
            yield found(text, {"seconds": seconds, "t": first}, at=at)


# a heading that goes so far one way and the other was steered
_SWING = math.radians(10.0)


@check(
    "inputs",
    "stuck",
    fix="the recorded input is stuck, or another one is missing from the log",
    needs=("psi",),
    certain=True,
)
def idle(log: Record, found: Check) -> Iterator[Finding]:
    """Report a vessel that weaves although nothing that drives it moves."""
    driving = [name for name in log.inputs if not name.startswith(("wind", "current"))]
    if not driving or np.isfinite(log["psi"]).sum() < FEWEST:
        return
    psi, still = bridged(log.t, log["psi"]), np.ones(len(log) - 1, dtype=bool)
    for name in driving:
        still &= np.abs(np.nan_to_num(np.diff(log[name]))) <= 1e-9 * high(log[name], 1.0)
    starts, stops = stretches(still)
    # a heading that turns round goes farther than it gets
    way = np.append(0.0, np.cumsum(np.abs(np.diff(psi))))
    bent = way[stops] - way[starts] - np.abs(psi[stops] - psi[starts]) >= _SWING
    for start, stop in zip(starts[bent], stops[bent], strict=True):
        run = psi[start : stop + 1]
        turns = reversals(run, _SWING)
        if turns >= 2:
            at = np.zeros(len(log), dtype=bool)
            at[start : stop + 1] = True
            seconds, first = float(log.t[stop] - log.t[start]), float(log.t[start])
            text = (
                f"no input moves for {seconds:.1f} s from t = {first:.2f} s, yet the heading turns"
                f" round {turns} times"
            )
            yield found(text, {"seconds": seconds, "turns": turns, "t": first}, at=at)


@check("inputs", "relative_wind", needs=("psi",), few=True)
def relative_wind(log: Record, found: Check) -> Iterator[Finding]:
    """Report wind directions that turn against the heading: relative wind, not true wind."""
    directions = [n for n in log if "wind" in n and log.units[n] == "rad" and n not in BOW_WIND]
    for name in directions:
        slope, error = _slope_against_heading(log, name)
        others = (one for one in directions if one != name and _same_direction(log, name, one))
        partner = next(others, None)
        turns = error > 0.0 and slope < -5.0 * error and abs(slope + 1.0) < max(3.0 * error, 0.2)
        if not (turns or partner or "relative" in name or name.startswith("rel_")):
            continue
        text = f"{name} turns by {slope:+.2f} +- {2.0 * error:.2f} of every change of heading"
        text += f", and plus psi it is {partner}" if partner else ""
        given = name in log.inputs
        level: Level = "will mislead" if given else "note"
        fix = "a free run must not be given it" if given else "do not make it an input"
        text += ": a relative wind contains psi, u and v"
        yield found(
            text, {"slope": slope, "error": error}, level=level, fix=f"{fix}: use the true wind"
        )


def _same_direction(log: Record, relative: str, true: str) -> bool:
    """Return whether one direction plus the heading is the other, where the heading tells."""
    turned, plain = (
        abs(np.nanmean(np.exp(1j * (log[relative] + turn - log[true]))))
        for turn in (log["psi"], 0.0)
    )
    return bool(turned > 0.9 and plain < turned - 0.02)


def _slope_against_heading(log: Record, name: str) -> tuple[float, float]:
    """Return the change of a direction over ten seconds per rad of heading, and its error.

    The error is a standard error; both are 0 where nothing can be said.
    """
    hop = max(round(10.0 / log.step), 1)
    if len(log) < 5 * hop:
        return 0.0, 0.0
    change = np.angle(np.exp(1j * (log[name][hop:] - log[name][:-hop])))
    turn = log["psi"][hop:] - log["psi"][:-hop]
    # beyond half a circle a change of direction is ambiguous
    good = np.isfinite(change) & np.isfinite(turn) & (np.abs(turn) < 1.5)
    if good.sum() < 100 or float(np.std(turn[good])) < math.radians(1.0):
        return 0.0, 0.0
    x, y = turn[good] - turn[good].mean(), change[good] - change[good].mean()
    found = fit(x[:, None], y)
    return float(found.values[0]), float(found.errors[0])

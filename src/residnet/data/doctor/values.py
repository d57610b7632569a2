"""Findings about single channels: absent, frozen, outlying, clipped, coarse, filled values."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from residnet.core.errors import ResidnetError
from residnet.core.layout import Live, levelled
from residnet.core.log import Log
from residnet.core.names import POSE, STATE
from residnet.core.stretches import stretches
from residnet.data.channels import (
    beyond_belief,
    covered,
    deviation,
    fills,
    median,
    noise_of,
    quantiles,
    spike_cells,
    usual_interval,
)
from residnet.data.doctor.findings import Check, Finding, Level, check, share_of, show
from residnet.data.doctor.statistics import MEASURED, STEERING, Record, resolution_of
from residnet.data.motion import BRIDGED, MotionConfig, complete_motion
from residnet.data.readers.base import unwrap


@check("header", "channels", "note")
def channels(log: Record, found: Check) -> Iterator[Finding]:
    """Report names and units."""
    named = ", ".join(f"{name} [{unit}]" for name, unit in log.units.items())
    about = f"{len(log.units)} channels, {len(log)} samples, manoeuvre {log.log.manoeuvre}"
    yield found(f"{about}: {named}")


@check("values", "absent", "note")
def absent(log: Record, found: Check) -> Iterator[Finding]:
    """Report what of the motion is not measured, and what is and no model takes."""
    live = Live.told(log.log.channels)
    names = [name for name in STATE if name not in log]
    if names:
        try:
            whole = complete_motion(log.log, MotionConfig(), live)
        except ResidnetError as error:
            yield found(f"it cannot be fitted: {error}", level="will mislead")
        else:
            how = "follow from position and heading by a smoother"
            how = "are integrated from the velocities" if "integrated" in whole.meta else how
            if not live.dead:
                yield found(f"no {', '.join(names)}: they {how}")
            else:
                yield found(f"no {', '.join(names)}: {live.text}")
    if "p" in log and not live.rolls:
        text = "p of the roll is measured and not modelled: a model that rolls needs an angle phi"
        yield found(f"{text} that moves", code="roll")
    if {"z", "theta"} & {*log} and not live.spatial and {"x", "u"} & {*log}:
        text = "depth or pitch is measured and not modelled: six degrees of freedom need both, phi,"
        yield found(f"{text} psi, and u and v or a position, that move", code="depth")


# one full circle in rad, and in degrees that were taken for rad
_CIRCLES = ((2.0 * math.pi, ""), (360.0, " of 360: degrees taken as rad"))
_ANGLES = ("psi", "phi")


@check("clock", "heading_wrap", fix="unwrap it before it is filtered or differentiated")
def wraps(log: Record, found: Check) -> Iterator[Finding]:
    """Report headings that were not made continuous: steps by about a full circle."""
    for name in _ANGLES:
        for circle, what in _CIRCLES if name in log else ():
            known = np.isfinite(log[name])
            change = np.abs(np.diff(log[name][known]))
            at = np.flatnonzero(known)[1:][np.abs(change - circle) < 0.25 * circle]
            if at.size:
                text = (
                    f"{name} wraps {at.size} times{what}, first at t = {log.t[at[0]]:.2f} s: logs"
                    " hold it continuous"
                )
                yield found(text, {"count": at.size, "t": log.t[at[0]]})


def upright(log: Log) -> Log:
    """Return a log with roll or pitch with its velocities as rates of place and angles.

    So do checks of the motion see a vessel under water as one on it, and one that heels as one that
    does not. A gyro's yaw rate falls with the cosine of the roll and a compass's does not; whether
    v and r are those of the hull is told by what they leave of the pose. Any other log stays.
    """
    live = Live.told(log.channels)
    if not live.spatial:
        return _as_rates(log) if live.rolls else log
    if not log.channels.keys() >= {*live.moving}:
        log = complete_motion(log, MotionConfig(), live)
    nu = log.stack(live.moving)
    u, v, r = levelled(nu).T
    p = log["p"] + r * np.sin(log["theta"])
    return log.replace(channels={**log.channels, "u": u, "v": v, "r": r, "p": p})


def _as_rates(log: Log) -> Log:
    """Return a log whose v and r move the pose, from one in which they may be the hull's."""
    moved = {"r": np.diff(log["psi"])} if log.channels.keys() >= {"psi", "r"} else {}
    if log.channels.keys() >= {"psi", "x", "y", "v"}:
        moved["v"] = (np.diff(log["x"] + 1j * log["y"]) * np.exp(-1j * log["psi"][1:])).imag
    channels = dict(log.channels)
    for name, change in moved.items():
        both = (log[name], log[name] * np.cos(log["phi"]))
        left = [np.nanmean(np.square(change - np.diff(log.t) * rate[1:])) for rate in both]
        channels[name] = both[int(np.argmin(left))]
    return log.replace(channels=channels)


def unwrapped(log: Log) -> Log:
    """Return the log with its headings continuous."""
    turned = {name: unwrap(log[name]) for name in _ANGLES if name in log.channels}
    return log.replace(channels={**log.channels, **turned})


@check("values", "nan", fix="split the log there (mask kind: nan)")
def missing(log: Record, found: Check) -> Iterator[Finding]:
    """Report samples that are missing, and channels that are slower than the log."""
    for name in log:
        at = ~np.isfinite(log[name])
        share, known = float(at.mean()), np.flatnonzero(~at)
        if not share:
            continue
        every = np.diff(known)
        usual = float(np.median(every)) if every.size else 1.0
        # longest of the intervals and of the ends
        most = max(every.max(initial=0), known[0], len(log) - 1 - known[-1])
        if usual > 1.0 and most <= 2.0 * usual:
            text = (
                f"{name} holds a value once in {usual:.0f} samples: its sensor is slower"
                " than the log"
            )
            fix = "give it a log of its own, or interpolate it"
            figures = {"share": share, "every": usual}
            yield found(text, figures, code="slow_channel", level="note", fix=fix)
            continue
        starts, stops = stretches(at)
        longest = int(np.argmax(stops - starts))
        first = float(log.t[starts[longest]])
        seconds = float(log.t[min(stops[longest], len(log) - 1)]) - first
        text = (
            f"{name} is missing in {share_of(share)} of the samples, {starts.size} stretches, the"
            f" longest {seconds:.2f} s from t = {first:.2f} s"
        )
        level: Level = "fatal" if share > 0.5 else "will mislead"
        figures = {"share": share, "stretches": starts.size, "longest": seconds, "t": first}
        if most <= BRIDGED:
            level, text = "note", f"{text}; so short ones are interpolated"
        yield found(text, figures, level=level, at=at, fix="" if level == "note" else None)


@check("values", "repeated_rows", fix="delete them, or log at the sensors' rate", certain=True)
def repeated_rows(log: Record, found: Check) -> Iterator[Finding]:
    """Report rows that repeat the row before in every channel, more than by chance.

    Digits are few, so that now and then each channel repeats itself.
    """
    same, noisy, chance = np.ones(len(log) - 1, dtype=bool), False, float(len(log))
    for name in log:
        rests = log[name][1:] == log[name][:-1]
        same &= rests
        chance *= float(rests.mean())
        noisy |= name in MEASURED and float(rests.mean()) < 0.5
    same = np.append(False, same)
    share = float(same.mean())
    # commands alone rest for as long as nobody moves them
    moved = any(name in MEASURED for name in log)
    more = int(same.sum()) > chance + 3.0 * np.sqrt(chance)
    if moved and ((noisy and more) or share > 0.5):
        text = (
            f"{int(same.sum())} rows ({share_of(share)}) repeat the row before in every channel:"
            " logged twice, or faster than measured"
        )
        level: Level = "fatal" if share > 0.9 else "will mislead"
        yield found(text, {"count": same.sum(), "share": share}, level=level, at=same)


@check("values", "fill_values", fix="leave these cells empty", certain=True)
def filled(log: Record, found: Check) -> Iterator[Finding]:
    """Report values that stand for a missing measurement."""
    for name in log:
        at = np.flatnonzero(fills(log[name]))
        if at.size:
            value = float(log[name][at[0]])
            text = (
                f"{at.size} samples of {name} hold the fill value {value:g}, first at t ="
                f" {log.t[at[0]]:.2f} s: nothing was measured there"
            )
            yield found(text, {"count": at.size, "value": value}, channels=(name,))


@check("values", "absurd", "fatal", "correct or empty them")
def absurd(log: Record, found: Check) -> Iterator[Finding]:
    """Report values that no vessel can have."""
    for name in log:
        values = log[name]
        at = np.flatnonzero(beyond_belief(values, log.units[name]))
        at = at[~fills(values)[at]] if at.size else at
        if at.size:
            text = (
                f"{name} is {show(float(values[at[0]]), log.units[name])} at t ="
                f" {log.t[at[0]]:.2f} s, which no vessel reaches ({at.size} such samples)"
            )
            yield found(text, {"count": at.size})


# shortest run of equal values that counts as frozen, in steps
_LEAST_RUN = 5
# after a receiver's freeze its filter needs so long to recover, s
_RECOVERY = 2.0
# a compass may rest for so long, s, while a heading is steady
_STEADY = 3.0


@check("values", "frozen", certain=True, spoils=True)
def frozen(log: Record, found: Check) -> Iterator[Finding]:
    """Report sensors that hold their last value although the vessel moves on."""
    fix = np.zeros(len(log), dtype=bool)
    pair = {"x", "y"} <= set(log.measured)
    for names in (*((("x", "y"),) if pair else ()), *((name,) for name in log.measured)):
        held = _held(log, names)
        if len(names) == 2:
            fix = held
        elif pair and names[0] in ("x", "y"):
            # the stretches of the position have a finding already, its ends included
            held &= ~(np.convolve(fix, np.ones(3))[1:-1] > 0.5)
        starts, stops = stretches(held)
        if not starts.size:
            continue
        seconds, at = log.t[stops - 1] - log.t[starts], held
        if names[0] in ("x", "y"):
            after = np.searchsorted(log.t, log.t[stops - 1] + _RECOVERY - 1e-9)
            at = held | covered(len(log), stops, np.maximum(after, stops))
        share, longest = float(at.mean()), int(np.argmax(seconds))
        text = (
            f"{'position' if len(names) == 2 else names[0]} is bit-identical in {starts.size}"
            f" stretches of {_LEAST_RUN} steps or more while the vessel moves,"
            f" {seconds.sum():.2f} s in all, the longest {seconds[longest]:.2f} s from t ="
            f" {log.t[starts[longest]]:.2f} s"
        )
        level: Level = "fatal" if share > 0.5 else "will mislead"
        if names[0] in _ANGLES and seconds[longest] < _STEADY:
            level = "note"
        yield found(
            text,
            {
                "count": starts.size,
                "seconds": seconds.sum(),
                "longest": seconds[longest],
                "share": share,
                "t": log.t[starts[longest]],
            },
            level=level,
            fix=f"mask them and what follows (kind: frozen, channels: [{', '.join(names)}])",
            at=at,
            channels=names,
        )


def _held(log: Record, names: tuple[str, ...]) -> np.ndarray:
    """Return [T] bool: runs of equal values that neither chance nor rest explains."""
    out = np.zeros(len(log), dtype=bool)
    together = len(names) > 1
    same = np.logical_and.reduce([log[name][1:] == log[name][:-1] for name in names])
    if not same.any():
        return out
    starts, stops = stretches(same)
    # a slow sensor that repeats each value has steps of its own
    shortest = _LEAST_RUN * usual_interval(log.few.log.stack(names))
    long = stops - starts >= shortest
    outside = same.size - int((stops - starts)[long].sum())
    if outside < 0.02 * same.size:
        return out
    # share of equal neighbours where the channel moves: a coarse one repeats values anyhow
    chance = min(float((stops - starts)[~long].sum()) / outside, 0.99)
    # two channels that hold together are never chance
    if chance > 0.0 and not together:
        shortest = max(shortest, int(np.ceil(np.log(1e-4 / same.size) / np.log(chance))))
    # the last digits of a noisy channel never rest, whatever the vessel does
    rare = chance < (0.15 if together else 1e-3)
    long = stops - starts >= shortest
    if not long.any():
        return out
    starts, stops = starts[long], stops[long]
    # noise is a good part of what it does from sample to sample
    noisy = log.noise(names[0]) > 0.05 * deviation(np.diff(log[names[0]]))
    noisy &= rare or names[0] not in POSE
    moved = np.full(starts.size, noisy)
    for name in () if noisy else names:
        moved |= _moves(log[name], stops)
    return covered(out.size, starts[moved], stops[moved] + 1)


def _moves(values: np.ndarray, stops: np.ndarray) -> np.ndarray:
    """Return [R] bool: a channel [T] moves over runs that end at `stops` [R].

    It goes on far from where it stood.
    """
    change = np.abs(np.diff(values))
    resolution = quantiles(change[change > 0.0], 0.1)[0] if (change > 0.0).any() else 0.0
    # the steps from the run's end on, no longer than the log
    after = sliding_window_view(np.append(change, np.full(5, np.nan)), 6)[
        np.minimum(stops, change.size - 1)
    ]
    usual = np.nanmax(after[:, 1:], axis=1)
    far = after[:, 0] > np.maximum(3.0 * usual, 3.0 * resolution)
    return np.asarray((stops < change.size - 3) & far)


# share of the rows from which on repeats are no accident, and their longest run
_REPEATED, _LONGEST_REPEAT = 0.1, 5


@check(
    "values",
    "repeated_fix",
    fix="leave these cells empty, or log at the receiver's rate",
    needs=("x", "y"),
    certain=True,
)
def repeated_fix(log: Record, found: Check) -> Iterator[Finding]:
    """Report single rows in which position stands still while the vessel moves."""
    change = np.diff(log.log.stack(("x", "y")), axis=0)
    same = (change == 0.0).all(axis=1)
    starts, stops = stretches(same)
    few = stops - starts < _LONGEST_REPEAT
    short = covered(same.size, starts[few], stops[few])
    share = float(short.mean())
    # a position moves by far more than its resolution where it moves
    steps = np.hypot(*change[~same].T)
    steps = steps[np.isfinite(steps)]
    axis = np.abs(change[:, 0])
    least = float(axis[axis > 0.0].min(initial=np.inf))
    if share < _REPEATED or steps.size < 20 or float(np.median(steps)) <= 4.0 * least:
        return
    if usual_interval(log.log.stack(("x", "y"))) > 1.0:
        # a slow receiver: `held` says so, and a fit takes the repeats out
        return
    names = ["x", "y"]
    for name in ("psi", "u", "v", "r"):
        if name in log and float((np.diff(log[name])[short] == 0.0).mean()) > 0.8:
            names.append(name)
    text = (
        f"{int(short.sum())} rows ({share_of(share)}) repeat the last {', '.join(names)}: the fix"
        " is older than the row"
    )
    at = np.append(False, short)
    yield found(text, {"count": short.sum(), "share": share}, at=at, channels=tuple(names))


# shortest straight stretch, in samples and s
_STRAIGHT_SAMPLES, _STRAIGHT_SECONDS = 8, 1.0
# share of a channel that may be straight before this is what the channel always does
_USUALLY_STRAIGHT = 0.4


@check(
    "values",
    "interpolated",
    fix="leave the cells between two measurements empty",
    certain=True,
    spoils=True,
)
def interpolated(log: Record, found: Check) -> Iterator[Finding]:
    """Report stretches that were filled by straight lines between the samples at their ends."""
    lines = {name: _straight(log, name) for name in log.measured if name in STATE}
    names = tuple(name for name, at in lines.items() if at.any())
    if not names:
        return
    at = np.logical_or.reduce([lines[name] for name in names])
    starts, stops = stretches(at)
    seconds, share = log.t[stops - 1] - log.t[starts], float(at.mean())
    longest = int(np.argmax(seconds))
    first = float(log.t[starts[longest]])
    text = (
        f"{', '.join(names)} run along exactly straight lines for {seconds.sum():.1f} s"
        f" ({share_of(share)}), the longest {seconds[longest]:.1f} s from t = {first:.2f} s: they"
        " were interpolated"
    )
    figures = {"seconds": seconds.sum(), "longest": seconds[longest]}
    yield found(text, {**figures, "t": first, "share": share}, at=at, channels=names)


def _straight(log: Record, name: str) -> np.ndarray:
    """Return [T] bool: samples within runs without curvature, in a channel that has some."""
    out, values = np.zeros(len(log), dtype=bool), log.few[name]
    known = np.abs(np.diff(np.diff(values) / np.diff(log.few.t)))
    known = known[np.isfinite(known)]
    if known.size < 100:
        return out
    usual = median(known)
    rounding = 1e-9 * float(np.nanmax(np.abs(values))) / log.step
    resolution = resolution_of(values) / log.step
    # between few steps of its resolution a channel runs straight by itself, a smooth channel bends
    # little anyhow: only noise bends at every sample
    coarse = resolution > 0.0 and 8.0 * resolution >= usual
    noise = log.noise(name) * np.sqrt(6.0)
    noisy = noise > 0.5 * median(np.abs(np.diff(values, 2)))
    if coarse or usual <= 10.0 * rounding or not noisy:
        return out
    slope = np.diff(log[name]) / np.diff(log.t)
    bend = np.abs(np.diff(slope))
    flat = bend <= max(1e-5 * usual, rounding, 2.1 * resolution)
    if float(flat.mean()) > _USUALLY_STRAIGHT:
        return out
    moving = np.abs(slope[:-1]) > 10.0 * rounding
    starts, stops = stretches(flat & moving)
    long = log.t[stops] - log.t[starts] >= _STRAIGHT_SECONDS
    long &= stops - starts >= _STRAIGHT_SAMPLES
    return covered(out.size, starts[long], stops[long] + 2)


@check(
    "values",
    "spikes",
    fix="correct or empty these cells; a fit bridges them and leaves them out",
    certain=True,
    spoils=True,
)
def single_spikes(log: Record, found: Check) -> Iterator[Finding]:
    """Report single samples that leave all others and return at once."""
    for name, at in spike_cells(log.log).items():
        values = log[name]
        worst = int(np.argmax(np.where(at, np.abs(values - np.nanmedian(values)), -1.0)))
        text = (
            f"{int(at.sum())} single samples of {name} stand far out, the worst"
            f" {show(float(values[worst]), log.units[name])} at t = {log.t[worst]:.2f} s"
        )
        yield found(text, {"count": at.sum(), "t": log.t[worst]}, at=at, channels=(name,))


@check("values", "outliers", spoils=True)
def outliers(log: Record, found: Check) -> Iterator[Finding]:
    """Report samples far out of their neighbours, by the rule of the mask `hampel`.

    An input may jump: its outliers leave the range of all others too.
    """
    for name in (*log.measured, *log.inputs):
        values, beyond = log[name], np.ones(1, dtype=bool)
        if name not in log.measured:
            low, top = quantiles(values, 0.01, 0.99)
            beyond = np.maximum(low - values, values - top) > 0.25 * max(top - low, 1e-12)
            # a direction may go anywhere at once, as that of a light wind does
            if not beyond.any() or (log.units[name] == "rad" and name not in STEERING):
                continue
        far = log.spikes(name) & beyond
        count = int(far.sum())
        if not count:
            continue
        good, samples = np.isfinite(values) & ~far, np.arange(len(log))
        smooth = np.interp(samples, samples[good], values[good])
        worst = int(np.argmax(np.where(far, np.abs(values - smooth), 0.0)))
        share, t = count / len(log), float(log.t[worst])
        text = (
            f"{count} samples of {name} ({share_of(share)}) stand far out of their neighbours, the"
            f" worst at t = {t:.2f} s"
        )
        level: Level = "will mislead" if count > 2 else "note"
        fix = f"mask them (kind: hampel, channels: [{name}])"
        figures = {"count": count, "share": share, "t": t}
        yield found(text, figures, level=level, fix=fix, at=far, channels=(name,))


@check("values", "clipping", fix="mask them, or log with a wider range", spoils=True)
def clipping(log: Record, found: Check) -> Iterator[Finding]:
    """Report samples exactly at an extreme, many compared with the levels beside it."""
    for name in log.measured:
        known = log[name][np.isfinite(log[name])]
        if name in ("x", "y", "psi"):
            continue
        for limit in (float(known.min()), float(known.max())):
            count = int((known == limit).sum())
            share = count / known.size
            if count < max(5, 0.003 * known.size):
                continue
            levels, counts = np.unique(known, return_counts=True)
            beside = counts[1:4] if limit == levels[0] else counts[-4:-1]
            if levels.size < 10 or count < 4 * int(beside.max()):
                continue
            text = (
                f"{name} is exactly at its limit {show(limit, log.units[name])} in {count} samples"
                f" ({share_of(share)}): the sensor clips or holds"
            )
            figures = {"count": count, "share": share, "limit": limit}
            yield found(text, figures, at=log[name] == limit, channels=(name,))


# levels between the 5th and the 95th percentile below which a resolution is too coarse
_FEWEST_LEVELS = 50
# of a channel that moves less nothing is learned: .05 deg/s either way, over a minute in an angle
_STILL = {"rad": math.radians(3.0), "rad/s": math.radians(0.1)}


@check("values", "resolution", fix="decimals were dropped on the way: log more digits", few=True)
def resolution(log: Record, found: Check) -> Iterator[Finding]:
    """Report the step of a channel's values, too coarse where few lie between its ends."""
    for name in log.measured:
        known = log[name][np.isfinite(log[name])]
        low, high = quantiles(known, 0.05, 0.95)
        levels = np.unique(known)
        if levels.size < 2 or levels.size > 0.5 * known.size:
            continue
        step = float(np.median(np.diff(levels)))
        count = (high - low) / step
        # most samples differ from the one before by whole steps of the resolution, or it is none
        steps = np.diff(known) / step
        if float((np.abs(steps - np.round(steps)) < 1e-3).mean()) < 0.9:
            continue
        text = (
            f"{name} has a resolution of {show(step, log.units[name])}, {count:.0f} levels between"
            " its 5th and 95th percentile"
        )
        fine = count >= _FEWEST_LEVELS or high - low < _STILL.get(log.units[name], 0.0)
        level: Level = "note" if fine else "will mislead"
        fix = "" if fine else None
        yield found(text, {"resolution": step, "levels": count}, level=level, fix=fix)


@check(
    "values",
    "held",
    fix="leave the cells between two measurements empty: held values are late by half an interval"
    " and their derivative is spikes; a fit takes them out of the motion and smooths it",
    few=True,
)
def held(log: Record, found: Check) -> Iterator[Finding]:
    """Report slow sensors whose last value is repeated until the next."""
    for name in log.measured:
        usual = usual_interval(log[name])
        if usual >= 2.0:
            text = f"{name} changes once in {usual:.0f} samples, its last value is held in between"
            yield found(text, {"every": usual}, level="note" if name in STATE else None)


@check("values", "jump")
def jumps(log: Record, found: Check) -> Iterator[Finding]:
    """Report changes of a velocity's level within one sample, which a mass does not make."""
    for name in (name for name in log.moving if name in log.measured):
        values = np.where(log.spikes(name), np.nan, log[name])
        change = np.abs(np.diff(values))
        if np.isfinite(change).sum() < 50:
            continue
        change = np.nan_to_num(change)
        low, high = quantiles(values, 0.01, 0.99)
        # beyond noise, beyond what goes on beside it, and a good part of the whole range
        least = 0.3 * (high - low)
        least = max(8.0 * noise_of(values), least) if change.max() > least else np.inf
        over = change > least
        if over.any():
            around = sliding_window_view(np.pad(change, 4, mode="edge"), 9)
            over[over] = change[over] > 4.0 * np.sort(around[over], axis=1)[:, -2]
        if over.any():
            at = int(np.argmax(np.where(over, change, 0.0)))
            text = (
                f"{name} changes level {int(over.sum())} times within one sample, at most by"
                f" {show(change[at], log.units[name])} at t = {log.t[at + 1]:.2f} s"
            )
            yield found(
                text,
                {"count": over.sum(), "largest": change[at], "t": log.t[at + 1]},
                fix=f"mask it (kind: jump, channel: {name}), or split the log there",
                at=np.append(False, over) | np.append(over, False),
                channels=(name,),
            )

"""Findings about single channels: missing, repeated, frozen, outlying, clipped, coarse values."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from residnet.core.log import Log
from residnet.core.names import STATE, VELOCITY
from residnet.core.stretches import stretches
from residnet.data.doctor.findings import Finding, Level, share_of, show
from residnet.data.doctor.signals import MEASURED, noise_of, spikes, without

# shortest run of equal values that counts as frozen, in steps
_FROZEN = 5
# after a receiver's freeze its filter needs so long to recover, s
_RECOVERY = 2.0
# an angle that is held for less than this is held by nobody's harm, rad
_FELT = math.radians(0.1)
# levels between the 5th and the 95th percentile below which a resolution is felt
_FEWEST_LEVELS = 50


def channel_findings(log: Log) -> Iterator[Finding]:
    """Return the names and units of the channels, and which of the state are absent."""
    named = ", ".join(f"{name} [{unit}]" for name, unit in log.units.items())
    yield Finding(
        "note",
        "channels",
        f"{len(log.channels)} channels, {len(log)} samples, manoeuvre {log.manoeuvre}: {named}",
    )
    absent = [name for name in STATE if name not in log.channels]
    if absent:
        yield Finding(
            "note",
            "absent",
            f"no {', '.join(absent)}: free runs cannot be scored on what is not measured",
        )


def value_findings(log: Log, inputs: Sequence[str]) -> list[Finding]:
    """Return the findings about the values of a log as recorded.

    `inputs` drive the vessel and may jump, hold and rest at their limits.
    """
    measured = [name for name in log.channels if name not in inputs and name in MEASURED]
    return [
        *_missing(log),
        *_repeats(log),
        *frozen_findings(log, measured),
        *_outliers(log, measured),
        *_single_channels(log, measured),
    ]


def _single_channels(log: Log, measured: Sequence[str]) -> Iterator[Finding]:
    for name in measured:
        if name in ("u", "v", "r", "phi", "p", "u_dot", "v_dot", "r_dot"):
            yield from _clipping(log, name)
        yield from _resolution(log, name)
        yield from _sample_and_hold(log, name)
        if name in VELOCITY:
            yield from _steps(log, name)


def _missing(log: Log) -> Iterator[Finding]:
    for name, values in log.channels.items():
        absent = ~np.isfinite(values)
        share = float(absent.mean())
        if not share:
            continue
        every = np.diff(np.flatnonzero(~absent))
        usual = float(np.median(every)) if every.size else 1.0
        if (
            usual > 1.0
            and every.max() <= 2.0 * usual
            and max(np.argmin(absent), np.argmin(absent[::-1])) <= 2.0 * usual
        ):
            text = (
                f"{name} holds a value in every {usual:.0f}th sample only: its sensor is slower"
                " than the log"
            )
            yield Finding(
                "note",
                "slow_channel",
                text,
                {"share": share, "every": usual},
                "give it a log of its own, or interpolate it",
            )
            continue
        starts, stops = stretches(absent)
        longest = int(np.argmax(stops - starts))
        seconds = float(log.t[min(stops[longest], len(log) - 1)] - log.t[starts[longest]])
        text = (
            f"{name} is missing in {share_of(share)} of the samples, {starts.size} stretches, the"
            f" longest {seconds:.2f} s from "
        )
        text += f"t = {log.t[starts[longest]]:.2f} s"
        level: Level = "fatal" if share > 0.5 else "will mislead"
        figures = {
            "share": share,
            "stretches": starts.size,
            "longest": seconds,
            "t": float(log.t[starts[longest]]),
        }
        yield Finding(level, "nan", text, figures, "split the log there (mask kind: nan)", absent)


def _repeats(log: Log) -> Iterator[Finding]:
    """Return the rows that repeat the row before in every channel, which noise never does."""
    same = np.append(False, (np.diff(log.stack(tuple(log.channels)), axis=0) == 0.0).all(axis=1))
    moving = [
        name
        for name in log.channels
        if name in MEASURED and float((np.diff(log[name]) == 0.0).mean()) < 0.5
    ]
    share = float(same.mean())
    if not same.any() or (not moving and share <= 0.5):
        return
    text = (
        f"{int(same.sum())} rows ({share_of(share)}) repeat the row before in every channel: logged"
        " twice, or faster than measured"
    )
    level: Level = "fatal" if share > 0.9 else "will mislead"
    yield Finding(
        level,
        "repeated_rows",
        text,
        {"count": same.sum(), "share": share},
        "delete them, or log at the sensors' rate",
        same,
    )


def frozen_findings(log: Log, measured: Sequence[str]) -> Iterator[Finding]:
    """Return the sensors that hold their last value although the vessel moves on."""
    pair = [name for name in ("x", "y") if name in measured]
    position = np.zeros(len(log), dtype=bool)
    if len(pair) == 2:
        position = _held(log, ("x", "y"))
        if position.any():
            yield _frozen(log, "position", position)
    for name in measured:
        held = _held(log, (name,))
        # the stretches of the position are told already
        held &= ~_grown(position) if name in pair else True
        if held.any():
            yield _frozen(log, name, held)


def _sample_and_hold(log: Log, name: str) -> Iterator[Finding]:
    """Return a slow sensor whose last value is repeated until the next."""
    changes = np.flatnonzero(np.diff(log[name]) != 0.0)
    every = np.diff(changes)
    if every.size < 20 or float(np.median(every)) < 2.0:
        return
    usual = float(np.median(every))
    if float((np.abs(every - usual) <= 0.25 * usual).mean()) < 0.9:
        return
    text = f"{name} changes in every {usual:.0f}th sample only, its last value is held in between"
    action = (
        "leave the cells between two measurements empty: held values are late by half an interval"
        " and their derivative is spikes"
    )
    yield Finding("will mislead", "held", text, {"every": usual}, action)


def _frozen(log: Log, name: str, held: np.ndarray) -> Finding:
    starts, stops = stretches(held)
    seconds = log.t[stops - 1] - log.t[starts]
    at = held.copy()
    if name in ("position", "x", "y"):
        for stop in stops:
            at[stop : int(np.searchsorted(log.t, log.t[stop - 1] + _RECOVERY - 1e-9))] = True
    share, longest = float(at.mean()), int(np.argmax(seconds))
    text = (
        f"{name} is bit-identical in {starts.size} stretches of {_FROZEN} steps or more while the"
        f" vessel moves, {seconds.sum():.2f} s in all, "
    )
    text += f"the longest {seconds[longest]:.2f} s from t = {log.t[starts[longest]]:.2f} s"
    channels = "x, y" if name == "position" else name
    figures = {
        "count": starts.size,
        "seconds": seconds.sum(),
        "longest": seconds[longest],
        "share": share,
        "t": float(log.t[starts[longest]]),
    }
    level: Level = "fatal" if share > 0.5 else "will mislead"
    return Finding(
        level,
        "frozen",
        text,
        figures,
        f"mask them and what follows (kind: frozen, channels: [{channels}])",
        at,
    )


def _held(log: Log, names: Sequence[str]) -> np.ndarray:
    """Return [T] bool: runs of equal values that neither chance nor rest explains."""
    out = np.zeros(len(log), dtype=bool)
    same = (np.diff(log.stack(tuple(names)), axis=0) == 0.0).all(axis=1)
    starts, stops = stretches(same)
    long = stops - starts >= _FROZEN
    outside = same.size - int((stops - starts)[long].sum())
    if outside < 0.02 * same.size:
        return out
    # share of equal neighbours where the channel runs: a coarse one stands still for some samples
    # by nature
    chance = min(float((stops - starts)[~long].sum()) / outside, 0.99)
    # two channels that hold together are never chance
    least = (
        _FROZEN
        if chance <= 0.0 or len(names) > 1
        else max(_FROZEN, int(np.ceil(np.log(1e-4 / same.size) / np.log(chance))))
    )
    limit = 0.15 if len(names) > 1 else 1e-3
    for start, stop in zip(starts, stops, strict=True):
        run = slice(start, stop + 1)
        # the last digits of a noisy channel never rest, whatever the vessel does
        if stop - start >= least and (
            (chance < limit and _noisy(log[names[0]])) or _moves(log, names, run)
        ):
            out[start : stop + 1] = True
    return out


def _moves(log: Log, names: Sequence[str], run: slice) -> bool:
    """Return whether a channel must have changed over a run.

    A pose must by what the velocities say, any other where it is noisy elsewhere.
    """
    rates = {"psi": ("r",), "phi": ("p",)}.get(
        names[0], ("u", "v", "psi") if names[0] in ("x", "y") else ()
    )
    if not rates:
        return _never_rests(log[names[0]], run)
    if any(name not in log.channels for name in rates):
        return _never_rests(log[names[0]], run)
    dt, count = float(log.t[run.stop - 1] - log.t[run.start]), run.stop - run.start
    rate = log[rates[0]][run]
    if names[0] in ("x", "y"):
        over_ground = (rate + 1j * log["v"][run]) * np.exp(1j * log["psi"][run])
        rate = (
            np.abs(over_ground)
            if len(names) == 2
            else over_ground.real
            if names[0] == "x"
            else over_ground.imag
        )
    moved = abs(float(np.nanmean(rate))) * dt if np.isfinite(rate).any() else 0.0
    noise = (
        np.hypot.reduce([noise_of(log[name]) for name in rates if name != "psi"])
        * dt
        / np.sqrt(count if len(names) == 1 else 1)
    )
    steps = np.abs(np.diff(log[names[0]]))
    resolution = float(np.quantile(steps[steps > 0.0], 0.1)) if (steps > 0.0).any() else 0.0
    return bool(
        moved > max(4.0 * noise, 3.0 * resolution, _FELT if names[0] in ("psi", "phi") else 0.0)
    )


def _noisy(values: np.ndarray) -> bool:
    """Return whether noise is a good part of what a channel does from sample to sample."""
    change = np.diff(values)
    return noise_of(values) > 0.05 * float(np.nanstd(change))


def _never_rests(values: np.ndarray, run: slice) -> bool:
    """Return whether a channel that is no pose cannot have rested over a run.

    It is noisy, or it goes on far from where it stood.
    """
    if _noisy(values):
        return True
    after = np.abs(np.diff(values[run.stop - 1 : run.stop + 6]))
    return bool(after.size > 3 and after[0] > 5.0 * float(after[1:].max()))


def _grown(flags: np.ndarray) -> np.ndarray:
    """Return the flags [T] widened by one sample to either side."""
    padded = np.pad(flags, 1)
    widened: np.ndarray = padded[:-2] | padded[1:-1] | padded[2:]
    return widened


def _outliers(log: Log, measured: Sequence[str]) -> Iterator[Finding]:
    for name in measured:
        far = spikes(log[name])
        count = int(far.sum())
        if not count:
            continue
        worst = _worst(log[name], far)
        text = (
            f"{count} samples of {name} ({share_of(count / len(log))}) stand far out of their"
            f" neighbours, the worst at t = {log.t[worst]:.2f} s"
        )
        level: Level = "will mislead" if count > 2 else "note"
        yield Finding(
            level,
            "outliers",
            text,
            {"count": count, "share": count / len(log), "t": float(log.t[worst])},
            _HAMPEL.format(name),
            far,
        )


_HAMPEL = "mask them (kind: hampel, channels: [{}])"


def _worst(values: np.ndarray, far: np.ndarray) -> int:
    rest = without(values, far)
    known = np.isfinite(rest)
    smooth = np.interp(np.arange(values.size), np.flatnonzero(known), rest[known])
    return int(np.argmax(np.where(far, np.abs(values - smooth), 0.0)))


def _clipping(log: Log, name: str) -> Iterator[Finding]:
    """Return the samples exactly at the largest or smallest value, where these are many.

    Many is compared with the levels beside it.
    """
    known = log[name][np.isfinite(log[name])]
    levels, counts = np.unique(known, return_counts=True)
    if levels.size < 10:
        return
    for end, beside in ((0, counts[1:4]), (-1, counts[-4:-1])):
        count, share = int(counts[end]), float(counts[end]) / known.size
        if count < 5 or count < 4 * int(beside.max()) or share < 0.003:
            continue
        text = (
            f"{name} is exactly at its limit {show(levels[end], log.units[name])} in {count}"
            f" samples ({share_of(share)}): the sensor clips or holds"
        )
        at = log[name] == levels[end]
        figures = {"count": count, "share": share, "limit": float(levels[end])}
        yield Finding(
            "will mislead", "clipping", text, figures, "mask them, or log with a wider range", at
        )


def _resolution(log: Log, name: str) -> Iterator[Finding]:
    """Return the decimals that were dropped: few levels between the ends of what a channel does."""
    known = log[name][np.isfinite(log[name])]
    low, high = (float(value) for value in np.quantile(known, (0.05, 0.95)))
    levels = np.unique(known)
    if levels.size < 2 or levels.size > 0.5 * known.size:
        return
    resolution = float(np.median(np.diff(levels)))
    count = (high - low) / resolution
    # most samples differ from the one before by whole steps of the resolution, or it is none
    steps = np.diff(known) / resolution
    if float((np.abs(steps - np.round(steps)) < 1e-3).mean()) < 0.9:
        return
    coarse = count < _FEWEST_LEVELS
    text = (
        f"{name} has a resolution of {show(resolution, log.units[name])}, {count:.0f} levels"
        " between its 5th and 95th percentile"
    )
    action = "decimals were dropped on the way: log more digits" if coarse else ""
    yield Finding(
        "will mislead" if coarse else "note",
        "resolution",
        text,
        {"resolution": resolution, "levels": count},
        action,
    )


def _steps(log: Log, name: str) -> Iterator[Finding]:
    """Return the changes of level within one sample, which a mass does not make."""
    values = without(log[name], spikes(log[name]))
    change = np.abs(np.diff(values))
    if np.isfinite(change).sum() < 50:
        return
    noise = noise_of(values)
    around = np.lib.stride_tricks.sliding_window_view(
        np.pad(np.nan_to_num(change), 4, mode="edge"), 9
    )
    beside = np.sort(around, axis=1)[:, -2]
    span = float(np.nanquantile(values, 0.99) - np.nanquantile(values, 0.01))
    over = np.nan_to_num(change) > np.maximum(np.maximum(8.0 * noise, 4.0 * beside), 0.1 * span)
    if over.any():
        at = int(np.argmax(np.where(over, change, 0.0)))
        text = (
            f"{name} changes level {int(over.sum())} times within one sample, at most by"
            f" {show(change[at], log.units[name])} "
        )
        text += f"at t = {log.t[at + 1]:.2f} s"
        figures = {"count": over.sum(), "largest": float(change[at]), "t": float(log.t[at + 1])}
        action = f"mask it (kind: jump, channel: {name}), or split the log there"
        yield Finding(
            "will mislead",
            "jump",
            text,
            figures,
            action,
            np.append(False, over) | np.append(over, False),
        )

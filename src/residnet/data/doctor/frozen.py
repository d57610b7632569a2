"""Findings about sensors that hold their last value although the vessel moves on."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from residnet.core.log import Log
from residnet.core.stretches import stretches
from residnet.data.doctor.findings import Finding, Level
from residnet.data.doctor.signals import noise_of
from residnet.data.held import usual_interval

# shortest run of equal values that counts as frozen, in steps
_LEAST_RUN = 5
# after a receiver's freeze its filter needs so long to recover, s
_RECOVERY = 2.0
# a turn of less than this during a held heading does no harm, rad
_STEADY = 3.0
_NEGLIGIBLE_ANGLE = math.radians(0.1)


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
        # the stretches of the position have a finding already
        held &= ~_widened(position) if name in pair else True
        if held.any():
            yield _frozen(log, name, held)


def sample_and_hold(log: Log, name: str) -> Iterator[Finding]:
    """Return a slow sensor whose last value is repeated until the next."""
    usual = usual_interval(log[name])
    if usual < 2.0:
        return
    text = f"{name} changes in every {usual:.0f}th sample only, its last value is held in between"
    action = (
        "leave the cells between two measurements empty: held values are late by half an interval"
        " and their derivative is spikes; a fit takes them out of the motion and smooths it"
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
        f"{name} is bit-identical in {starts.size} stretches of {_LEAST_RUN} steps or more while"
        f" the vessel moves, {seconds.sum():.2f} s in all, "
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
    # a coarse compass rests for a moment wherever a heading is steady
    if name in ("psi", "phi") and float(seconds[longest]) < _STEADY:
        level = "note"
    return Finding(
        level,
        "frozen",
        text,
        figures,
        f"mask them and what follows (kind: frozen, channels: [{channels}])",
        at,
        channels=tuple(channels.split(", ")),
    )


def _held(log: Log, names: Sequence[str]) -> np.ndarray:
    """Return [T] bool: runs of equal values that neither chance nor rest explains."""
    out = np.zeros(len(log), dtype=bool)
    values = log.stack(tuple(names))
    same = (np.diff(values, axis=0) == 0.0).all(axis=1)
    starts, stops = stretches(same)
    # a slow sensor that repeats each value has steps of its own
    shortest = _LEAST_RUN * usual_interval(values)
    long = stops - starts >= shortest
    outside = same.size - int((stops - starts)[long].sum())
    if outside < 0.02 * same.size:
        return out
    # share of equal neighbours where the channel moves: a coarse one repeats values anyhow
    chance = min(float((stops - starts)[~long].sum()) / outside, 0.99)
    # two channels that hold together are never chance
    least = (
        shortest
        if chance <= 0.0 or len(names) > 1
        else max(shortest, int(np.ceil(np.log(1e-4 / same.size) / np.log(chance))))
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
        moved
        > max(
            4.0 * noise, 3.0 * resolution, _NEGLIGIBLE_ANGLE if names[0] in ("psi", "phi") else 0.0
        )
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


def _widened(flags: np.ndarray) -> np.ndarray:
    """Return the flags [T] widened by one sample to either side."""
    padded = np.pad(flags, 1)
    widened: np.ndarray = padded[:-2] | padded[1:-1] | padded[2:]
    return widened

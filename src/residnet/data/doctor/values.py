"""Findings about single channels: missing, repeated, frozen, outlying, clipped, coarse values."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from residnet.core.log import Log
from residnet.core.names import STATE, VELOCITY
from residnet.core.stretches import stretches
from residnet.data.doctor.findings import Finding, Level, share_of, show
from residnet.data.doctor.frozen import frozen_findings, sample_and_hold
from residnet.data.doctor.sensors.interpolated import interpolated_findings
from residnet.data.doctor.sensors.repeated import repeated_findings
from residnet.data.doctor.sensors.single import absurd_findings, spike_findings
from residnet.data.doctor.signals import MEASURED, noise_of, spikes, without

# a change of level is one from this share of the range on
_LEVEL = 0.3
# levels between the 5th and the 95th percentile below which a resolution is too coarse
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
        *absurd_findings(log),
        *frozen_findings(log, measured),
        *repeated_findings(log),
        *interpolated_findings(log, measured),
        *spike_findings(log),
        *_outliers(log, measured),
        *_single_channels(log, measured),
    ]


def _single_channels(log: Log, measured: Sequence[str]) -> Iterator[Finding]:
    for name in measured:
        if name in ("u", "v", "r", "phi", "p", "u_dot", "v_dot", "r_dot"):
            yield from _clipping(log, name)
        yield from _resolution(log, name)
        yield from sample_and_hold(log, name)
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
            channels=(name,),
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
            "will mislead",
            "clipping",
            text,
            figures,
            "mask them, or log with a wider range",
            at,
            channels=(name,),
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
    over = np.nan_to_num(change) > np.maximum(np.maximum(8.0 * noise, 4.0 * beside), _LEVEL * span)
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
            channels=(name,),
        )
